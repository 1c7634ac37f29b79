"""From the paper's training to ours, a step at a time: what data, training and network are worth.

Paper, table 1 and section 6.4.1. The first row of either predictor is trained as the paper says, on
cycles of our simulator; each row below changes one thing more, down to ours, and the last is what
ships. Each training is a row in a file of its own: what was cut short goes on where it was.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments._common.models import load_pretrained
from experiments._common.results import dataset_summary
from experiments._common.training_rows import main
from wlplan.constants import QUANTITIES
from wlplan.dataset import Dataset, split
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.studies.paper import PERFORMANCE
from wlplan.training import evaluate_performance
from wlplan.training.settings import PerformanceSettings, PsiHighSettings, PsiLowSettings

SEEDS = (0, 1, 2)
# The paper does not give the size of a batch. What it gives of an epoch and of an inference, 0.27 s
# to 0.31 ms and 1.9 s to 1.13 ms, has room for a few hundred steps: batches of 16 to 32.
# Nor does it say when a training has converged: here, after a hundred epochs that are no better.
PAPER: dict[str, Any] = {
    "split": "cycle",
    "scaling": "min-max",
    "loss": "squared",
    "optimiser": "adam",
    "learning_rate": 1e-5,
    "batch": 32,
    "dropout": 0.1,
    "epochs": 2000,
    "patience": 100,
}
_LOW: dict[str, Any] = {"hidden": (512, 512), "samples": 3000}
_HIGH: dict[str, Any] = {"hidden": (2048, 2048), "encoder": "convolutional", "mirrored": 0.0}
_OPTIMISER = ("optimiser", "learning_rate", "batch", "patience")


@dataclasses.dataclass(frozen=True)
class Step:
    """A training that differs from the one above it by one thing."""

    kind: str
    change: str  # what is other than in the step before
    part: str  # of the difference to the paper: data, training, network
    settings: PerformanceSettings

    @property
    def name(self) -> str:
        """As file names have it."""
        words = "-".join(re.sub(r"[^\w ]", "", self.change).split())
        return f"{self.kind}.{words}.{self.settings.seed}"

    @property
    def is_slow(self) -> bool:
        """Whether it takes hours."""
        adam = self.settings.optimiser == "adam"
        return self.kind == "psi_high" and adam and self.settings.epochs > 250


def steps(preset: str) -> list[Step]:
    """All trainings of a preset, those of many hours last."""
    if preset == "smoke":
        both = [list(every(0)) for every in (_low, _high)]
        ends = [step for every in both for step in (every[0], every[-1])]
        return [
            dataclasses.replace(
                step, settings=dataclasses.replace(step.settings, hidden=(8,), epochs=2)
            )
            for step in ends
        ]
    found = [step for seed in SEEDS for step in (*_low(seed), *_high(seed))]
    return sorted(found, key=lambda step: (step.is_slow, step.settings.seed))


def _low(seed: int) -> Iterator[Step]:
    settings = PsiLowSettings(**PAPER | _LOW, seed=seed)
    yield Step("psi_low", "as the paper says", "data", settings)
    settings = dataclasses.replace(settings, split="rollout")
    yield Step("psi_low", "held out by pile", "training", settings)
    settings = _with_our(settings, *_OPTIMISER, epochs=150)
    yield Step("psi_low", "AdamW, cosine, 150 epochs", "training", settings)
    settings = _with_our(settings, "scaling")
    yield Step("psi_low", "scaled by the spread", "training", settings)
    settings = _with_our(settings, "loss")
    yield Step("psi_low", "Huber's loss", "training", settings)
    settings = _with_our(settings, "dropout")
    yield Step("psi_low", "less dropout", "training", settings)
    settings = _with_our(settings, "samples")
    yield Step("psi_low", "all cycles", "data", settings)


def _high(seed: int) -> Iterator[Step]:
    settings = PsiHighSettings(**PAPER | _HIGH, seed=seed)
    yield Step("psi_high", "as the paper says", "data", settings)
    settings = dataclasses.replace(settings, epochs=250)
    yield Step("psi_high", "250 epochs of it", "training", settings)
    settings = dataclasses.replace(settings, epochs=60)
    yield Step("psi_high", "60 epochs of it", "training", settings)
    settings = dataclasses.replace(settings, split="rollout")
    yield Step("psi_high", "held out by pile", "training", settings)
    settings = _with_our(settings, *_OPTIMISER)
    yield Step("psi_high", "AdamW, cosine", "training", settings)
    settings = _with_our(settings, "scaling", "mirrored")
    yield Step("psi_high", "scaled by the spread, mirrored", "training", settings)
    settings = _with_our(settings, "loss")
    yield Step("psi_high", "Huber's loss", "training", settings)
    settings = _with_our(settings, "encoder", "hidden", epochs=150)
    yield Step("psi_high", "components of the map, 2 x 512, 150 epochs", "network", settings)


def _with_our(settings: Any, *names: str, **other: Any) -> Any:
    """Settings with our defaults of some, and others as given."""
    defaults = {
        field.name: field.default for field in dataclasses.fields(settings) if field.name in names
    }
    return dataclasses.replace(settings, **defaults, **other)


def run(preset: str, data: Dataset, rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The result that rows come to.

    Args:
        preset: Of which they are a part.
        data: Data set that they are of.
        rows: Of the trainings that were made, by name.
    """
    table: dict[str, list[dict[str, Any]]] = {}
    # In the order of the steps, which is not the one in which they are made.
    for kind, every in (("psi_low", _low), ("psi_high", _high)):
        table[kind] = [_summary(step, rows) for step in every(SEEDS[0])]
        table[kind].append(_shipped(kind, data))
    return {
        "data": dataset_summary(data),
        "patience": PAPER["patience"],
        "paper": {
            kind: {"cycles": cycles, **PERFORMANCE[kind, "swish"]._asdict()}
            for kind, cycles in (("psi_low", 3000), ("psi_high", 9646))
        },
        "steps": table,
    }


