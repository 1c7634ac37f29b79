"""How rough the simulator is against the width of a look, and what re-gridding does to that.

A local map is sampled from the pile anew wherever the loader digs. Bilinear sampling blurs what
lies half way between cells and has kinks; cubic sampling has neither. On random cycles of the data
set's protocol: outcomes, derivatives and roughness with either.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float

from experiments._common.cycles import random_cycles
from experiments._common.gradients import PARTS, agreement, derivatives, differences, yield_of
from experiments._common.models import load_pretrained
from experiments._common.results import main
from experiments._common.rows import Rows
from wlplan import studies
from wlplan.constants import QUANTITIES
from wlplan.engines.simulator import Simulator
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy
from wlplan.terrain.automaton import window_of
from wlplan.terrain.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    Sampling,
    local_points,
    sample,
    sample_cubic,
    sample_local,
)
from wlplan.types import Pile, Pose, action_vector

SEED = 7
ROLLOUTS, LOADS = 10, 10
# Roughness is that of every fifth cycle, by so many samples a width.
EVERY, SAMPLES = 5, 10
# Widths in a planner's steps: 2 mm to 0.2 m aside, 0.03 to 3 degrees, 0.1 to 10 % of a range.
WIDTHS = (0.01, 0.03, 0.1, 0.3, 1.0)
DIRECTIONS = {
    "ahead": studies.direction("ahead"),
    "aside": studies.direction("aside"),
    "turn": studies.direction("turn"),
    # All four parameters alike.
    "action": 0.5 * np.repeat([0.0, 1.0], (3, 4)),
}
MODELS = ("psi_low", "psi_high")
SAMPLINGS: dict[str, Sampling] = {"bilinear": sample, "cubic": sample_cubic}


@no_type_check
class CubicSimulator(Simulator):
    """The simulator on local maps that are sampled cubically, for piles on a level floor."""

    def view(self, pile: Pile, pose: Pose) -> tuple[Float[Array, "52 52"], Float[Array, "52 52"]]:
        """As `Simulator.view`."""
        window, _ = window_of(pile, pose)
        points = local_points(pose, STATE_CELLS, STATE_DISPLACEMENT, pile.height.dtype)
        height = sample_cubic(window.height, window, *points)
        return height, jnp.zeros_like(height)


SIMULATORS = {"bilinear": Simulator(), "cubic": CubicSimulator()}


def _predicted(
    model: Any, around: studies.LoadingYield, steps: Array, *, sampling: Sampling
) -> Array:
    """Mass, time and work that a model predicts around a cycle."""
    pose, action = studies.moved(around.pose, around.action, steps)
    seen = model(sample_local(around.pile, pose, sampling=sampling), action_vector(action))
    return jnp.stack([seen.mass, seen.time, seen.work])


# Made once: each is compiled for.
_PREDICTED = {
    name: functools.partial(_predicted, sampling=sampling) for name, sampling in SAMPLINGS.items()
}


def run(preset: str, rows: Path) -> dict[str, Any]:
    """Outcomes, agreement of derivatives, and roughness, by sampling."""
    smoke = preset == "smoke"
    with jax.enable_x64(True):
        cycles = random_cycles(1 if smoke else ROLLOUTS, 2 if smoke else LOADS, seed=SEED)
    kept = Rows(rows, {"seed": SEED, "widths": WIDTHS, "every": EVERY, "samples": SAMPLES})
    models = {kind: load_pretrained(kind)[0] for kind in MODELS}

    def row(number: int) -> dict[str, Any]:
        around = {name: yield_of(world, cycles, number) for name, world in SIMULATORS.items()}
        found: dict[str, Any] = {
            f"simulator, {name}": _looked_at(function, rough=number % EVERY == 0)
            for name, function in around.items()
        }
        for kind, model in models.items():
            for name, predicted in _PREDICTED.items():
                function = Partial(predicted, model, around["bilinear"])
                found[f"{kind}, {name}"] = _looked_at(function, rough=number % EVERY == 0)
        return found

    with jax.enable_x64(True):
        tables = [
            kept.get(f"cycle {n}", functools.partial(row, n)) for n in range(len(cycles.height))
        ]
    reference = [table["simulator, bilinear"] for table in tables]
    return {
        "cycles": len(tables),
        "steps": studies.STEPS,
        "widths": WIDTHS,
        "directions": {name: along.tolist() for name, along in DIRECTIONS.items()},
        "kinds": {
            name: _summary([table[name] for table in tables], reference) for name in tables[0]
        },
    }


def _looked_at(function: Any, *, rough: bool) -> dict[str, Any]:
    """A function around a cycle: value, differences, derivatives, and roughness if asked for."""
    here = np.zeros(len(studies.COMPONENTS))
    tables = {
        "value": _value(function, here),
        "difference": differences(function),
        "gradient": derivatives(function),
    }
    found = {name: np.asarray(table).round(8).tolist() for name, table in tables.items()}
    if rough:
        for name, along in DIRECTIONS.items():
            seen = studies.roughness(function, here, along, np.array(WIDTHS), samples=SAMPLES)
            found[f"rough, {name}"] = seen.share.round(6).tolist()
    return found


@jax.jit
def _value(function: Any, at: Array | np.ndarray) -> Array:
    value: Array = function(at)
    return value


def _summary(tables: list[dict[str, Any]], reference: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one kind of function: change of the outcomes, agreement of derivatives, roughness."""
    value, usual = (np.array([row["value"] for row in rows]) for rows in (tables, reference))
    size = np.abs(usual).mean(axis=0)
    change = value - usual
    # With the differences of the same function, and with those of the simulator as it is.
    gradient, itself, simulated = (
        np.array([row[which] for row in rows])
        for which, rows in (("gradient", tables), ("difference", tables), ("difference", reference))
    )
    found: dict[str, Any] = {
        "against_the_simulator": {
            outcome: {
                "mean": float((change[:, k].mean() / size[k]).round(5)),
                "absolute": float((np.abs(change[:, k]).mean() / size[k]).round(5)),
            }
            for k, outcome in enumerate(QUANTITIES)
        },
        "roughness": {
            name: {
                outcome: np.median(
                    [row[f"rough, {name}"] for row in tables if f"rough, {name}" in row], axis=0
                )[:, k]
                .round(5)
                .tolist()
                for k, outcome in enumerate(QUANTITIES)
            }
            for name in DIRECTIONS
        },
    }
    for title, wanted in (("own_differences", itself), ("simulator_differences", simulated)):
        found[title] = {
            outcome: {
                part: agreement(gradient[:, k, at], wanted[:, k, at]) for part, at in PARTS.items()
            }
            for k, outcome in enumerate(QUANTITIES)
        }
    return found


