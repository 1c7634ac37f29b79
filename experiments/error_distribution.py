"""Where the performance predictors err: errors over what was loaded, and the worst predictions.

Paper, figures 9 and 10: relative errors on held-out cycles, scattered over the simulated outcome,
with moving averages and the distribution of the data; and the ten loads that ψ_low predicts worst,
with the pile they were dug from. Beside it, also of the models that ship, how the errors are
spread, and what part of them comes from loadings that stall.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from experiments._common.models import (
    PREDICTORS,
    PRETRAINED,
    load_or_train,
    load_pretrained,
    smoke_settings,
)
from experiments._common.results import dataset_summary, main
from wlplan.constants import CELL_SIZE
from wlplan.dataset import Dataset, split
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, INK, ORANGE, new_figure, tidy
from wlplan.report.figures.surface import DIFFERENCE, FROM_BEHIND, draw_surface
from wlplan.site.machine import WA320
from wlplan.training.evaluation import predict

MODELS = ("psi_low, swish", "psi_high, swish")
OUTCOMES = {"mass": "t", "time": "s", "work": "kJ"}
WORST = 10
# A loading that takes longer counts as stalled [s]: most take 7 to 10, one that gets nowhere 21.
STALL = 15.0
# Part of the cycles in a window of the moving average.
WINDOW = 0.05
# Decrease and increase of the surface in the maps of the worst predictions [m].
CHANGE = 0.5
GOLD, CYAN = "#d9a400", "#00a0b8"


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Errors of every held-out cycle, and the maps of the worst."""
    smoke = preset == "smoke"
    test = split(data)[2]
    test = test.select(test.valid & (test.mass > 0.0))
    compared: dict[str, Any] = {
        title: load_or_train(
            models, data, smoke_settings(PREDICTORS[title]) if smoke else PREDICTORS[title]
        )[0]
        for title in MODELS
    }
    compared |= {title: load_pretrained(kind)[0] for title, kind in PRETRAINED.items()}
    errors, stalls = {}, {}
    for title, model in compared.items():
        predicted = predict(model, test)
        errors[title] = {
            name: np.asarray(getattr(predicted, name)) / getattr(test, name) - 1.0
            for name in OUTCOMES
        }
        stalls[title] = _by_stall(test.time, np.asarray(predicted.time), errors[title])
    worst = np.argsort(-np.abs(errors[MODELS[0]]["mass"]))[:WORST]
    return {
        "data": dataset_summary(data),
        "cycles": len(test),
        "simulated": {
            name: [float(f"{value:.4g}") for value in getattr(test, name)] for name in OUTCOMES
        },
        "error": {
            title: {
                name: values.astype(float).round(3).tolist()
                for name, values in errors[title].items()
            }
            for title in MODELS
        },
        "shares": {
            title: {name: _shares(values) for name, values in table.items()}
            for title, table in errors.items()
        },
        "by_stall": stalls,
        "worst": [
            _worst(test, int(n), {title: errors[title]["mass"][n] for title in MODELS})
            for n in worst
        ],
        "skew": _skew(test, worst),
    }


def _shares(errors: Float[np.ndarray, " n"]) -> dict[str, float]:
    """How the sizes of relative errors are spread."""
    sizes = np.abs(errors)
    half, most, nearly = (float(v) for v in np.percentile(sizes, [50.0, 90.0, 99.0]))
    return {"mean": float(sizes.mean()), "median": half, "p90": most, "p99": nearly}


