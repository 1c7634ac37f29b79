"""The data set: ranges, trends with the shape of the pile, and what digging faster does.

Paper, figure 17: the distributions of mass, time and work, and how they go with slope, incidence
and curvatures (appendix A).
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from experiments._common.resimulation import initial_surfaces, resimulate
from experiments._common.results import dataset_summary, main
from wlplan.constants import J_PER_KJ, KG_PER_TONNE
from wlplan.dataset import Dataset
from wlplan.engines.simulator import dig
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.site.machine import WA320, WheelLoader

SEED = 0
# Outcomes with their unit, and the range that the paper gives for its data set (appendix A).
OUTCOMES = {
    "mass": ("t", (1.0, 4.5)),
    "time": ("s", (7.0, 25.0)),
    "work": ("kJ", (200.0, 1100.0)),
    "productivity": ("t/min", None),
    "work_per_tonne": ("kJ/t", None),
}
# Averages over 40 loads with random actions in the paper's simulator (table 3, ground truth).
PAPER_MEANS = {"mass": 116.0 / 40.0, "time": 443.0 / 40.0, "work": 17.9e3 / 40.0}
# Characteristics with their unit and symbol.
SHAPE = {
    "slope": ("°", "θ"),
    "incidence": ("°", "α"),
    "curvature_x": ("1/m", "κ$_x$"),
    "curvature_y": ("1/m", "κ$_y$"),
}
# Loads below this are too small to divide by [t].
LEAST_MASS = 0.5
# Speeds of the machine over its own, for what digging faster does.
FACTORS = (0.75, 1.0, 1.25)
SPEEDS = {
    "drive": ("travel_speed",),
    "drive, boom and bucket": ("travel_speed", "boom_speed", "tilt_speed"),
}
# Moving average: the share of the cycles under its window, and where it is taken.
WINDOW, MOMENTS = 0.05, 60
POINTS, BINS = 700, 30


def run(preset: str, data: Dataset) -> dict[str, Any]:
    """Ranges, rank correlations with their spread, moving averages, and faster machines."""
    smoke = preset == "smoke"
    data = data.select(data.valid)
    outcomes, shape = _outcomes(data), _shape(data)
    return {
        "data": dataset_summary(data),
        "stop_reasons": np.bincount(data.stop_reason, minlength=4).tolist(),
        # Of the time in which buckets fill, by what ends it: steps of the simulator go with it.
        "parts_of_filling": (
            np.bincount(data.stop_reason, data.fill_time, 4) / data.fill_time.sum()
        )
        .round(4)
        .tolist(),
        "ranges": {name: _range(name, values) for name, values in outcomes.items()},
        "shape_ranges": {name: _percentiles(values) for name, values in shape.items()},
        "shape_correlations": np.corrcoef(
            np.apply_along_axis(stats.rankdata, 1, np.array(list(shape.values())))
        )
        .round(3)
        .tolist(),
        "correlations": _correlations(data, outcomes, shape, 20 if smoke else 300),
        "faster": _faster(data, 32 if smoke else 512),
        "curves": _curves(outcomes, shape),
        "histograms": {name: _histogram(values) for name, values in (outcomes | shape).items()},
        "points": _points(outcomes | shape),
    }


def _outcomes(data: Dataset) -> dict[str, np.ndarray]:
    """Outcomes of each cycle; the energy a tonne is NaN where there is next to no load."""
    enough = np.where(data.mass > LEAST_MASS, data.mass, np.nan)
    values = {
        "mass": data.mass,
        "time": data.time,
        "work": data.work,
        "productivity": 60.0 * data.mass / data.time,
        "work_per_tonne": data.work / enough,
    }
    return {name: value.astype(np.float64) for name, value in values.items()}


def _shape(data: Dataset) -> dict[str, np.ndarray]:
    """Characteristics of each cycle, angles in degrees."""
    columns = data.characteristics.astype(np.float64).T
    return dict(zip(SHAPE, (*np.degrees(columns[:2]), *columns[2:]), strict=True))


def _percentiles(values: np.ndarray) -> dict[str, float]:
    values = values[np.isfinite(values)]
    marks = np.percentile(values, [0, 1, 5, 50, 95, 99, 100])
    names = ("least", "p1", "p5", "median", "p95", "p99", "largest")
    return {**dict(zip(names, marks.tolist(), strict=True)), "mean": float(values.mean())}


def _range(name: str, values: np.ndarray) -> dict[str, Any]:
    """Percentiles, and how they compare with the paper's."""
    paper = OUTCOMES[name][1]
    result: dict[str, Any] = {**_percentiles(values), "unit": OUTCOMES[name][0]}
    if paper is not None:
        inside = (values >= paper[0]) & (values <= paper[1])
        result |= {"paper": paper, "paper_mean": PAPER_MEANS[name], "inside": float(inside.mean())}
    return result


