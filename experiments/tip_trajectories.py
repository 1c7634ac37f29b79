"""Paths of the bucket tip: of the cycles of the data set, and of two actions on five slopes.

Paper, figures 7 and 16: two sets of action parameters on five piles with slopes between 30 and 10
degrees (section 5.2), and all trajectories of the data set (appendix A).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection

from experiments._common.resimulation import initial_surfaces, resimulate
from experiments._common.results import dataset_summary, main
from wlplan.constants import KG_PER_TONNE
from wlplan.dataset import Dataset
from wlplan.engines.simulator import Trajectory, trace
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.terrain.heightmap import STATE_CELLS, STATE_DISPLACEMENT, local_axes

SEED = 0
# Cycles that are simulated again, how many are drawn, and moments that a path is drawn by.
CYCLES, DRAWN, MOMENTS = 2000, 250, 20
# The paper's example actions and the slopes of its piles [degrees].
ACTIONS = ((0.1, 1.0, 0.1, 2.5), (0.5, 1.0, 0.4, 4.0))
SLOPES = (30.0, 25.0, 20.0, 15.0, 10.0)
# Every how many moments of the examples are shown.
_EVERY = 3
# Distances at which heights are compared: their spacing, the first and the end [m].
_CELL, _ALONG = 0.1, (-0.5, 4.0)


def run(preset: str, data: Dataset) -> dict[str, Any]:
    """Paths of random cycles of the data set, and of the examples."""
    smoke = preset == "smoke"
    data = data.select(data.valid)
    random = np.random.default_rng(SEED)
    count = min(16 if smoke else CYCLES, len(data))
    some = data.select(np.sort(random.choice(len(data), count, replace=False)))
    paths = resimulate(trace, initial_surfaces(some), some.action)
    filling = [int(np.argmax(phase >= 1)) for phase in paths.phase]
    drawn = np.sort(random.choice(count, min(DRAWN, count), replace=False))
    stop_x = np.array([x[n] for x, n in zip(paths.tip_x, filling, strict=True)])
    stop_z = np.array([z[n] for z, n in zip(paths.tip_z, filling, strict=True)])
    highest = paths.tip_z.max(axis=1)
    return {
        "data": dataset_summary(data),
        "cycles": count,
        # What the replay and the data set disagree by [t].
        "largest_mass_error": float(np.abs(paths.mass[:, -1] / KG_PER_TONNE - some.mass).max()),
        "penetration": _percentiles(paths.tip_x.max(axis=1)),
        "stop_x": _percentiles(stop_x),
        "stop_z": _percentiles(stop_z),
        "highest": _percentiles(highest),
        "paths": [_path(paths, int(k)) for k in drawn],
        "envelope": _envelope(paths),
        "examples": _examples(SLOPES[:2] if smoke else SLOPES),
    }


def _percentiles(values: np.ndarray) -> dict[str, float]:
    marks = np.percentile(values, [0, 5, 50, 95, 100]).round(3)
    names = ("least", "p5", "median", "p95", "largest")
    return dict(zip(names, marks.tolist(), strict=True))


def _path(paths: Trajectory, which: int) -> list[list[float]]:
    """A path by points evenly spaced along it: x and z [m]."""
    x, z = paths.tip_x[which], paths.tip_z[which]
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    at = np.linspace(0.0, length[-1], MOMENTS)
    return [np.interp(at, length, part).round(2).tolist() for part in (x, z)]


def _envelope(paths: Trajectory) -> dict[str, list[float]]:
    """Percentiles of the height at which paths pass a distance for the first time."""
    along = np.arange(_ALONG[0], _ALONG[1], _CELL)
    heights = np.full((len(paths.tip_x), len(along)), np.nan)
    for n, (x, z) in enumerate(zip(paths.tip_x, paths.tip_z, strict=True)):
        reach = np.maximum.accumulate(x)
        ahead = along <= reach[-1]
        heights[n, ahead] = z[np.searchsorted(reach, along[ahead])]
    enough = np.isfinite(heights).mean(axis=0) > 0.01
    marks = np.nanpercentile(heights[:, enough], [5.0, 50.0, 95.0], axis=0).round(3)
    return {
        "along": along[enough].round(2).tolist(),
        "reached": np.isfinite(heights[:, enough]).mean(axis=0).round(3).tolist(),
        **dict(zip(("p5", "median", "p95"), marks.tolist(), strict=True)),
    }


def _examples(slopes: tuple[float, ...]) -> list[dict[str, Any]]:
    """The paper's two actions on planes, with the bucket tip and the load."""
    along, _ = local_axes(STATE_CELLS, STATE_DISPLACEMENT)
    rise = np.maximum(along, 0.0)[:, None] * np.ones(STATE_CELLS)
    cases = [(slope, action) for slope in slopes for action in ACTIONS]
    surface = np.array([math.tan(math.radians(slope)) * rise for slope, _ in cases])
    paths = resimulate(trace, surface, np.array([action for _, action in cases]))
    found = []
    for k, (slope, action) in enumerate(cases):
        end = int(np.argmax(paths.phase[k] == 2))
        shown = np.unique([*range(0, end, _EVERY), end])
        found.append(
            {
                "slope_degrees": slope,
                "action": action,
                "mass": round(float(paths.mass[k, -1]) / KG_PER_TONNE, 3),
                "x": paths.tip_x[k, shown].round(3).tolist(),
                "z": paths.tip_z[k, shown].round(3).tolist(),
            }
        )
    return found


