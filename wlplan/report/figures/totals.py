"""What the loads of a plan yield: each and accumulated, predicted beside simulated."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wlplan.constants import QUANTITIES, Quantity
from wlplan.report.figures.style import BLUE, INK, ORANGE, new_figure, tidy
from wlplan.types import Performance

# Colour, marker, its filling and line of a series, by its label.
_LINES = {
    "predicted": (BLUE, "o", BLUE, "-"),
    "simulated": (ORANGE, "s", "white", "--"),
}


def totals_figure(predicted: Performance, simulated: Performance | None = None) -> Figure:
    """Mass, time and work: each loading above, accumulated below, predicted beside simulated.

    Args:
        predicted: By the world that planned, leaves [N], tonne, s, kJ.
        simulated: By the simulator, leaves [N]; None to leave it out.
    """
    figure = new_figure(11.0, 5.8)
    panels = figure.subplots(2, 3, sharex=True)
    played = {"predicted": predicted}
    if simulated is not None:
        played["simulated"] = simulated
    for (each, total), (name, quantity) in zip(panels.T, QUANTITIES.items(), strict=True):
        series = {
            label: np.atleast_1d(np.asarray(getattr(performance, name), float))
            for label, performance in played.items()
        }
        _draw_quantity(each, total, quantity, series)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False)
    return figure


def _draw_quantity(
    each: Axes, total: Axes, quantity: Quantity, series: Mapping[str, Float[np.ndarray, " n"]]
) -> None:
    """One quantity of all series, each load in one panel and accumulated in the other."""
    title, unit, _ = quantity
    for label, values in series.items():
        _draw_series(each, np.arange(1, len(values) + 1), values, label)
        # From nothing before the first loading.
        summed = np.append(0.0, np.cumsum(values))
        _draw_series(total, np.arange(len(values) + 1), summed, label)
    each.set_title(f"{title.capitalize()} of each load", color=INK)
    each.set_ylim(0.0, 1.18 * max(each.get_ylim()[1], 1e-3))
    total.set_title(f"{title.capitalize()} accumulated", color=INK)
    total.set_xlabel("load")
    total.set_ylim(bottom=0.0)
    total.text(
        0.97,
        0.06,
        _sum_text([float(values.sum()) for values in series.values()], unit),
        transform=total.transAxes,
        ha="right",
        va="bottom",
        color=INK,
        fontsize=9,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2.0},
    )
    count = len(next(iter(series.values())))
    for panel in (each, total):
        panel.set_ylabel(f"{title} [{unit}]")
        tidy(panel)
        panel.set_xlim(0.0 if count > 1 else -0.25, count + 0.5)
        panel.locator_params(axis="x", integer=True)


def _draw_series(
    panel: Axes, load: Int[np.ndarray, " n"], values: Float[np.ndarray, " n"], label: str
) -> None:
    colour, marker, filling, line = _LINES[label]
    panel.plot(
        load,
        values,
        color=colour,
        marker=marker,
        markerfacecolor=filling,
        markersize=4.5,
        linestyle=line,
        linewidth=1.4,
        label=label,
    )


def _sum_text(sums: list[float], unit: str) -> str:
    """Final sums, and how far the prediction is off."""
    if len(sums) == 1:
        return f"{_number(sums[0])} {unit}"
    text = f"predicted {_number(sums[0])} {unit}\nsimulated {_number(sums[1])} {unit}"
    if sums[1]:
        text += f"\ndifference {100.0 * (sums[0] / sums[1] - 1.0):+.1f} %"
    return text


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.1f}"
