"""Errors, inference and training time of the performance predictors against their size.

Paper, figure 18, the columns over the number of parameters. Hidden layers and units vary, all else
is as in `experiments.performance`: Swish, the whole data set, one training each.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

from experiments._common.models import load_or_train, smoke_settings
from experiments._common.results import dataset_summary, main
from experiments.learning_curve import MODELS
from wlplan.constants import QUANTITIES
from wlplan.dataset import Dataset, split
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.studies.bench.inference import performance_times
from wlplan.studies.paper import PERFORMANCE
from wlplan.training import KINDS, evaluate_performance

LAYERS, UNITS = (1, 2, 3), (8, 32, 128, 512)
EPOCHS = 150
# Sizes of the paper's models of special interest, from its text.
PARAMETERS = {"psi_low": 5e5, "psi_high": 1e7}


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Trains one network of each size."""
    smoke = preset == "smoke"
    test = split(data)[2]
    layers, units = ((1, 2), (8,)) if smoke else (LAYERS, UNITS)
    rows = []
    for kind, count, each in itertools.product(MODELS, layers, units):
        settings = KINDS[kind](epochs=EPOCHS)
        settings = smoke_settings(settings) if smoke else settings
        settings = dataclasses.replace(settings, hidden=(each,) * count)
        model, seconds = load_or_train(models, data, settings)
        one, batch = performance_times(model, test)
        rows.append(
            {
                "kind": kind,
                "layers": count,
                "units": each,
                "parameters": _parameters(model),
                "mean_relative": evaluate_performance(model, test).every.mean_relative,
                "inference_s": one.call.median,
                "inference_of_a_batch_s": batch.each,
                "epoch_s": None if seconds is None else seconds / settings.epochs,
            }
        )
    return {
        "data": dataset_summary(data),
        "batch": batch.inputs,
        "rows": rows,
        "paper": {
            kind: {"parameters": PARAMETERS[kind], **PERFORMANCE[kind, "swish"]._asdict()}
            for kind in MODELS
        },
    }


def _parameters(model: Any) -> int:
    """Number of the weights that are trained."""
    network = nnx.merge(model.graph, model.params)
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(network, nnx.Param)))


def draw(folder: Path) -> None:
    """Errors above, times below, over the number of parameters; a line for each depth."""
    result = json.loads((folder / "model_size.json").read_text())
    figure = new_figure(8.4, 5.2)
    above, below = figure.subplots(2, 3, sharex=True)
    columns = [
        *(
            (panel, f"{n}, mean relative error [%]", n)
            for panel, n in zip(above, QUANTITIES, strict=True)
        ),
        (below[0], "inference of one input [ms]", "inference_s"),
        (below[1], f"of each of {result['batch']} [ms]", "inference_of_a_batch_s"),
        (below[2], "training, per epoch [s]", "epoch_s"),
    ]
    depths = sorted({row["layers"] for row in result["rows"]})
    styles = dict(zip(depths, (":", "--", "-"), strict=False))
    for panel, title, name in columns:
        for kind, colour in zip(MODELS, (BLUE, ORANGE), strict=True):
            for depth in depths:
                rows = [r for r in result["rows"] if (r["kind"], r["layers"]) == (kind, depth)]
                size = [row["parameters"] for row in rows]
                if name in QUANTITIES:
                    values = [100.0 * row["mean_relative"][name] for row in rows]
                else:
                    factor = 1.0 if name == "epoch_s" else 1e3
                    values = [np.nan if r[name] is None else factor * r[name] for r in rows]
                label = f"{MODELS[kind]}, {depth} hidden layer{'s' if depth > 1 else ''}"
                panel.plot(size, values, "o", ls=styles[depth], ms=3, color=colour, label=label)
            paper = result["paper"][kind]
            papers = {n: 100.0 * paper[n] for n in QUANTITIES} | {
                "inference_s": 1e3 * paper["inference"]
            }
            if name in papers:
                label = f"{kind.replace('psi', 'ψ')}, paper"
                panel.plot(paper["parameters"], papers[name], "x", ms=6, color=colour, label=label)
        panel.set_xscale("log")
        panel.set_ylim(bottom=0.0)
        panel.set_title(title, fontsize=8)
        tidy(panel)
    for panel in below:
        panel.set_xlabel("parameters that are trained", fontsize=8, color=FAINT)
    handles, labels = above[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=2,
        fontsize=7,
        frameon=False,
        handlelength=4,
    )
    write_bytes_atomic(folder / "model_size.png", png_bytes(figure))


if __name__ == "__main__":
    main("model_size", run, draw)
