"""Errors and times of the performance predictors over all that the paper's grid search varies.

Paper, figure 18 and appendix B: activations, hidden layers, units, and cycles to train on. The
paper counts 480 models of ψ_low and ψ_high: two activations, 1 to 3 layers and ten widths make 60
of each, and four amounts of data 480. Beside them the same of our ψ_high.

Each training is a row in a file of its own: what was cut short goes on where it was, and several
machines share the work.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from experiments._common.results import dataset_summary
from experiments._common.training_rows import main
from wlplan.constants import QUANTITIES
from wlplan.dataset import Dataset
from wlplan.io import write_bytes_atomic
from wlplan.models.architecture import ACTIVATIONS
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy
from wlplan.studies.paper import PERFORMANCE
from wlplan.training.settings import PerformanceSettings, PsiHighSettings, PsiLowSettings

OURS = "psi_high, ours"
KINDS = ("psi_low", "psi_high", OURS)
LAYERS, UNITS = (1, 2, 3), tuple(2**n for n in range(3, 13))
# Cycles to train and validate on; 0: all. The paper says that they were increased from 100 to all
# 9,646 and names 3,000. The fourth amount is ours.
SAMPLES = (100, 1000, 3000, 0)
# The paper's errors are means of five trainings.
SEEDS = tuple(range(5))
# Passes over all the data; over fewer cycles as many more as make this many steps at least.
EPOCHS = {"psi_low": 150, "psi_high": 60, OURS: 150}
LEAST_STEPS, BATCH = 3000, 128
# Cycles that are not held out, about, and the part of them that is trained on.
_KNOWN, _TRAINED = 9_690, 8 / 9
# At how many units the data vary, and on how many cycles the units, as in the paper's figure.
UNITS_OVER_DATA = {"psi_low": 512, "psi_high": 2048, OURS: 512}
SAMPLES_OVER_SIZE = {"psi_low": 3000, "psi_high": 0, OURS: 0}
# What comes first is what these two need: the figure, with every other width.
FIRST_UNITS, FIRST_SAMPLES = UNITS[::2], (100, 3000, 0)
# Seconds of one core, of the convolutions of an Intel Xeon, all else of an AMD EPYC: to start and
# compile, of a step, of each weight in it, and of the convolutions.
_START, _STEP, _WEIGHT, _CONVOLUTIONS = 12.0, 1.0e-3, 1.1e-8, 23e-3


@dataclasses.dataclass(frozen=True)
class Run:
    """One training."""

    kind: str
    activation: str
    layers: int
    units: int
    samples: int
    seed: int

    @property
    def name(self) -> str:
        """As file names have it."""
        kind, samples = self.kind.replace(", ", "-"), self.samples or "all"
        return f"{kind}.{self.activation}.{self.layers}x{self.units}.{samples}.{self.seed}"

    @property
    def is_first(self) -> bool:
        """Whether it is of the part of the grid that comes first."""
        over_size = self.units in FIRST_UNITS and self.samples == SAMPLES_OVER_SIZE[self.kind]
        over_data = self.units == UNITS_OVER_DATA[self.kind] and self.samples in FIRST_SAMPLES
        return self.seed == 0 and (over_size or over_data)

    @property
    def settings(self) -> PerformanceSettings:
        """How it is trained: as `experiments.performance` does it, all by Huber's loss."""
        each: dict[str, Any] = {
            "activation": self.activation,
            "hidden": (self.units,) * self.layers,
            "samples": self.samples,
            "seed": self.seed,
            "epochs": max(EPOCHS[self.kind], math.ceil(LEAST_STEPS / self._steps_an_epoch)),
            "batch": BATCH,
        }
        if self.kind == "psi_low":
            return PsiLowSettings(**each)
        encoder = "principal" if self.kind == OURS else "convolutional"
        return PsiHighSettings(**each, encoder=encoder)

    @property
    def cost(self) -> float:
        """About how long it takes one core [s]."""
        weights = 20 * self.units + (self.layers - 1) * self.units**2
        step = _STEP + _WEIGHT * weights + (_CONVOLUTIONS if self.kind == "psi_high" else 0.0)
        return _START + step * self.settings.epochs * self._steps_an_epoch

    @property
    def _steps_an_epoch(self) -> int:
        return max(round(_TRAINED * (self.samples or _KNOWN)) // BATCH, 1)


def runs(preset: str) -> list[Run]:
    """All trainings of a preset, those that come first before the others, and cheap ones first."""
    if preset == "smoke":
        few = itertools.product(KINDS, ACTIVATIONS, (1,), (8,), (60,), (0,))
        return list(itertools.starmap(_Smoke, few))
    grid = itertools.product(KINDS, ACTIVATIONS, LAYERS, UNITS, SAMPLES, SEEDS)
    every = itertools.starmap(Run, grid)
    return sorted(every, key=lambda one: (not one.is_first, one.seed, one.cost))


class _Smoke(Run):
    """A training of seconds."""

    @property
    def settings(self) -> PerformanceSettings:
        return dataclasses.replace(super().settings, epochs=2)


def run(preset: str, data: Dataset, rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The result that rows come to.

    Args:
        preset: Of which they are a part.
        data: Data set that they are of.
        rows: Of the trainings that were made, by name.
    """
    every = runs(preset)
    done = [one for one in every if one.name in rows]
    parts = {
        "paper": [one for one in every if one.kind != OURS and one.seed == 0],
        "paper, five trainings each": [one for one in every if one.kind != OURS],
        "first": [one for one in every if one.is_first],
        "all": every,
    }
    table = [_summary(one, rows[one.name]) for one in done]
    timed = [one for one in done if rows[one.name]["training_s"] is not None]
    return {
        "data": dataset_summary(data),
        # Of each part of the grid: trainings, those that are there, and about how long one core
        # takes.
        "parts": {
            title: {
                "trainings": len(part),
                "done": sum(1 for one in part if one.name in rows),
                "hours": round(sum(one.cost for one in part) / 3600.0, 1),
            }
            for title, part in parts.items()
        },
        # Collected on so many kinds of processor, see `training_rows.recipe`.
        "datasets": len({rows[one.name]["dataset"] for one in done}),
        "trainings_timed": len(timed),
        "hours_taken": sum(rows[one.name]["training_s"] for one in timed) / 3600.0,
        "hours_foreseen_for_these": sum(one.cost for one in timed) / 3600.0,
        "columns": list(table[0]) if table else [],
        "rows": [list(row.values()) for row in table],
        "paper": {
            kind: {
                activation: PERFORMANCE[kind, activation]._asdict() for activation in ACTIVATIONS
            }
            | {"parameters": parameters, "cycles": cycles}
            for kind, parameters, cycles in (("psi_low", 5e5, 3000), ("psi_high", 1e7, 9646))
        },
    }


def _summary(one: Run, row: dict[str, Any]) -> dict[str, Any]:
    """What the result has of a training."""
    of_training = ("parameters", "epochs", "best_epoch", "epoch_s", "inference_s")
    return {
        **dataclasses.asdict(one),
        "cycles": sum(row["cycles"][:2]),
        **{quantity: float(f"{row['mean_relative'][quantity]:.4g}") for quantity in QUANTITIES},
        **{name: row[name] for name in (*of_training, "inference_of_a_batch_s")},
    }


def draw(folder: Path) -> None:
    """Errors over the cycles, errors over the size, times over the size; a line for each depth."""
    result = json.loads((folder / "hyperparameters.json").read_text())
    rows = [dict(zip(result["columns"], row, strict=True)) for row in result["rows"]]
    figure = new_figure(9.0, 7.6)
    panels = figure.subplots(3, 3)
    units = {kind: _shown(rows, kind, "units", UNITS_OVER_DATA) for kind in KINDS}
    samples = {kind: _shown(rows, kind, "samples", SAMPLES_OVER_SIZE) for kind in KINDS}
    over_data = [row for row in rows if row["units"] == units[row["kind"]]]
    over_size = [row for row in rows if row["samples"] == samples[row["kind"]]]
    for quantity, above, below in zip(QUANTITIES, panels[0], panels[1], strict=True):
        _lines(above, over_data, "cycles", quantity, 100.0)
        _lines(below, over_size, "parameters", quantity, 100.0)
        for panel, at in ((above, "cycles"), (below, "parameters")):
            panel.set_title(f"{quantity}, mean relative error [%]", fontsize=8)
            for kind, of_paper in result["paper"].items():
                for activation in ACTIVATIONS:
                    value = 100.0 * of_paper[activation][quantity]
                    panel.plot(of_paper[at], value, _CROSS[activation], ms=6, color=_COLOUR[kind])
    times = (
        ("training, per epoch [s]", "epoch_s", 1.0),
        ("inference of one input [ms]", "inference_s", 1e3),
        ("inference of each of 150 [ms]", "inference_of_a_batch_s", 1e3),
    )
    for (title, name, factor), panel in zip(times, panels[2], strict=True):
        _lines(panel, over_size, "parameters", name, factor)
        panel.set_yscale("log")
        # Whole decades, so that two of them at least are labelled.
        low, high = np.log10(panel.get_ylim())
        panel.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
        panel.set_title(title, fontsize=8)
    for row_of, label in zip(
        panels, ("cycles for training and validation", *["weights"] * 2), strict=True
    ):
        for panel in row_of:
            panel.set_xscale("log")
            for axis in (panel.xaxis, panel.yaxis):
                axis.set_minor_formatter(NullFormatter())
            panel.set_xlabel(label, fontsize=8, color=FAINT)
            tidy(panel)
    # What few cycles or a narrow network come to, beyond that, says nothing about the others.
    for above, below in zip(*panels[:2], strict=True):
        above.set_xlim(80.0, 12_000.0)
        above.set_ylim(0.0, 25.0)
        below.set_ylim(0.0, 12.0)
    handles = [
        Line2D([], [], color=_COLOUR[kind], label=_title(kind, units, samples))
        for kind in KINDS
        if any(row["kind"] == kind for row in rows)
    ]
    handles += [
        Line2D([], [], color=FAINT, ls=style, label=f"{n} hidden layer{'s' if n > 1 else ''}")
        for n, style in _STYLE.items()
    ]
    handles += [
        Line2D([], [], color=FAINT, ls="", marker=mark, mfc=fill, ms=4, label=label)
        for mark, fill, label in (
            ("o", None, "Swish"),
            ("o", "none", "Leaky ReLU"),
            (_CROSS["swish"], None, "paper, Swish, its own data"),
            (_CROSS["leaky_relu"], None, "paper, Leaky ReLU"),
        )
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    write_bytes_atomic(folder / "hyperparameters.png", png_bytes(figure))


_COLOUR = {"psi_low": BLUE, "psi_high": GREEN, OURS: ORANGE}
_STYLE = {1: ":", 2: "--", 3: "-"}
_CROSS = {"swish": "x", "leaky_relu": "+"}


def _shown(rows: Sequence[dict[str, Any]], kind: str, name: str, wanted: dict[str, int]) -> int:
    """The value at which a kind is shown: that of the paper's figure, or the largest there is."""
    found: set[int] = {row[name] for row in rows if row["kind"] == kind}
    if wanted[kind] in found or not found:
        return wanted[kind]
    return max(found)


def _title(kind: str, units: dict[str, int], samples: dict[str, int]) -> str:
    """A kind, and at what it is shown."""
    name = {"psi_low": "ψ_low", "psi_high": "ψ_high of the paper", OURS: "ψ_high, ours"}[kind]
    cycles = f"{samples[kind]:,}" if samples[kind] else "all"
    return f"{name}: above {units[kind]} units, below {cycles} cycles"


def _lines(
    panel: Axes, rows: Sequence[dict[str, Any]], across: str, up: str, factor: float
) -> None:
    """A line for each kind, depth and activation, through the means over the seeds."""
    for kind, layers, activation in itertools.product(KINDS, LAYERS, ACTIVATIONS):
        of_line = [
            row
            for row in rows
            if (row["kind"], row["layers"], row["activation"]) == (kind, layers, activation)
            and row[up] is not None
        ]
        points = sorted(_means(of_line, across, up))
        if points:
            x, y = np.array(points).T
            panel.plot(
                x,
                factor * y,
                marker="o",
                ms=3,
                mfc=None if activation == "swish" else "none",
                color=_COLOUR[kind],
                ls=_STYLE[layers],
                lw=0.9,
            )


def _means(rows: Sequence[dict[str, Any]], across: str, up: str) -> Iterator[tuple[float, float]]:
    """Places across, and the mean at each."""
    for at in {row[across] for row in rows}:
        yield at, float(np.mean([row[up] for row in rows if row[across] == at]))


if __name__ == "__main__":
    main("hyperparameters", runs, run, draw, first=lambda one: one.is_first)
