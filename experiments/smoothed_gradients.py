"""Which gradient points where a planner gains: exact ones, smoothed ones, those of a model.

The measure is the simulator's central difference over a planner's step: 0.2 m, 3 degrees, a tenth
of an action's range. On random cycles of the data set's protocol, the cosine of each estimate with
it, for action and pose apart.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import wlplan
from experiments._common.cycles import Cycles, random_cycles
from experiments._common.gradients import (
    NARROW,
    PARTS,
    agreement,
    derivatives,
    differences,
    yield_of,
)
from experiments._common.results import main
from experiments._common.rows import Rows
from wlplan import studies
from wlplan.constants import QUANTITIES
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy
from wlplan.types import World

SEED = 7
ROLLOUTS, LOADS = 20, 10
# Widths of the smoothing, in a planner's steps, and pairs of samples.
WIDTHS, PAIRS = (0.1, 0.5), 16
# First order takes 14 times as many cycles: it is that of every fourth, from half as many pairs,
# and zeroth order is computed once more with as many.
FIRST_EVERY, FIRST_WIDTH, FIRST_PAIRS = 4, 0.5, 8
MODELS = ("low", "hybrid")


def run(preset: str, rows: Path) -> dict[str, Any]:
    """Cosines of all estimates, by outcome and part."""
    smoke = preset == "smoke"
    worlds = {name: wlplan.load_world(name) for name in (*MODELS, "simulator")}
    kept = Rows(rows, {"seed": SEED, "widths": WIDTHS, "pairs": (PAIRS, FIRST_PAIRS)})
    with jax.enable_x64(True):
        cycles = random_cycles(1 if smoke else ROLLOUTS, 2 if smoke else LOADS, seed=SEED)
        tables: list[dict[str, Any]] = [
            kept.get(f"cycle {n}", partial(_estimates, worlds, cycles, n))
            for n in range(len(cycles.height))
        ]
    names = list(dict.fromkeys(name for table in tables for name in table["gradients"]))
    names.remove("difference")
    some = [n for n in range(len(tables)) if n % FIRST_EVERY == 0]
    return {
        "cycles": len(tables),
        "steps": studies.STEPS,
        "pairs": PAIRS,
        "first_order": {"cycles": len(some), "width": FIRST_WIDTH, "pairs": FIRST_PAIRS},
        "first_share": _shares([tables[n] for n in some]),
        "estimates": {name: _agreement(name, tables) for name in names},
        # Of the cycles that first order was computed of.
        "on_some": {name: _agreement(name, [tables[n] for n in some]) for name in names},
    }


def _estimates(worlds: dict[str, World], cycles: Cycles, number: int) -> dict[str, Any]:
    """All estimates of one cycle, [3, 7] per step, with their processor time [s]."""
    at = np.zeros(len(studies.COMPONENTS))
    models = {name: yield_of(worlds[name], cycles, number) for name in MODELS}
    simulated = studies.Differenced(yield_of(worlds["simulator"], cycles, number), NARROW)

    def smoothed(order: str, width: float, pairs: int) -> studies.SmoothedGradient:
        return studies.smoothed_gradient(
            simulated, at, width=width, pairs=pairs, order=order, seed=number
        )

    ways: dict[str, Callable[[], Any]] = {
        "difference": partial(differences, simulated),
        **{f"{name}, exact": partial(derivatives, models[name]) for name in MODELS},
        "simulator, exact": partial(derivatives, simulated),
        **{
            f"zeroth order, width {width}": partial(smoothed, "zeroth", width, PAIRS)
            for width in WIDTHS
        },
    }
    few = f"zeroth order, width {FIRST_WIDTH}, {FIRST_PAIRS} pairs"
    if number % FIRST_EVERY == 0:
        for name, order in ((few, "zeroth"), ("first order", "first")):
            ways[name] = partial(smoothed, order, FIRST_WIDTH, FIRST_PAIRS)
    found, seconds = {}, {}
    for name, way in ways.items():
        start = time.process_time()
        found[name] = jax.block_until_ready(way())
        seconds[name] = time.process_time() - start
    row: dict[str, Any] = {"seconds": seconds}
    if few in found:
        zeroth, first = found[few], found["first order"]
        found["mixed, by variance"] = studies.mixed_order(zeroth, first, bias=np.inf)
        found["mixed"] = studies.mixed_order(zeroth, first)
        row["first_share"] = np.asarray(found["mixed"].first_share).round(4).tolist()
    row["gradients"] = {
        name: np.asarray(getattr(one, "gradient", one)).round(8).tolist()
        for name, one in found.items()
    }
    return row


def _shares(tables: list[dict[str, Any]]) -> dict[str, float]:
    """Median weight of first order in the mixture, by outcome."""
    shares = [table["first_share"] for table in tables if "first_share" in table]
    if not shares:
        return {}
    return dict(zip(QUANTITIES, np.median(shares, axis=0).round(3).tolist(), strict=True))


def _agreement(name: str, tables: list[dict[str, Any]]) -> dict[str, Any]:
    """Cosines of an estimate with the differences, by outcome and part, and its median time [s]."""
    having = [table for table in tables if name in table["gradients"]]
    found, wanted = (
        np.array([table["gradients"][which] for table in having]) for which in (name, "difference")
    )
    seconds = [table["seconds"][name] for table in having if name in table["seconds"]]
    return {
        "seconds": float(np.median(seconds)) if seconds else None,
        **{
            outcome: {
                part: agreement(found[:, k, at], wanted[:, k, at]) for part, at in PARTS.items()
            }
            for k, outcome in enumerate(QUANTITIES)
        },
    }


def draw(folder: Path) -> None:
    """Mean cosines with their intervals, one panel an outcome and part."""
    result = json.loads((folder / "smoothed_gradients.json").read_text())
    parts = ("action", "aside and turn", "ahead")
    colours = dict(zip(parts, (BLUE, ORANGE, GREEN), strict=True))
    estimates = result["estimates"]
    names = list(estimates)[::-1]
    figure = new_figure(12.0, 0.9 + 0.42 * len(names))
    panels = figure.subplots(1, len(QUANTITIES), sharey=True)
    for panel, outcome in zip(panels, QUANTITIES, strict=True):
        for shift, part in zip((0.22, 0.0, -0.22), parts, strict=True):
            rows = [estimates[name][outcome][part] for name in names]
            means = np.array([row["mean"] for row in rows])
            low, high = np.array([row["interval"] for row in rows]).T
            panel.errorbar(
                means,
                np.arange(len(names)) + shift,
                xerr=[np.maximum(means - low, 0.0), np.maximum(high - means, 0.0)],
                fmt="o",
                ms=4,
                color=colours[part],
                label=part,
            )
        panel.axvline(0.0, color=FAINT, lw=0.8)
        panel.set_xlim(-0.6, 1.05)
        panel.set_title(outcome, fontsize=9)
        panel.set_xlabel("mean cosine with the difference over a step", fontsize=8)
        tidy(panel)
    some = result["first_order"]["cycles"]
    few = {name for name in names if estimates[name]["mass"]["all"]["cycles"] <= some}
    panels[0].set_yticks(
        np.arange(len(names)),
        [f"{name} ({some} cycles)" if name in few else name for name in names],
        fontsize=8,
    )
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    write_bytes_atomic(folder / "smoothed_gradients.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("smoothed_gradients", run, draw)