def _by_stall(
    time: Float[np.ndarray, " n"], predicted: Float[np.ndarray, " n"], errors: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Errors of the cycles that stall, or that the model takes for such, and of the rest.

    Args:
        time: Simulated time [s].
        predicted: Predicted time [s].
        errors: Relative errors of each quantity.
    """
    stalled, foreseen = time > STALL, predicted > STALL
    groups = {
        "missed": stalled & ~foreseen,
        "foreseen in vain": ~stalled & foreseen,
        "foreseen": stalled & foreseen,
        "no stall": ~(stalled | foreseen),
    }
    return {
        group: {"cycles": int(which.sum())}
        | {
            # Together the parts are the mean error of all cycles.
            name: _shares(values[which]) | {"part": float((np.abs(values) * which).mean())}
            for name, values in errors.items()
            if which.any()
        }
        for group, which in groups.items()
    }


def _worst(data: Dataset, n: int, errors: dict[str, Any]) -> dict[str, Any]:
    """One prediction: errors, what was loaded, and its maps in centimetres."""
    before, after = (np.rint(100.0 * maps[n]).astype(int) for maps in (data.h36, data.h36_after))
    return {
        "error": {title: float(f"{error:.4g}") for title, error in errors.items()},
        **{name: float(f"{getattr(data, name)[n]:.4g}") for name in OUTCOMES},
        "action": data.action[n].round(3).tolist(),
        "stop_reason": int(data.stop_reason[n]),
        "load": int(data.load[n]),
        # Every other cell does for the contours.
        "height_cm": before[::2, ::2].tolist(),
        "change_cm": (after - before).tolist(),
    }


def _skew(data: Dataset, worst: np.ndarray) -> dict[str, float]:
    """How one-sided the piles are: volume left over right of the centre line, as part of both."""
    volume = np.clip(data.h36 - data.h36.min(axis=(1, 2), keepdims=True), 0.0, None)
    left, right = volume[:, :, 18:].sum(axis=(1, 2)), volume[:, :, :18].sum(axis=(1, 2))
    skew = np.abs(left - right) / np.maximum(left + right, 1e-9)
    return {"worst_median": float(np.median(skew[worst])), "all_median": float(np.median(skew))}


def draw(folder: Path) -> None:
    """Figure 9 as error_distribution.png, figure 10 as worst_predictions.png and ..._aside.png."""
    result = json.loads((folder / "error_distribution.json").read_text())
    figure = new_figure(10.5, 3.1)
    colours = dict(zip(result["error"], (BLUE, ORANGE), strict=True))
    for panel, (name, unit) in zip(figure.subplots(1, 3), OUTCOMES.items(), strict=True):
        outcome = np.array(result["simulated"][name])
        low, high = np.percentile(outcome, [0.2, 99.8])
        panel.set_xlim(low, high)
        behind = panel.twinx()
        behind.hist(outcome, bins=40, range=(low, high), color="#dfe2e6")
        behind.set_yticks([])
        panel.set_zorder(behind.get_zorder() + 1)
        panel.patch.set_visible(False)
        for side in behind.spines.values():
            side.set_visible(False)
        order = np.argsort(outcome)
        for title, colour in colours.items():
            error = 100.0 * np.abs(result["error"][title][name])
            panel.plot(outcome, error, ".", ms=2.0, alpha=0.35, color=colour)
            size = max(int(WINDOW * len(outcome)), 2)
            window = np.ones(size) / size
            mean = [np.convolve(v[order], window, "valid") for v in (outcome, error)]
            label = f"{title.replace('psi', 'ψ')}, moving average"
            panel.plot(*mean, color=colour, lw=1.8, label=label)
        panel.set_ylim(0.0, 40.0)
        panel.set_xlabel(f"simulated {name} [{unit}]", fontsize=9)
        panel.set_title(f"size of the relative error of the {name} [%]", fontsize=9)
        tidy(panel)
        if name == "mass":
            panel.legend(fontsize=8, frameon=False, loc="upper right")
    note = "grey: distribution of the cycles; errors above 40 % not shown"
    figure.suptitle(f"{result['cycles']} held-out cycles; {note}", fontsize=8, color=FAINT)
    write_bytes_atomic(folder / "error_distribution.png", png_bytes(figure))
    _draw_worst(result, folder)
    _draw_worst_aside(result, folder)


def _draw_worst(result: dict[str, Any], folder: Path) -> None:
    """The ten worst predictions: contours of the pile, and where it rose or fell."""
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("change", [GOLD, "#f6f4ee", CYAN])
    figure = new_figure(11.0, 5.6)
    panels = figure.subplots(2, 5, sharex=True, sharey=True).reshape(-1)
    low, high = MODELS
    for panel, item in zip(panels, result["worst"], strict=False):
        height = 0.01 * np.array(item["height_cm"])
        change = 0.01 * np.array(item["change_cm"])
        along = np.arange(len(change)) * CELL_SIZE
        # Left of the loader is left in the picture.
        left = along - along.mean()
        image = panel.pcolormesh(
            -left,
            along,
            change,
            cmap=colours,
            vmin=-CHANGE,
            vmax=CHANGE,
        )
        lines = panel.contour(
            -left[::2], along[::2], height, np.arange(0.0, 4.0, 0.25), colors=INK, linewidths=0.6
        )
        panel.clabel(lines, lines.levels[::2], fontsize=5, fmt="%.1f")
        for side in (-0.5, 0.5):
            panel.axvline(side * WA320.bucket_width, color=FAINT, lw=0.7, ls="--")
        panel.set_aspect("equal")
        panel.set_title(
            f"{item['mass']:.2f} t\nψ_low {100.0 * item['error'][low]:+.0f} %, "
            f"ψ_high {100.0 * item['error'][high]:+.0f} %",
            fontsize=8,
        )
        tidy(panel, grid=False)
    for panel in panels[5:]:
        panel.set_xlabel("to the right [m]", fontsize=8)
    for panel in panels[::5]:
        panel.set_ylabel("ahead of the dig location [m]", fontsize=8)
    bar = figure.colorbar(image, ax=panels.tolist(), shrink=0.6, pad=0.01)
    bar.set_label("change by the loading [m]", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    figure.suptitle(
        "The worst predictions of the mass by ψ_low: simulated mass and errors; contours: "
        "height before over the dig location [m]; dashed: width of the bucket",
        fontsize=8,
        color=FAINT,
    )
    write_bytes_atomic(folder / "worst_predictions.png", png_bytes(figure))


def _draw_worst_aside(result: dict[str, Any], folder: Path) -> None:
    """The ten worst predictions: the pile before, in the colours of what the loading changes."""
    figure = new_figure(11.0, 4.2)
    panels = figure.subplots(2, 5, sharex=True, sharey=True, gridspec_kw={"wspace": 0.02}).ravel()
    low, high = MODELS
    norm = Normalize(-CHANGE, CHANGE)
    for panel, item in zip(panels, result["worst"], strict=False):
        # The heights that are kept are those of every other cell.
        change, height = (0.01 * np.array(item[name]) for name in ("change_cm", "height_cm"))
        draw_surface(
            panel,
            height,
            2.0 * CELL_SIZE,
            DIFFERENCE,
            norm,
            values=change[::2, ::2],
            base=float(height.min()) - 0.2,
            view=FROM_BEHIND,
        )
        errors = [100.0 * item["error"][title] for title in (low, high)]
        said = f"{item['mass']:.2f} t; ψ_low {errors[0]:+.0f} %, ψ_high {errors[1]:+.0f} %"
        panel.set_title(said, fontsize=7.5, color=INK)
    bar = figure.colorbar(
        ScalarMappable(norm, DIFFERENCE), ax=panels.tolist(), shrink=0.6, pad=0.01
    )
    bar.set_label("change by the loading [m]", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    figure.suptitle(
        "The same piles before the loading, which goes to the right and back",
        fontsize=8,
        color=FAINT,
    )
    content = png_bytes(figure, dpi=120, rare_colours=True)
    write_bytes_atomic(folder / "worst_predictions_aside.png", content)


if __name__ == "__main__":
    main("error_distribution", run, draw)