def _correlations(
    data: Dataset, outcomes: dict[str, np.ndarray], shape: dict[str, np.ndarray], repeats: int
) -> dict[str, dict[str, Any]]:
    """Rank correlations of every outcome with every characteristic, plain and partial.

    Partial: what is left when the other three characteristics and the action are held fixed.
    The spread is a bootstrap over rollouts, since cycles of a rollout dig the same pile.
    """
    enough = np.isfinite(outcomes["work_per_tonne"])
    columns = np.column_stack([*shape.values(), data.action, *outcomes.values()])[enough]
    rollouts = data.rollout[enough]
    numbers = np.unique(rollouts)
    members = [np.flatnonzero(rollouts == number) for number in numbers]
    random = np.random.default_rng(SEED)
    whole = _rank_correlations(columns)
    drawn = []
    for _ in range(repeats):
        picked = random.integers(len(members), size=len(members))
        drawn.append(_rank_correlations(columns[np.concatenate([members[k] for k in picked])]))
    spread = np.percentile(drawn, [2.5, 97.5], axis=0)
    return {
        outcome: {
            characteristic: {
                kind: {
                    "value": round(float(whole[n, i, j]), 4),
                    "from": round(float(spread[0, n, i, j]), 4),
                    "to": round(float(spread[1, n, i, j]), 4),
                }
                for n, kind in enumerate(("plain", "partial"))
            }
            for j, characteristic in enumerate(SHAPE)
        }
        for i, outcome in enumerate(OUTCOMES)
    }


def _rank_correlations(columns: np.ndarray) -> np.ndarray:
    """Plain and partial rank correlations [2, outcome, characteristic]."""
    given = len(SHAPE) + 4
    ranks = np.apply_along_axis(stats.rankdata, 0, columns)
    matrix = np.corrcoef(ranks, rowvar=False)
    result = np.empty((2, len(OUTCOMES), len(SHAPE)))
    for i in range(len(OUTCOMES)):
        which = [*range(given), given + i]
        inverse = np.linalg.inv(matrix[np.ix_(which, which)])
        partial = -inverse[-1] / np.sqrt(inverse[-1, -1] * np.diag(inverse))
        result[:, i] = matrix[given + i, : len(SHAPE)], partial[: len(SHAPE)]
    return result


def _faster(data: Dataset, count: int) -> dict[str, Any]:
    """The same cycles with a machine that drives, or does everything, slower and faster."""
    random = np.random.default_rng(SEED)
    some = data.select(random.choice(len(data), min(count, len(data)), replace=False))
    surface = initial_surfaces(some)
    result: dict[str, Any] = {"cycles": len(some)}
    simulated: dict[WheelLoader, tuple[np.ndarray, ...]] = {}
    for name, fields in SPEEDS.items():
        rows = []
        for factor in FACTORS:
            scaled = {field: factor * getattr(WA320, field) for field in fields}
            machine = dataclasses.replace(WA320, **scaled)
            if machine not in simulated:
                simulated[machine] = _simulate(machine, surface, some.action)
            rows.append(simulated[machine])
        mass, time, work, fill = (np.array(column) for column in zip(*rows, strict=True))
        each = {
            "productivity": 60.0 * mass / time,
            "work_per_tonne": work / mass,
            "mass": mass,
            "fill_time": fill,
        }
        # In all, so that next to empty buckets do not count for more than they are.
        in_all = {
            "productivity": 60.0 * mass.sum(axis=1) / time.sum(axis=1),
            "work_per_tonne": work.sum(axis=1) / mass.sum(axis=1),
            "mass": mass.mean(axis=1),
            "fill_time": fill.mean(axis=1),
        }
        own = FACTORS.index(1.0)
        result[name] = [
            {
                "factor": factor,
                **{what: float(values[k]) for what, values in in_all.items()},
                # Share of the cycles in which it is more than with the machine's own speed.
                **{f"{w}_more": float((v[k] > v[own]).mean()) for w, v in each.items()},
            }
            for k, factor in enumerate(FACTORS)
        ]
        if name == "drive":
            # The maps of the data set do not give the height of the floor exactly: what that does.
            error = np.abs(mass[own] - some.mass)
            result["replayed_mass_error"] = {
                "median": float(np.median(error)),
                "p99": float(np.percentile(error, 99)),
            }
    return result


