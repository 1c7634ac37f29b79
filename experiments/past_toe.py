"""Poses moved straight ahead, from before the toe into the pile: do the models know what changes?

On piles that the protocol "past-toe" has dug, every pose is moved along its heading from 1 m before
the toe to 1 m behind it, in the simulator and in the models that ship. A gradient is right if its
sign is that of the simulator's difference over a planner's step.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.constants import CELL_SIZE
from wlplan.dataset.episode import Episode
from wlplan.engines.simulator import Simulator
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.terrain.heightmap import to_world
from wlplan.types import Pile, Pose, action_from

# Another seed than those of the data sets.
SEED, ROLLOUTS, LOADS = 2000, 25, 8
PROTOCOL = "past-toe"
OUTCOMES = {"mass": "t", "time": "s", "work": "kJ"}
WORLDS = ("low", "hybrid")
# Steps of a planner [m], and places from the toe on [m] that are all such a step apart.
STEPS = (0.1, 0.25)
PLACES = np.round(np.arange(-1.0, 1.01, 0.25), 2)
SHIFTS = np.unique(np.concatenate([PLACES, [-STEPS[0], STEPS[0]]]))
# Relative errors are of loads from here on [tonne].
LOADED = 0.5
# A filling that takes longer stalls, or nearly [s].
STALLED = 15.0


def run(preset: str) -> dict[str, Any]:
    """Profiles along the heading in the simulator and in the models, and what they agree in."""
    smoke = preset == "smoke"
    piles, poses, actions = dug(2 if smoke else ROLLOUTS, 2 if smoke else LOADS)
    worlds = {name: wlplan.load_world(name) for name in WORLDS}
    told: dict[str, list[np.ndarray]] = {name: [] for name in ("simulator", *WORLDS)}
    slopes: dict[str, list[np.ndarray]] = {name: [] for name in WORLDS}
    for n, case in enumerate(zip(piles, poses, actions, strict=True), 1):
        told["simulator"].append(np.asarray(_profile(Simulator(), *case)))
        for name, world in worlds.items():
            told[name].append(np.asarray(_profile(world, *case)))
            slopes[name].append(np.asarray(_slopes(world, *case)))
        if n % 20 == 0:
            say(f"{n} of {len(poses)} poses")
    values = {name: np.array(rows) for name, rows in told.items()}
    return {
        "seed": SEED,
        "protocol": PROTOCOL,
        "poses": len(poses),
        "shifts": SHIFTS.tolist(),
        "stalled": float((values["simulator"][..., 1] > STALLED).mean()),
        "profiles": {
            name: _rounded(np.median(rows, axis=0).T.tolist()) for name, rows in values.items()
        },
        "worlds": {
            name: {
                "mean_relative_error": _errors(values[name], values["simulator"]),
                "sign": _signs(np.array(slopes[name]), values["simulator"]),
                "sign_of_its_own_difference": _signs_of_steps(values[name], values["simulator"]),
            }
            for name in WORLDS
        },
    }


def dug(rollouts: int, loads: int) -> tuple[list[Pile], list[Pose], list[Array]]:
    """Piles as the protocol leaves them, poses at their toe, and actions."""
    simulator = Simulator()
    play = jax.jit(lambda pile, pose, action: simulator(pile, pose, action)[0].height)
    piles, poses, actions = [], [], []
    for number in range(rollouts):
        episode = Episode(number, SEED, loads, simulator, length=loads, protocol=PROTOCOL)
        episode.reset()
        for load in range(loads):
            pose, action = episode.next_loading()
            if not episode.valid:
                break
            pile = Pile(jnp.asarray(episode.height), CELL_SIZE, jnp.asarray(episode.origin))
            began = Pose(*(jnp.asarray(part) for part in pose))
            back = jnp.asarray(-episode.draws.past[load], jnp.float32)
            x, y = to_world(began, back, jnp.zeros_like(back))
            piles.append(pile)
            poses.append(began.replace(x=x, y=y))
            actions.append(jnp.asarray(action))
            episode.height = play(pile, began, action_from(actions[-1]))
            # All that the protocol asks of what was loaded.
            episode.loadings.append({"action": action, "fill_time": 0.0})
    return piles, poses, actions


def _at(world: Any, pile: Pile, pose: Pose, action: Array, shift: Array) -> Float[Array, "3"]:
    """Mass, time and work from a pose that is moved ahead [m]."""
    x, y = to_world(pose, shift, jnp.zeros_like(shift))
    found = world.foresee(pile, pose.replace(x=x, y=y), action_from(action))
    return jnp.stack([found.mass, found.time, found.work])


@jax.jit
def _profile(world: Any, pile: Pile, pose: Pose, action: Array) -> Float[Array, "n 3"]:
    shifts = jnp.asarray(SHIFTS, pile.height.dtype)
    profile: Array = jax.vmap(lambda shift: _at(world, pile, pose, action, shift))(shifts)
    return profile


@jax.jit
def _slopes(world: Any, pile: Pile, pose: Pose, action: Array) -> Float[Array, "n 3"]:
    """Derivatives along the heading."""
    shifts = jnp.asarray(SHIFTS, pile.height.dtype)
    slope = jax.jacrev(lambda shift: _at(world, pile, pose, action, shift))
    slopes: Array = jax.vmap(slope)(shifts)
    return slopes


def _index(place: float) -> int:
    return int(np.argmin(np.abs(SHIFTS - place)))


def _errors(told: np.ndarray, truth: np.ndarray) -> dict[str, dict[str, float]]:
    """Mean relative errors [1] at the toe, and elsewhere, of loads worth the name."""
    error = np.abs(told - truth) / np.maximum(np.abs(truth), 1e-3)
    toe, loaded = SHIFTS == 0.0, truth[..., 0] >= LOADED
    return {
        where: {
            name: _rounded(float(error[..., k][loaded & which].mean()))
            for k, name in enumerate(OUTCOMES)
        }
        for where, which in (("at_the_toe", toe), ("elsewhere", ~toe))
    }


def _differences(values: np.ndarray, place: float, step: float) -> np.ndarray:
    return np.asarray(values[:, _index(place + step)] - values[:, _index(place - step)])


def _cases() -> list[tuple[str, float, list[float]]]:
    """By name: a step, and the places that it is made from."""
    toe = [(f"at the toe, {step:g} m", step, [0.0]) for step in STEPS]
    wide = STEPS[-1]
    return [
        *toe,
        (f"before it, {wide:g} m", wide, [-0.75, -0.5, -0.25]),
        (f"behind it, {wide:g} m", wide, [0.25, 0.5, 0.75]),
    ]


def _signs(slopes: np.ndarray, truth: np.ndarray) -> dict[str, dict[str, float]]:
    """Part of the derivatives with the sign of the simulator's difference over a step [1]."""
    return {
        name: _agreement([slopes[:, _index(at)] for at in places], truth, places, step)
        for name, step, places in _cases()
    }


