"""Derivatives of the simulator against central differences, and along a line of actions.

Random cycles of the data set's protocol, on piles that were dug before. The line is that of the
paper's appendix C.
"""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import wlplan
from experiments._common.cycles import Cycles, random_cycles
from experiments._common.places import say
from experiments._common.results import main
from wlplan.constants import ACTION_HIGH, ACTION_LOW, CELL_SIZE, J_PER_KJ, KG_PER_TONNE
from wlplan.engines.simulator import STOP_REASONS, Settings, Simulator, dig
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.types import Pile, Pose, action_from

SEED = 7
ROLLOUTS, LOADS = 20, 10
OUTCOMES = {"mass": "t", "time": "s", "work": "kJ"}
# A change of a component that is about as much as any other [m, m, rad, then of the action]: the
# angle between two gradients depends on it.
UNITS = np.array([1.0, 1.0, 0.1, *(0.1 * (np.array(ACTION_HIGH) - np.array(ACTION_LOW)))])
PARTS = {"pose": slice(0, 3), "action": slice(3, 7), "all": slice(0, 7)}
# Steps of the differences in these units: for the derivative, and as wide as a planner's.
STEPS = {"narrow": 1e-6, "wide": 1e-2}
# A gradient shorter than this part of the median one is none.
NOTHING = 1e-6
# The line through the action space, and the ranges that its values are scaled to. Paper, appendices
# C and A.
LINE = np.array([[0.7, 0.0, 0.0, 5.0], [0.0, 5.0, 0.7, 0.0]])
SCALE = {"mass": (1.0, 4.5), "time": (7.0, 25.0), "work": (200.0, 1100.0)}
LINE_KIND, LINE_SLOPE_DEGREES, LINE_POINTS = "conical", 30.0, 121
_WIDTHS = tuple(STEPS.values())
# Loadings played at once: one and what its differences need.
_SIZE = 1 + 2 * 7 * len(STEPS)


def run(preset: str) -> dict[str, Any]:
    """Cosines between gradients and differences, and the line."""
    smoke = preset == "smoke"
    with jax.enable_x64(True):
        cases = in_float64(1 if smoke else ROLLOUTS, 2 if smoke else LOADS)
        return {
            "step_units": UNITS.tolist(),
            "steps": STEPS,
            **_agreement(cases),
            "line": _line(5 if smoke else LINE_POINTS),
        }


def in_float64(rollouts: int, loads: int) -> Cycles:
    """The cycles that gradients are compared on."""
    found = random_cycles(rollouts, loads, seed=SEED)
    return Cycles(*(np.asarray(part, np.float64) for part in found))


def _outcomes(
    settings: Settings, height: Array, origin: Array, vector: Float[Array, "7"]
) -> tuple[Float[Array, "3"], Array]:
    """Mass, time and work of one loading, and the event that ended the filling."""
    simulator = Simulator(settings=settings)
    surface, floor = simulator.view(Pile(height, CELL_SIZE, origin), Pose(*vector[:3]))
    cycle = dig(surface, floor, action_from(vector[3:]), settings=settings)
    work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
    values = jnp.stack([cycle.mass / KG_PER_TONNE, cycle.time, work / J_PER_KJ])
    return values, cycle.stop_reason


@jax.jit
def _jacobian(height: Array, origin: Array, vector: Array) -> Array:
    """Derivatives [3, 7] by reverse mode."""
    settings = Settings(differentiable=True)
    jacobian: Array
    jacobian = jax.jacrev(lambda vector: _outcomes(settings, height, origin, vector)[0])(vector)
    return jacobian


@jax.jit
@partial(jax.vmap, in_axes=(None, None, 0))
def _values(height: Array, origin: Array, vector: Array) -> tuple[Array, Array]:
    """Outcomes and events of several loadings on one pile, in the default settings."""
    return _outcomes(Settings(), height, origin, vector)


