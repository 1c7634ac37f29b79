"""Errors of the performance predictors against the number of cycles they are trained on.

Paper, figure 18, its first column. The cycles for training and validation are drawn at random from
those that are not held out; all errors are on the same held-out part. Beside them the models that
ship: ensembles, trained on far more cycles, of other protocols too.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments._common.models import load_or_train, load_pretrained, smoke_settings
from experiments._common.results import dataset_summary, main
from wlplan.constants import QUANTITIES
from wlplan.dataset import Dataset, split
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.studies.paper import PERFORMANCE
from wlplan.training import KINDS, evaluate_performance

SIZES, SEEDS = (100, 300, 1000, 3000), 3
MODELS = {"psi_low": "ψ_low", "psi_high": "ψ_high (ours)"}
NAMES = tuple(QUANTITIES)
# With few cycles an epoch has few steps: then there are more epochs.
LEAST_STEPS, BATCH, EPOCHS = 3000, 128, 150
# The training function sets a tenth aside for a test of its own, which is not looked at.
_TRAINED, _USED = 0.8, 0.9


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Trains on parts of the data set of several sizes, and on all of it."""
    smoke = preset == "smoke"
    *known, test = split(data)
    pool = data.select(np.isin(data.rollout, np.concatenate([part.rollout for part in known])))
    sizes, seeds = ((60,), 1) if smoke else (SIZES, SEEDS)
    rows: dict[str, list[dict[str, Any]]] = {}
    for kind in MODELS:
        rows[kind] = []
        for size in (*sizes, None):
            each = []
            for seed in range(seeds):
                part, epochs = (data, EPOCHS) if size is None else _part(pool, size, seed)
                # As the models of `experiments.performance`, which need not be trained again.
                settings = KINDS[kind](seed=seed, epochs=epochs)
                model, _ = load_or_train(
                    models, part, smoke_settings(settings) if smoke else settings
                )
                report = evaluate_performance(model, test).every.mean_relative
                each.append([report[name] for name in NAMES])
            values = np.array(each)
            rows[kind].append(
                {
                    "cycles": len(pool) if size is None else size,
                    "mean": dict(zip(NAMES, values.mean(axis=0).tolist(), strict=True)),
                    "spread": dict(zip(NAMES, values.std(axis=0).tolist(), strict=True)),
                    "each": values.tolist(),
                }
            )
    return {
        "data": dataset_summary(data),
        "held_out": len(test),
        "models": rows,
        "ships": {kind: _shipped(kind, test) for kind in MODELS},
        # Of the cycles it trained on: 3,000 with psi_low, 9,646 with psi_high.
        "paper": {
            kind: {"cycles": count, **PERFORMANCE[kind, "swish"]._asdict()}
            for kind, count in (("psi_low", 3000), ("psi_high", 9646))
        },
    }


def _shipped(kind: str, test: Dataset) -> dict[str, Any]:
    """Cycles and errors of a model that ships."""
    model, description = load_pretrained(kind)
    report = evaluate_performance(model, test)
    return {
        "cycles": sum(description["training"]["cycles"][:2]),
        "mean": report.every.mean_relative,
    }


def _part(pool: Dataset, size: int, seed: int) -> tuple[Dataset, int]:
    """Random cycles, as many as to have `size` of them used, and how often to go over them."""
    count = min(round(size / _USED), len(pool))
    chosen = np.random.default_rng([seed, size]).choice(len(pool), count, replace=False)
    steps = max(round(_TRAINED * count) // BATCH, 1)
    return pool.select(np.sort(chosen)), max(EPOCHS, LEAST_STEPS // steps)


def draw(folder: Path) -> None:
    """Mean relative error over the number of cycles; each training a dot."""
    result = json.loads((folder / "learning_curve.json").read_text())
    figure = new_figure(8.4, 3.3)
    for k, (panel, quantity) in enumerate(zip(figure.subplots(1, 3), NAMES, strict=True)):
        for kind, colour in zip(MODELS, (BLUE, ORANGE), strict=True):
            rows = result["models"][kind]
            cycles = [row["cycles"] for row in rows]
            mean = [100.0 * row["mean"][quantity] for row in rows]
            panel.plot(cycles, mean, color=colour, label=f"{MODELS[kind]}, here")
            for row in rows:
                each = 100.0 * np.array(row["each"])[:, k]
                panel.plot(np.full(len(each), row["cycles"]), each, "o", ms=3, color=colour)
            paper = result["paper"][kind]
            label = f"{kind.replace('psi', 'ψ')}, paper, own data"
            at = 100.0 * paper[quantity]
            panel.plot(paper["cycles"], at, "x", ms=6, color=colour, label=label)
            ships = result["ships"][kind]
            at = 100.0 * ships["mean"][quantity]
            label = f"{MODELS[kind].removesuffix(' (ours)')}, as it ships"
            panel.plot(ships["cycles"], at, "s", ms=5, mfc="none", color=colour, label=label)
        panel.set_xscale("log")
        panel.set_xticks([*cycles, ships["cycles"]])
        panel.xaxis.set_major_formatter(lambda count, _: f"{count:,.0f}")
        panel.tick_params(axis="x", labelrotation=30)
        panel.minorticks_off()
        panel.set_ylim(bottom=0.0)
        panel.set_title(f"{quantity}, mean relative error [%]", fontsize=8)
        panel.set_xlabel("cycles for training and validation", fontsize=8, color=FAINT)
        tidy(panel)
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=7, frameon=False)
    write_bytes_atomic(folder / "learning_curve.png", png_bytes(figure))


if __name__ == "__main__":
    main("learning_curve", run, draw)
