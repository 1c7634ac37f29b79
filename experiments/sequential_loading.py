"""Forty loadings in sequence: how far the worlds get from the simulator, and what makes them.

Paper, table 3 and figure 14, here over ten piles that no model has seen. Each world starts with the
pile of the simulator and plays, open loop, the poses and actions of the simulator's sequence. The
same loadings are also predicted one by one on the simulator's own pile: what a world errs by then
is its predictor's, what is added on its own pile comes from the pile.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments._common.models import load_or_train, smoke_settings
from experiments._common.places import say
from experiments._common.results import dataset_summary, main
from experiments.error_distribution import STALL
from wlplan.constants import CELL_SIZE
from wlplan.dataset import Dataset
from wlplan.dataset.episode import Episode, choose_pose
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, INK, ORANGE, new_figure, tidy
from wlplan.studies.paper import SEQUENCE, SEQUENCE_LOADS
from wlplan.training import PhiSettings, PsiHighSettings, PsiLowSettings, Settings
from wlplan.types import Action, Performance, Pile, Pose, World, action_from
from wlplan.worlds.learned import LearnedWorld
from wlplan.worlds.shipped import load_world

# Another seed than that of the data set: other noise, poses and actions.
SEED, PILES, LOADS = 1000, 10, 40
WORLDS = ("low", "hybrid", "high")
OUTCOMES = ("mass", "time", "work")
QUANTITIES = (*OUTCOMES, "volume")
TITLES = {
    "low": "low: ψ_low, automaton",
    "hybrid": "hybrid: ψ_high, automaton",
    "high": "high: ψ_high, φ",
}
COLOURS = dict(zip(WORLDS, (BLUE, FAINT, ORANGE), strict=True))


@dataclasses.dataclass(frozen=True)
class Sequence:
    """Loadings on one pile in the simulator, and the piles before and after each."""

    kind: int  # number of the seed pile
    origin: Float[np.ndarray, "2"]
    poses: Float[np.ndarray, "n 3"]
    actions: Float[np.ndarray, "n 4"]
    outcomes: Float[np.ndarray, "n 3"]  # mass [tonne], time [s], work [kJ]
    heights: Float[np.ndarray, "n+1 nx ny"]  # [m]

    @property
    def volumes(self) -> Float[np.ndarray, " n+1"]:
        """Volume of the pile before each loading and after the last [m³]."""
        volumes: np.ndarray = self.heights.sum(axis=(1, 2), dtype=np.float64) * CELL_SIZE**2
        return volumes


@jax.jit
def load(world: World, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """One loading in a world, compiled once for each."""
    return world(pile, pose, action)


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Plays the sequences in the simulator and in every world, and sums the errors up."""
    smoke = preset == "smoke"
    piles, loads = (2, 3) if smoke else (PILES, LOADS)
    sequences = [simulated(number, loads) for number in range(piles)]
    worlds, sources = learned_worlds(data, models, smoke=smoke)
    truth = np.array([sequence.outcomes for sequence in sequences])
    volumes = np.array([sequence.volumes for sequence in sequences])
    rows = {}
    for name, world in worlds.items():
        say(f"{loads} loads on {piles} piles in the {name} world")
        own = [predicted(world, sequence, own_pile=True) for sequence in sequences]
        given = [predicted(world, sequence, own_pile=False) for sequence in sequences]
        rows[name] = {
            "growth": _growth(own, truth, volumes),
            "growth_on_the_simulators_pile": _growth(given, truth, volumes),
            # Of equation 5, over the sum of what was simulated: errors of single loads do not
            # cancel there.
            "sum_of_error_sizes": _sizes(own, truth),
            "misplaced_m3": np.mean([part[2] for part in own], axis=0).round(3).tolist(),
            "time_error_s": _by_stall(own, truth),
        }
    return {
        "data": dataset_summary(data),
        "models": sources,
        "seed": SEED,
        "piles": [sequence.kind for sequence in sequences],
        "loads": loads,
        "simulated": {
            "sum": {
                name: truth[:, :, k].sum(axis=1).round(3).tolist()
                for k, name in enumerate(OUTCOMES)
            },
            "volume_before": volumes[:, 0].round(3).tolist(),
            "volume_after": volumes[:, -1].round(3).tolist(),
            "stalls": (truth[:, :, 1] > STALL).sum(axis=1).tolist(),
        },
        "worlds": rows,
    }


