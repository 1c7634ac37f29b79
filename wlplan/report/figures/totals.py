"""What the loads of a plan yield: each and accumulated, predicted beside simulated."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wlplan.constants import PERCENT_90, QUANTITIES, Quantity
from wlplan.report.figures.style import BLUE, INK, ORANGE, new_figure, tidy
from wlplan.types import Performance

# Colour, marker, its filling and line of a series, by its label.
_LINES = {
    "predicted": (BLUE, "o", BLUE, "-"),
    "simulated": (ORANGE, "s", "white", "--"),
}
BAND = "nine in ten, by the ensemble"
"""What the band around the prediction is."""
# Loads that are marked one by one at most.
_MARKED = 40


def totals_figure(
    predicted: Performance,
    simulated: Performance | None = None,
    deviation: Performance | None = None,
) -> Figure:
    """Mass, time and work: each loading above, accumulated below, predicted beside simulated.

    Args:
        predicted: By the world that planned, leaves [N], tonne, s, kJ.
        simulated: By the simulator, leaves [N]; None to leave it out.
        deviation: Standard deviation of the error of what was predicted, leaves [N]; None: unknown.
    """
    figure = new_figure(11.0, 5.8)
    panels = figure.subplots(2, 3, sharex=True)
    for column, name in zip(panels.T, QUANTITIES, strict=True):
        for panel, accumulated in zip(column, (False, True), strict=True):
            _draw(panel, name, accumulated, predicted, simulated, deviation)
        column[0].set_xlabel("")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False)
    return figure


def total_figure(
    name: str,
    accumulated: bool,
    predicted: Performance,
    simulated: Performance | None = None,
    deviation: Performance | None = None,
) -> Figure:
    """One panel of `totals_figure`, for itself.

    Args:
        name: Of the quantity, as in `QUANTITIES`.
        accumulated: Over the loads, or each of them.
        predicted: As for `totals_figure`, as are simulated and deviation.
        simulated: By the simulator.
        deviation: Of the error of what was predicted.
    """
    figure = new_figure(3.7, 2.7)
    _draw(figure.subplots(), name, accumulated, predicted, simulated, deviation)
    return figure


def _draw(
    panel: Axes,
    name: str,
    accumulated: bool,
    predicted: Performance,
    simulated: Performance | None,
    deviation: Performance | None,
) -> None:
    """One quantity of all series, of each load or accumulated."""
    quantity = QUANTITIES[name]
    series = {"predicted": _values(predicted, name)}
    if simulated is not None:
        series["simulated"] = _values(simulated, name)
    count = len(series["predicted"])
    load = np.arange(0 if accumulated else 1, count + 1)
    if deviation is not None:
        _draw_band(panel, load, series["predicted"], _values(deviation, name), accumulated)
    for label, values in series.items():
        # From nothing before the first loading.
        shown = np.append(0.0, np.cumsum(values)) if accumulated else values
        _draw_series(panel, load, shown, label)
    if accumulated:
        _write_sums(panel, quantity, series)
        panel.set_ylim(bottom=0.0)
    else:
        panel.set_ylim(0.0, 1.18 * max(panel.get_ylim()[1], 1e-3))
    title = quantity.title.capitalize()
    panel.set_title(f"{title} {'accumulated' if accumulated else 'of each load'}", color=INK)
    panel.set_xlabel("load")
    panel.set_ylabel(f"{quantity.title} [{quantity.unit}]")
    tidy(panel)
    panel.set_xlim(0.0 if count > 1 else -0.25, count + 0.5)
    panel.locator_params(axis="x", integer=True)


def _values(performance: Performance, name: str) -> Float[np.ndarray, " n"]:
    return np.atleast_1d(np.asarray(getattr(performance, name), float))


def _draw_band(
    panel: Axes,
    load: Int[np.ndarray, " m"],
    values: Float[np.ndarray, " n"],
    deviation: Float[np.ndarray, " n"],
    accumulated: bool,
) -> None:
    """What holds nine in ten around what was predicted; all loads err in the same way."""
    half = PERCENT_90 * deviation
    if accumulated:
        values = np.append(0.0, np.cumsum(values))
        half = np.append(0.0, np.cumsum(half))
    panel.fill_between(
        load, values - half, values + half, color=BLUE, alpha=0.22, linewidth=0.0, label=BAND
    )


def _write_sums(
    panel: Axes, quantity: Quantity, series: Mapping[str, Float[np.ndarray, " n"]]
) -> None:
    panel.text(
        0.97,
        0.06,
        _sum_text([float(values.sum()) for values in series.values()], quantity.unit),
        transform=panel.transAxes,
        ha="right",
        va="bottom",
        color=INK,
        fontsize=9,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2.0},
    )


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
        # Of many loads the markers would be all there is to see.
        markersize=4.5 if len(load) <= _MARKED else 0.0,
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
