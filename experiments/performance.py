"""Performance predictors on held-out cycles, over several trainings; what the shape tells.

Paper, table 1. ψ_low sees four characteristics of the pile, ψ_high the 36 x 36 map, and both the
same cycles: what ψ_high does better the characteristics do not tell.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.record import described, main
from wlplan.dataset import Dataset
from wlplan.io import write_bytes_atomic
from wlplan.plots import png_bytes
from wlplan.plots.paper import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.training import train_psi_high, train_psi_low

SEEDS = 3
MODELS = {
    "psi_low, swish": (train_psi_low, {"activation": "swish"}),
    "psi_low, leaky relu": (train_psi_low, {"activation": "leaky_relu"}),
    "psi_high, swish": (train_psi_high, {"activation": "swish"}),
    "psi_high, leaky relu": (train_psi_high, {"activation": "leaky_relu"}),
}
# Mean relative errors [1]: mass, time, work (table 1).
PAPER = {
    "psi_low, swish": (0.0758, 0.0541, 0.0847),
    "psi_high, swish": (0.0570, 0.0443, 0.0698),
    "psi_high, leaky relu": (0.0447, 0.0361, 0.0590),
}
NAMES = ("mass", "time", "work")


def run(preset: str, data: Dataset) -> dict[str, Any]:
    """Trains every model with several seeds on the same split and reports on its test part."""
    smoke = preset == "smoke"
    rows: dict[str, Any] = {}
    for name, (train, options) in MODELS.items():
        errors, seconds = [], []
        for seed in range(2 if smoke else SEEDS):
            begin = time.perf_counter()
            short: dict[str, Any] = {"epochs": 2, "hidden": (32,)} if smoke else {}
            _, report = train(data, seed=seed, **options, **short)
            seconds.append(time.perf_counter() - begin)
            errors.append(
                [
                    [part.mean_relative[quantity] for quantity in NAMES]
                    for part in (report.every, report.loaded)
                ]
            )
            jax.clear_caches()
        values = np.array(errors)
        rows[name] = {
            "cycles": report.every.cycles,
            "cycles_loaded": report.loaded.cycles,
            "training_s": float(np.median(seconds)),
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
    told = 1.0 - high.mean(axis=0) / low.mean(axis=0)
    return {
        "data": described(data),
        "loaded_from_t": report.loaded_mass,
        "models": rows,
        "paper": {name: dict(zip(NAMES, values, strict=True)) for name, values in PAPER.items()},
        "less_error_with_the_map": dict(zip(NAMES, told.tolist(), strict=True)),
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
        panel.set_title(f"{quantity}, mean relative error [%]", fontsize=8)
        panel.set_yticks([-row for row in range(len(names))], names, fontsize=8)
        tidy(panel)
    figure.supxlabel("dots: trainings; bar: the paper's, on its own data", fontsize=8)
    write_bytes_atomic(folder / "performance.png", png_bytes(figure))


if __name__ == "__main__":
    main("performance", run, draw)