def _signs_of_steps(told: np.ndarray, truth: np.ndarray) -> dict[str, dict[str, float]]:
    """The same of a model's own differences over the step."""
    return {
        name: _agreement([_differences(told, at, step) for at in places], truth, places, step)
        for name, step, places in _cases()
    }


def _agreement(
    ours: list[np.ndarray], truth: np.ndarray, places: list[float], step: float
) -> dict[str, float]:
    theirs = np.concatenate([_differences(truth, at, step) for at in places])
    right = np.sign(np.concatenate(ours)) == np.sign(theirs)
    return {name: _rounded(float(right[:, k].mean())) for k, name in enumerate(OUTCOMES)}


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.4g}")


def draw(folder: Path) -> None:
    """Median outcomes along the heading; how often a gradient has the right sign."""
    result = json.loads((folder / "past_toe.json").read_text())
    figure = new_figure(13.5, 3.6)
    axes = figure.subplots(1, 4, width_ratios=[1.0, 1.0, 1.0, 1.3])
    styles = {"simulator": (FAINT, "-"), "low": (BLUE, "--"), "hybrid": (ORANGE, "--")}
    for k, (outcome, unit) in enumerate(OUTCOMES.items()):
        for name, (colour, line) in styles.items():
            axes[k].plot(
                result["shifts"], result["profiles"][name][k], line, color=colour, label=name
            )
        axes[k].set_xlabel("ahead of the toe [m]")
        axes[k].set_ylabel(f"{outcome} [{unit}]")
    axes[0].legend(fontsize=8, frameon=False)
    names = list(result["worlds"]["hybrid"]["sign"])
    for name, offset in (("low", -0.2), ("hybrid", 0.2)):
        right = [
            100.0 * np.mean(list(result["worlds"][name]["sign"][case].values())) for case in names
        ]
        axes[3].barh(np.arange(len(names)) + offset, right, 0.38, color=styles[name][0], label=name)
    axes[3].set_yticks(np.arange(len(names)), names, fontsize=8)
    axes[3].invert_yaxis()
    axes[3].axvline(50.0, color=FAINT, lw=0.8, ls="--")
    axes[3].set_xlim(0.0, 100.0)
    axes[3].set_xlabel("gradients ahead with the right sign [%]")
    for axis in axes:
        tidy(axis)
    write_bytes_atomic(folder / "past_toe.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("past_toe", run, draw)