def draw(folder: Path) -> None:
    """Above the paths of the data set, below the examples with the surfaces they dig."""
    result = json.loads((folder / "tip_trajectories.json").read_text())
    figure = new_figure(12.0, 6.4)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.35, 1.0])[:, 0]
    every, spread = upper.subplots(1, 2, sharey=True)
    lines = [np.column_stack(path) for path in result["paths"]]
    colours = colormaps["tab20"](np.random.default_rng(SEED).integers(20, size=len(lines)))
    every.add_collection(LineCollection(lines, colors=colours, linewidths=0.6, alpha=0.8))
    every.set_title(f"{len(lines)} of the cycles", fontsize=9.5)
    envelope = result["envelope"]
    spread.fill_between(
        envelope["along"], envelope["p5"], envelope["p95"], color=BLUE, alpha=0.2, lw=0
    )
    spread.plot(envelope["along"], envelope["median"], color=BLUE, label="median, 5 to 95 %")
    share = spread.twinx()
    share.plot(envelope["along"], 100.0 * np.array(envelope["reached"]), color=FAINT, ls="--")
    share.set_ylabel("cycles that reach so far [%] (dashed)", color=FAINT)
    share.set_ylim(0.0, 105.0)
    spread.legend(fontsize=8.5, frameon=False, loc="center left")
    spread.set_title(f"{result['cycles']} cycles: height where the tip first passes", fontsize=9.5)
    for axis in (every, spread):
        axis.set_xlim(-1.1, 3.7)
        axis.set_ylim(-0.05, 2.95)
        axis.set_xlabel("ahead of the dig location [m]")
    for axis in (every, spread, share):
        tidy(axis, grid=axis is not share)
    every.set_ylabel("height of the bucket tip [m]")
    slopes = list(dict.fromkeys(example["slope_degrees"] for example in result["examples"]))
    panels = np.atleast_1d(lower.subplots(1, len(slopes), sharey=True))
    for axis, slope in zip(panels, slopes, strict=True):
        x = np.array([-1.1, 0.0, 3.7])
        surface = np.maximum(x, 0.0) * math.tan(math.radians(slope))
        axis.fill_between(x, surface, color="#e9e2d6", lw=0)
        axis.plot(x, surface, color=FAINT, lw=0.8)
        here = [example for example in result["examples"] if example["slope_degrees"] == slope]
        for number, (example, colour) in enumerate(zip(here, (BLUE, ORANGE), strict=True), 1):
            label = f"a$_{number}$: {example['mass']:.2f} t"
            axis.plot(example["x"], example["z"], color=colour, lw=1.4, label=label)
        axis.set_title(f"slope {slope:.0f}°", fontsize=9.5)
        axis.legend(fontsize=7.5, frameon=False, loc="upper left")
        axis.set_xlim(-1.1, 3.7)
        axis.set_ylim(-0.05, 2.6)
        axis.set_xlabel("ahead [m]")
        tidy(axis)
    panels[0].set_ylabel("height [m]")
    write_bytes_atomic(folder / "tip_trajectories.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("tip_trajectories", run, draw)