def learned_worlds(
    data: Dataset, models: Path, *, smoke: bool = False
) -> tuple[dict[str, World], dict[str, str]]:
    """The learned worlds by name, with the weights that ship, or else with trained ones.

    Returns:
        The worlds, and for each whether its weights are the "shipped" or the "trained" ones.
    """
    worlds: dict[str, Any] = {}
    for name in WORLDS:
        try:
            worlds[name] = load_world(name)
        except InputError:
            continue
    sources = {name: "shipped" if name in worlds else "trained" for name in WORLDS}
    if len(worlds) < len(WORLDS):

        def of(settings: Settings) -> Any:
            return load_or_train(models, data, smoke_settings(settings) if smoke else settings)[0]

        if "low" not in worlds:
            worlds["low"] = LearnedWorld(of(PsiLowSettings()))
        if "hybrid" not in worlds:
            worlds["hybrid"] = LearnedWorld(of(PsiHighSettings()))
        if "high" not in worlds:
            worlds["high"] = LearnedWorld(of(PsiHighSettings()), of(PhiSettings()))
    return {name: worlds[name] for name in WORLDS}, sources


def simulated(number: int, loads: int) -> Sequence:
    """A sequence of the data set's protocol: random places at the toe as it is, random actions."""
    simulator = Simulator()
    episode = Episode(number, SEED, loads, simulator, length=loads)
    episode.reset()
    pile = Pile(episode.height, CELL_SIZE, episode.origin)
    heights, outcomes = [np.asarray(pile.height)], []
    poses: list[np.ndarray] = []
    for place, turn, action in zip(episode.place, episode.turn, episode.action, strict=True):
        pose = choose_pose(pile, place, turn)
        if pose is None:
            raise RuntimeError(f"pile {number} is used up after {len(poses)} loads")
        pile, performance = load(simulator, pile, pose_of(pose), action_from(jnp.asarray(action)))
        heights.append(np.asarray(pile.height))
        poses.append(pose)
        outcomes.append([float(getattr(performance, name)) for name in OUTCOMES])
    return Sequence(
        episode.seed_pile,
        np.asarray(episode.origin),
        np.array(poses),
        episode.action,
        np.array(outcomes),
        np.array(heights),
    )