def _summary(step: Step, rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A step, over the seeds that are there."""
    seeds = [
        dataclasses.replace(step, settings=dataclasses.replace(step.settings, seed=seed))
        for seed in SEEDS
    ]
    found = [rows[one.name] for one in seeds if one.name in rows]
    row: dict[str, Any] = {"change": step.change, "part": step.part, "trainings": len(found)}
    if not found:
        return row
    errors = np.array([[one["mean_relative"][name] for name in QUANTITIES] for one in found])
    means = errors.mean(axis=0).tolist()
    return {
        **row,
        "cycles": sum(found[0]["cycles"][:2]),
        "mean": dict(zip(QUANTITIES, means, strict=True)),
        "each": errors.tolist(),
        "epochs": [one["epochs"] for one in found],
        "best_epoch": [one["best_epoch"] for one in found],
        "converged": [_is_converged(one) for one in found],
        "epoch_s": found[0]["epoch_s"],
        "parameters": found[0]["parameters"],
    }


def _is_converged(row: dict[str, Any]) -> bool:
    """Whether a training ended by itself: by patience, or with a schedule that ends at nothing."""
    settings = row["made_with"]["settings"]
    return bool(settings["optimiser"] == "adamw" or row["epochs"] < settings["epochs"])


def _shipped(kind: str, data: Dataset) -> dict[str, Any]:
    """What ships, on the cycles that models which are split by pile are held to."""
    model, description = load_pretrained(kind)
    errors = evaluate_performance(model, split(data)[2]).every.mean_relative
    hidden = description["architecture"]["hidden"]
    return {
        "change": f"as it ships: an ensemble of {len(hidden)} x {hidden[0]}",
        "part": "data and network",
        "trainings": 1,
        "cycles": sum(description["training"]["cycles"][:2]),
        "mean": errors,
        "each": [[errors[name] for name in QUANTITIES]],
        "converged": [True],
    }


def draw(folder: Path) -> None:
    """Mean relative errors, a row for each step, each training a dot; the paper's a cross."""
    result = json.loads((folder / "protocol.json").read_text())
    rows = [
        (kind, row)
        for kind, of_kind in result["steps"].items()
        for row in ({"change": "the paper, on its own data"}, *of_kind)
    ]
    figure = new_figure(9.0, 5.0)
    for k, (panel, quantity) in enumerate(
        zip(figure.subplots(1, 3, sharey=True), QUANTITIES, strict=True)
    ):
        for at, (kind, row) in enumerate(rows):
            colour = BLUE if kind == "psi_low" else ORANGE
            if "part" not in row:
                panel.plot(100.0 * result["paper"][kind][quantity], -at, "x", color=colour)
            for each, converged in zip(row.get("each", ()), row.get("converged", ()), strict=True):
                fill = colour if converged else "none"
                panel.plot(100.0 * each[k], -at, "o", ms=4, mfc=fill, color=colour)
        panel.set_yticks([-at for at in range(len(rows))], [_label(*row) for row in rows])
        panel.tick_params(axis="y", labelsize=7)
        panel.set_xlim(left=0.0)
        panel.set_title(f"{quantity}, mean relative error [%]", fontsize=8)
        tidy(panel)
    text = "dots: trainings on our data, with the changes of all rows above; empty: not converged"
    figure.supxlabel(text, fontsize=8, color=FAINT)
    write_bytes_atomic(folder / "protocol.png", png_bytes(figure))


def _label(kind: str, row: dict[str, Any]) -> str:
    """What a row is of, and what is missing of it."""
    name = {"psi_low": "ψ_low", "psi_high": "ψ_high"}[kind]
    if "part" not in row:
        return f"{name}: {row['change']}"
    if not row["trainings"]:
        return f"{row['change']} (not there yet)"
    if not all(row["converged"]):
        return f"{row['change']} (not converged after {max(row['epochs'])} epochs)"
    return str(row["change"])


if __name__ == "__main__":
    main("protocol", steps, run, draw)