def replayed(
    height: np.ndarray, origin: np.ndarray, vectors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`_values` of any number of loadings, in batches of one size."""
    values, reasons = [], []
    for first in range(0, len(vectors), _SIZE):
        which = np.minimum(np.arange(first, first + _SIZE), len(vectors) - 1)
        value, reason = _values(*map(jnp.asarray, (height, origin, vectors[which])))
        values.append(np.asarray(value)[: len(vectors) - first])
        reasons.append(np.asarray(reason)[: len(vectors) - first])
    return np.concatenate(values), np.concatenate(reasons)


class _Compared(NamedTuple):
    """Derivatives of loadings [n, 3, 7] in the units, and the events that ended them [n]."""

    reverse: np.ndarray
    forward: dict[str, np.ndarray]  # differences by name of the step
    backward: dict[str, np.ndarray]
    reasons: np.ndarray


def _compared(cases: Cycles) -> _Compared:
    """Reverse mode and differences of every loading."""
    shifts = np.concatenate(
        [np.zeros((1, 7)), *(sign * step * np.diag(UNITS) for step in _WIDTHS for sign in (1, -1))]
    )
    reverse, values, reasons = [], [], []
    for n, (height, origin, vector) in enumerate(zip(*cases, strict=True), 1):
        jacobian = _jacobian(*map(jnp.asarray, (height, origin, vector)))
        reverse.append(np.asarray(jacobian) * UNITS)
        value, reason = replayed(height, origin, vector + shifts)
        values.append(value.T)
        reasons.append(int(reason[0]))
        if n % 20 == 0:
            say(f"{n} of {len(cases.height)} cycles")
    here, *there = np.split(np.array(values), [1, 8, 15, 22], axis=-1)
    forward = {name: (there[2 * k] - here) / step for k, (name, step) in enumerate(STEPS.items())}
    backward = {
        name: (here - there[2 * k + 1]) / step for k, (name, step) in enumerate(STEPS.items())
    }
    return _Compared(np.array(reverse), forward, backward, np.array(reasons))


def _agreement(cases: Cycles) -> dict[str, Any]:
    """Gradients beside differences, cycle by cycle, and their cosines in all."""
    compared = _compared(cases)
    jacobians, reasons = compared.reverse, compared.reasons
    central = {name: 0.5 * (compared.forward[name] + compared.backward[name]) for name in STEPS}
    bend = 0.5 * (compared.forward["narrow"] - compared.backward["narrow"])
    summary, rows = {}, []
    for name in STEPS:
        summary[name] = {
            outcome: {
                part: _summary(jacobians[:, k, which], central[name][:, k, which])
                for part, which in PARTS.items()
            }
            for k, outcome in enumerate(OUTCOMES)
        }
    for n, reason in enumerate(reasons):
        row: dict[str, Any] = {"stop_reason": STOP_REASONS[int(reason)]}
        for k, outcome in enumerate(OUTCOMES):
            reverse, difference = jacobians[n, k], central["narrow"][n, k]
            size = max(float(np.linalg.norm(difference)), 1e-12)
            row[outcome] = {
                **{part: _cosine(reverse[w], difference[w]) for part, w in PARTS.items()},
                "error": _rounded(np.linalg.norm(reverse - difference) / size),
                # How much the two one-sided differences disagree: a kink or a jump, if much.
                "bend": _rounded(np.linalg.norm(bend[n, k]) / size),
                "worst": int(np.argmax(np.abs(reverse - difference))),
            }
        rows.append(row)
    return {
        "cycles": len(reasons),
        "cosines": summary,
        "rows": rows,
    }


def _rounded(value: float | np.floating) -> float:
    return float(f"{value:.3g}")


def _cosine(one: np.ndarray, other: np.ndarray) -> float | None:
    """Cosine of an angle; None where both are nothing."""
    sizes = np.linalg.norm(one), np.linalg.norm(other)
    if max(sizes) == 0.0:
        return None
    return round(float(one @ other / max(sizes[0] * sizes[1], 1e-300)), 8)


def _summary(reverse: np.ndarray, central: np.ndarray) -> dict[str, Any]:
    """Spread of the cosines over the cycles that have a gradient."""
    sizes = np.linalg.norm(reverse, axis=1), np.linalg.norm(central, axis=1)
    some = np.maximum(*sizes) > NOTHING * np.median(sizes[1])
    cosines = (reverse * central).sum(axis=1)[some] / np.maximum(
        (sizes[0] * sizes[1])[some], 1e-300
    )
    error = np.linalg.norm(reverse - central, axis=1)[some] / np.maximum(sizes[1][some], 1e-300)
    marks = np.percentile(cosines, [0.0, 10.0, 50.0])
    return {
        "cycles": int(some.sum()),
        "median": float(marks[2]),
        "p10": float(marks[1]),
        "least": float(marks[0]),
        "above_0.99": float((cosines > 0.99).mean()),
        "median_relative_error": float(np.median(error)),
    }


def site_of_the_line() -> tuple[wlplan.Pile, np.ndarray]:
    """The pile of the line of actions, and where it is dug: x, y [m], heading [rad]."""
    slope = math.radians(LINE_SLOPE_DEGREES)
    pile = wlplan.relax(wlplan.seed_pile(LINE_KIND, slope=slope, seed=SEED))
    toe = wlplan.toe_contour(pile)
    at = int(np.flatnonzero(toe.accessible)[0])
    pose = np.array([*toe.points[at], toe.heading[at]])
    return pile, pose


def _line(points: int) -> dict[str, Any]:
    """Values and derivatives along the line of actions, at one pose."""
    pile, pose = site_of_the_line()
    place = np.linspace(0.0, 1.0, points)

    height, origin = (np.asarray(part, np.float64) for part in (pile.height, pile.origin))

    def along(place: np.ndarray) -> np.ndarray:
        action = LINE[0] + place[:, None] * (LINE[1] - LINE[0])
        return np.concatenate([np.tile(pose, (len(place), 1)), action], axis=1)

    jacobians = np.array(
        [_jacobian(*map(jnp.asarray, (height, origin, vector))) for vector in along(place)]
    )
    derivative = jacobians[:, :, 3:] @ (LINE[1] - LINE[0])
    step = STEPS["narrow"]
    every = np.concatenate([along(at) for at in (place, place + step, place - step)])
    outcomes, events = replayed(height, origin, every)
    values, ahead, behind = np.split(outcomes, 3)
    central = (ahead - behind) / (2.0 * step)
    error = np.abs(derivative - central)
    return {
        "pile": {"kind": LINE_KIND, "slope_degrees": LINE_SLOPE_DEGREES, "seed": SEED},
        "pose": pose.tolist(),
        "from": LINE[0].tolist(),
        "to": LINE[1].tolist(),
        "place": place.round(6).tolist(),
        "stop_reason": [STOP_REASONS[int(reason)] for reason in events[:points]],
        **{
            outcome: {
                "value": [float(f"{v:.6g}") for v in values[:, k]],
                "derivative": [float(f"{v:.6g}") for v in derivative[:, k]],
                "central": [float(f"{v:.6g}") for v in central[:, k]],
                # Over the largest derivative on the line.
                "median_error": float(np.median(error[:, k]) / np.abs(central[:, k]).max()),
                "p90_error": float(np.percentile(error[:, k], 90) / np.abs(central[:, k]).max()),
            }
            for k, outcome in enumerate(OUTCOMES)
        },
    }


def draw(folder: Path) -> None:
    """Errors of the gradients in pose and action; values and derivatives along the line."""
    result = json.loads((folder / "simulator_gradients.json").read_text())
    figure = new_figure(13.5, 4.2)
    agreement, values, derivatives = figure.subplots(1, 3)
    colours = dict(zip(OUTCOMES, (BLUE, ORANGE, FAINT), strict=True))
    for outcome, colour in colours.items():
        errors = np.sort([max(row[outcome]["error"], 1e-8) for row in result["rows"]])
        share = 100.0 * (1.0 + np.arange(len(errors))) / len(errors)
        agreement.step(errors, share, where="post", color=colour, label=outcome)
    agreement.axvline(0.01, color=FAINT, lw=0.8, ls="--")
    agreement.set_xscale("log")
    agreement.set_xlabel("relative error against central differences")
    agreement.set_ylabel("cycles up to there [%]")
    agreement.set_ylim(0.0, 102.0)
    agreement.legend(fontsize=8, frameon=False, loc="lower right")
    line = result["line"]
    for outcome, colour in colours.items():
        low, high = SCALE[outcome]
        scaled = (np.array(line[outcome]["value"]) - low) / (high - low)
        values.plot(line["place"], scaled, color=colour, label=outcome)
        for what, style in (("derivative", "-"), ("central", ".")):
            steep = np.array(line[outcome][what]) / (high - low)
            label = f"{outcome}, reverse mode" if style == "-" else None
            derivatives.plot(line["place"], steep, style, ms=4, color=colour, label=label)
    largest = max(
        np.percentile(np.abs(line[outcome]["derivative"]), 97)
        / (SCALE[outcome][1] - SCALE[outcome][0])
        for outcome in OUTCOMES
    )
    derivatives.set_ylim(-1.2 * largest, 1.6 * largest)
    derivatives.plot([], [], ".", color=FAINT, label="dots: central differences")
    for axis in (values, derivatives):
        axis.set_xlabel("s, from a$_0$ to a$_1$")
        axis.legend(fontsize=8, frameon=False, loc="upper left", ncols=1 if axis is values else 2)
    values.set_ylabel("outcome, scaled to the paper's range")
    derivatives.set_ylabel("its derivative along s")
    for axis in (agreement, values, derivatives):
        tidy(axis)
    write_bytes_atomic(folder / "simulator_gradients.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("simulator_gradients", run, draw)
