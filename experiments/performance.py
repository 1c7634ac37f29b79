"""Performance predictors on held-out cycles, over several trainings; what the shape tells.

Paper, table 1. ψ_low sees four characteristics of the pile, ψ_high the 36 x 36 map, and both the
same cycles: what ψ_high does better the characteristics do not tell.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments._common.models import PREDICTORS, load_or_train, smoke_settings
from experiments._common.results import dataset_summary, main
from wlplan.constants import QUANTITIES
from wlplan.dataset import Dataset, split
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.studies.paper import PERFORMANCE
from wlplan.training import evaluate_performance

# Trainings of each model; of the paper's ψ_high, which takes five minutes, one.
SEEDS, SEEDS_OF_THE_PAPERS = 5, 1
NAMES = tuple(QUANTITIES)


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Trains every model with several seeds on the same split and reports on its test part."""
    smoke = preset == "smoke"
    test = split(data)[2]
    rows: dict[str, Any] = {}
    for name, settings in PREDICTORS.items():
        papers = name.startswith("psi_high of the paper")
        seeds = SEEDS_OF_THE_PAPERS if papers or smoke else SEEDS
        errors, times = [], []
        for seed in range(seeds):
            chosen = dataclasses.replace(smoke_settings(settings) if smoke else settings, seed=seed)
            model, seconds = load_or_train(models, data, chosen)
            times.append(seconds)
            report = evaluate_performance(model, test)
            errors.append(
                [
                    [part.mean_relative[quantity] for quantity in NAMES]
                    for part in (report.every, report.loaded)
                ]
            )
        values = np.array(errors)
        known = [seconds for seconds in times if seconds is not None]
        rows[name] = {
            "cycles": report.every.cycles,
            "cycles_loaded": report.loaded.cycles,
            "training_s": float(np.median(known)) if known else None,
            **{
                part: {
                    "mean": dict(zip(NAMES, values[:, k].mean(axis=0).tolist(), strict=True)),
                    "spread": dict(zip(NAMES, values[:, k].std(axis=0).tolist(), strict=True)),
                    "each": values[:, k].tolist(),
                }
                for k, part in enumerate(("every", "loaded"))
            },
        }
    low, high = (np.array(rows[f"psi_{k}, swish"]["every"]["each"]) for k in ("low", "high"))
    reduction = 1.0 - high.mean(axis=0) / low.mean(axis=0)
    paper = {
        name: PERFORMANCE[settings.kind, settings.activation]._asdict()
        for name, settings in PREDICTORS.items()
    }
    return {
        "data": dataset_summary(data),
        "loaded_from_t": report.loaded_mass,
        "models": rows,
        "paper": paper,
        "less_error_with_the_map": dict(zip(NAMES, reduction.tolist(), strict=True)),
    }


def draw(folder: Path) -> None:
    """Mean relative errors, each training a dot, the paper's a bar."""
    result = json.loads((folder / "performance.json").read_text())
    figure = new_figure(7.2, 2.9)
    panels = figure.subplots(1, 3, sharey=True)
    names = list(result["models"])
    for k, (panel, quantity) in enumerate(zip(panels, NAMES, strict=True)):
        for row, name in enumerate(names):
            each = 100.0 * np.array(result["models"][name]["every"]["each"])[:, k]
            colour = BLUE if "low" in name else ORANGE
            panel.plot(each, np.full(len(each), -row), "o", ms=4, alpha=0.7, color=colour)
            if name in result["paper"]:
                at = 100.0 * result["paper"][name][quantity]
                panel.plot([at], [-row], "|", ms=14, color=FAINT)
        panel.set_xlim(left=0.0)
        panel.set_title(quantity, fontsize=8)
        labels = [name.replace("psi", "ψ") for name in names]
        panel.set_yticks([-row for row in range(len(names))], labels, fontsize=8)
        tidy(panel)
    text = "mean relative error [%]; dots: trainings here; bar: the paper's, on its own data"
    figure.supxlabel(text, fontsize=8)
    write_bytes_atomic(folder / "performance.png", png_bytes(figure))


if __name__ == "__main__":
    main("performance", run, draw)