def predicted(
    world: World, sequence: Sequence, *, own_pile: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sequence in another world.

    Args:
        world: The world.
        sequence: What was simulated.
        own_pile: Whether each loading finds the pile that the world itself left, or that of the
            simulator.

    Returns:
        Mass, time and work [n, 3]; the volume of the pile after each loading, in the second case as
        if all changes so far had been made to one pile [m³]; and the volume between its surface and
        the simulator's [m³].
    """
    outcomes, volumes, misplaced = [], [], []
    pile = Pile(jnp.asarray(sequence.heights[0]), CELL_SIZE, jnp.asarray(sequence.origin))
    volume = sequence.volumes[0]
    for n, (pose, action) in enumerate(zip(sequence.poses, sequence.actions, strict=True)):
        if not own_pile:
            pile = pile.replace(height=jnp.asarray(sequence.heights[n]))
        before = np.asarray(pile.height, np.float64)
        pile, performance = load(world, pile, pose_of(pose), action_from(jnp.asarray(action)))
        after = np.asarray(pile.height, np.float64)
        volume += (after - before).sum() * CELL_SIZE**2
        outcomes.append([float(getattr(performance, name)) for name in OUTCOMES])
        volumes.append(volume)
        misplaced.append(np.abs(after - sequence.heights[n + 1]).sum() * CELL_SIZE**2)
    return np.array(outcomes), np.array(volumes), np.array(misplaced)


def pose_of(values: np.ndarray) -> Pose:
    """The pose of a row of a sequence."""
    return Pose(*jnp.asarray(values, jnp.float32))


def _growth(
    predictions: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    truth: Float[np.ndarray, "p n 3"],
    volumes: Float[np.ndarray, "p n+1"],
) -> dict[str, Any]:
    """Relative errors of the sums so far, after each loading and of each pile [1].

    That of the volume is relative to the volume that is left, as in the paper's table.
    """
    sums = np.cumsum(truth, axis=1)
    errors = np.cumsum([outcomes for outcomes, _, _ in predictions], axis=1) / sums - 1.0
    left = np.array([volume for _, volume, _ in predictions]) / volumes[:, 1:] - 1.0
    return {
        name: {
            "last": _summary(values[:, -1]),
            "each": values.round(5).tolist(),
        }
        for name, values in zip(QUANTITIES, (*np.moveaxis(errors, -1, 0), left), strict=True)
    }


def _sizes(
    predictions: list[tuple[np.ndarray, np.ndarray, np.ndarray]], truth: Float[np.ndarray, "p n 3"]
) -> dict[str, float]:
    """Sum of the sizes of the loads' errors over the sum of the outcomes, mean over the piles."""
    errors = np.abs(np.array([outcomes for outcomes, _, _ in predictions]) - truth).sum(axis=1)
    relative = (errors / truth.sum(axis=1)).mean(axis=0)
    return dict(zip(OUTCOMES, relative.tolist(), strict=True))


def _summary(errors: Float[np.ndarray, " p"]) -> dict[str, float]:
    """Mean error over the piles, its spread, and mean and largest size."""
    return {
        "mean": float(errors.mean()),
        "spread": float(errors.std()),
        "mean_absolute": float(np.abs(errors).mean()),
        "largest": float(np.abs(errors).max()),
    }


def _by_stall(
    predictions: list[tuple[np.ndarray, np.ndarray, np.ndarray]], truth: Float[np.ndarray, "p n 3"]
) -> dict[str, float]:
    """Error of the time, summed over all piles, by whether simulator or world have a stall [s]."""
    errors = np.array([outcomes[:, 1] for outcomes, _, _ in predictions]) - truth[:, :, 1]
    stalled = truth[:, :, 1] > STALL
    thought = errors + truth[:, :, 1] > STALL
    parts = {
        "stalled": stalled & ~thought,
        "stalled_and_predicted": stalled & thought,
        "only_predicted": ~stalled & thought,
        "neither": ~stalled & ~thought,
    }
    return {name: float(errors[part].sum()) for name, part in parts.items()} | {
        f"loads_{name}": int(part.sum()) for name, part in parts.items()
    }


def draw(folder: Path) -> None:
    """Growth of the errors: mean size over the piles, the piles' range, and the paper's pile."""
    result = json.loads((folder / "sequential_loading.json").read_text())
    figure = new_figure(11.0, 4.6)
    panels = figure.subplots(2, 4, sharex=True)
    number = np.arange(1, result["loads"] + 1)
    for row, kind in zip(panels, ("growth", "growth_on_the_simulators_pile"), strict=True):
        for panel, quantity in zip(row, QUANTITIES, strict=True):
            for name, colour in COLOURS.items():
                each = 100.0 * np.array(result["worlds"][name][kind][quantity]["each"])
                panel.plot(number, each.mean(axis=0), color=colour, label=TITLES[name])
                low, high = np.percentile(each, [10.0, 90.0], axis=0)
                panel.fill_between(number, low, high, color=colour, alpha=0.15, lw=0)
                if kind == "growth" and name in SEQUENCE:
                    theirs, truth = SEQUENCE[name], SEQUENCE["simulator"]
                    ratio = np.divide(getattr(theirs, quantity), getattr(truth, quantity))
                    error = 100.0 * (ratio - 1.0)
                    label = f"{name}, the paper's pile and simulator"
                    panel.plot(SEQUENCE_LOADS, error, "x", ms=4, color=colour, label=label)
            panel.axhline(0.0, color=INK, lw=0.6)
            tidy(panel)
    for panel, quantity in zip(panels[0], QUANTITIES, strict=True):
        what = "volume left" if quantity == "volume" else f"{quantity} so far"
        panel.set_title(f"{what}: error [%]", fontsize=9)
    for panel in panels[1]:
        panel.set_xlabel("loads", fontsize=8)
    panels[0, 0].set_ylabel("each world on its own pile", fontsize=8)
    panels[1, 0].set_ylabel("on the simulator's pile", fontsize=8)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    note = f"lines: mean over {len(result['piles'])} piles; bands: 10th to 90th percentile"
    figure.suptitle(note, fontsize=8, color=FAINT)
    write_bytes_atomic(folder / "sequential_loading.png", png_bytes(figure))


if __name__ == "__main__":
    main("sequential_loading", run, draw)