def draw(folder: Path) -> None:
    """Share of the variance that is no parabola against the width, by outcome and direction."""
    result = json.loads((folder / "regridding.json").read_text())
    figure = new_figure(11.0, 6.6)
    rows = figure.subplots(len(QUANTITIES), len(DIRECTIONS), sharex=True, sharey=True)
    styles = {
        "simulator, bilinear": (BLUE, "-"),
        "simulator, cubic": (ORANGE, "-"),
        "psi_high, bilinear": (GREEN, "--"),
        "psi_high, cubic": (FAINT, "--"),
    }
    for row, outcome in zip(rows, QUANTITIES, strict=True):
        for panel, direction in zip(row, DIRECTIONS, strict=True):
            for name, (colour, style) in styles.items():
                share = result["kinds"][name]["roughness"][direction][outcome]
                panel.loglog(
                    result["widths"],
                    np.maximum(share, 1e-5),
                    style,
                    marker="o",
                    ms=3,
                    color=colour,
                    label=name.replace("psi_high", "ψ_high"),
                )
            tidy(panel)
        row[0].set_ylabel(f"{outcome}: rest of the variance", fontsize=8)
    for panel, direction in zip(rows[0], DIRECTIONS, strict=True):
        panel.set_title(direction, fontsize=9)
    for panel in rows[-1]:
        panel.set_xlabel("width [steps]", fontsize=8)
    rows[0, -1].legend(fontsize=7, frameon=False)
    write_bytes_atomic(folder / "regridding.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("regridding", run, draw)
