"""How well the ensembles that ship know their own errors, on cycles new to them.

The first row: of the cycles, how many lie inside an interval, over how many should. The second: the
cycles sorted by the deviation that was predicted, and what they were off.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from scipy.stats import norm

from experiments._common.models import load_pretrained
from experiments._common.results import dataset_summary, main
from wlplan.dataset import Dataset
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.training import held_out
from wlplan.training.evaluation import predict_with_deviation

MODELS = ("psi_low", "psi_high")
OUTCOMES = {"mass": "t", "time": "s", "work": "kJ"}
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
BINS = 10


def run(preset: str, data: Dataset) -> dict[str, Any]:
    """Coverage of central intervals, and errors in bins of the predicted deviation."""
    del preset  # nothing is trained: it takes seconds
    rows: dict[str, Any] = {}
    for kind in MODELS:
        ensemble, description = load_pretrained(kind)
        part = held_out(data, description)
        part = part.select(part.valid)
        predicted, deviation = predict_with_deviation(ensemble, part)
        rows[kind] = {"cycles": len(part), "members": ensemble.size}
        for name in OUTCOMES:
            error = np.asarray(getattr(predicted, name), np.float64) - getattr(part, name)
            rows[kind][name] = reliability(error, np.asarray(getattr(deviation, name), np.float64))
    return {"data": dataset_summary(data), "levels": LEVELS, "models": rows}


def reliability(
    error: Float[np.ndarray, " n"], deviation: Float[np.ndarray, " n"]
) -> dict[str, list[float]]:
    """Coverage at each of `LEVELS`, and the errors where the deviation is small to large.

    Args:
        error: Predicted less simulated.
        deviation: Standard deviation that was predicted.

    Returns:
        `coverage`; and of `BINS` parts of the cycles, by their deviation, the root mean squares of
        `deviation` and `error`, and the `inside` of the interval of 90 %.
    """
    half = norm.ppf(0.5 + 0.5 * np.array(LEVELS))
    inside = np.abs(error)[None] <= half[:, None] * deviation[None]
    order = np.array_split(np.argsort(deviation), BINS)
    at_90 = inside[LEVELS.index(0.9)]
    return {
        "coverage": inside.mean(axis=1).round(4).tolist(),
        "deviation": [float(np.sqrt(np.mean(deviation[part] ** 2))) for part in order],
        "error": [float(np.sqrt(np.mean(error[part] ** 2))) for part in order],
        "inside": [float(at_90[part].mean()) for part in order],
    }


def draw(folder: Path) -> None:
    """Coverage over its nominal value, and errors over deviations."""
    result = json.loads((folder / "reliability.json").read_text())
    figure = new_figure(8.4, 5.4)
    panels = figure.subplots(2, 3)
    colours = dict(zip(result["models"], (BLUE, ORANGE), strict=True))
    titles = {"psi_low": "ψ_low", "psi_high": "ψ_high"}
    for (above, below), (name, unit) in zip(panels.T, OUTCOMES.items(), strict=True):
        above.plot([0, 1], [0, 1], color=FAINT, lw=1.0)
        for kind, rows in result["models"].items():
            row = rows[name]
            above.plot(result["levels"], row["coverage"], "o-", ms=3, color=colours[kind], lw=1.2)
            below.plot(
                row["deviation"],
                row["error"],
                "o-",
                ms=3,
                color=colours[kind],
                lw=1.2,
                label=f"{titles[kind]}, {rows['members']} members",
            )
        drawn = [v for r in result["models"].values() for v in r[name]["deviation"]]
        below.plot(*2 * [[min(drawn), max(drawn)]], color=FAINT, lw=1.0, zorder=0)
        below.set_xscale("log")
        below.set_yscale("log")
        for axis in (below.xaxis, below.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        above.set_title(name, fontsize=9)
        above.set_xlabel("interval, nominal share", fontsize=8)
        below.set_xlabel(f"predicted deviation [{unit}]", fontsize=8)
        tidy(above)
        tidy(below)
    panels[0, 0].set_ylabel("share of cycles inside", fontsize=8)
    panels[1, 0].set_ylabel("error, root mean square", fontsize=8)
    panels[1, 0].legend(fontsize=8, frameon=False)
    write_bytes_atomic(folder / "reliability.png", png_bytes(figure))


if __name__ == "__main__":
    main("reliability", run, draw)