def _simulate(
    machine: WheelLoader, surface: np.ndarray, action: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Mass [t], time [s], work [kJ] and time of filling [s] with a machine."""
    cycle = resimulate(
        lambda *inputs: dig(*inputs, machine=machine).replace(height=0.0), surface, action
    )
    work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
    return cycle.mass / KG_PER_TONNE, cycle.time, work / J_PER_KJ, cycle.fill_time


def _curves(outcomes: dict[str, np.ndarray], shape: dict[str, np.ndarray]) -> dict[str, Any]:
    """Moving averages of the outcomes over the characteristics."""
    curves: dict[str, Any] = {}
    for given, x in shape.items():
        order = np.argsort(x, kind="stable")
        width = max(int(WINDOW * len(x)), 5)
        first = np.linspace(0, len(x) - width, min(MOMENTS, len(x) - width + 1)).astype(int)
        windows = order[first[:, None] + np.arange(width)]
        curves[given] = {
            "at": x[windows].mean(axis=1).round(4).tolist(),
            **{
                name: np.nanmean(values[windows], axis=1).round(4).tolist()
                for name, values in outcomes.items()
            },
        }
    return curves


def _histogram(values: np.ndarray) -> dict[str, list[float]]:
    """Counts between the 0.2 and 99.5 percentiles; what is further out is in the outermost bins."""
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, [0.2, 99.5])
    count, edges = np.histogram(np.clip(values, low, high), bins=BINS)
    return {"count": count.tolist(), "edges": edges.round(4).tolist()}


def _points(columns: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """Some of the cycles, for a scatter plot."""
    table = np.array(list(columns.values()))
    table = table[:, np.isfinite(table).all(axis=0)]
    random = np.random.default_rng(SEED)
    some = random.choice(table.shape[1], min(POINTS, table.shape[1]), replace=False)
    return {
        name: [float(f"{value:.4g}") for value in row]
        for name, row in zip(columns, table[:, some], strict=True)
    }


def draw(folder: Path) -> None:
    """Distributions on the left; each outcome over each characteristic with its moving average."""
    result = json.loads((folder / "dataset_overview.json").read_text())
    figure = new_figure(12.5, 11.0)
    panels = figure.subplots(
        len(OUTCOMES), 1 + len(SHAPE), sharey="row", width_ratios=[0.7, *[1.0] * len(SHAPE)]
    )
    for row, (name, (unit, paper)) in zip(panels, OUTCOMES.items(), strict=True):
        histogram = result["histograms"][name]
        edges = np.array(histogram["edges"])
        row[0].barh(edges[:-1], histogram["count"], np.diff(edges), align="edge", color=BLUE)
        row[0].set_ylabel(f"{name.replace('work_per_tonne', 'work a tonne')} [{unit}]")
        if paper is not None:
            for end in paper:
                row[0].axhline(end, color=ORANGE, lw=1, ls="--")
            text = f"paper: {paper[0]:g} to {paper[1]:g} {unit}"
            row[0].set_title(text, fontsize=8.5, color=ORANGE)
        for axis, (given, (shape_unit, symbol)) in zip(row[1:], SHAPE.items(), strict=True):
            points, curve = result["points"], result["curves"][given]
            axis.plot(points[given], points[name], ".", ms=2.5, color=BLUE, alpha=0.35)
            axis.plot(curve["at"], curve[name], color=ORANGE, lw=1.8)
            correlation = result["correlations"][name][given]
            axis.set_title(
                f"r = {correlation['plain']['value']:+.2f}, "
                f"partial {correlation['partial']['value']:+.2f}",
                fontsize=8.5,
                color=FAINT,
            )
            edges = result["histograms"][given]["edges"]
            axis.set_xlim(edges[0], edges[-1])
            if name == "work_per_tonne":
                axis.set_xlabel(f"{given.replace('_', ' ')} {symbol} [{shape_unit}]")
        edges = histogram["edges"]
        row[0].set_ylim(edges[0], edges[-1])
    panels[-1, 0].set_xlabel("cycles")
    for axis in panels.flat:
        tidy(axis)
    write_bytes_atomic(folder / "dataset_overview.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("dataset_overview", run, draw)
