"""The figures: a plan on its pile, predicted beside simulated totals, diggability maps."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from wlplan.constants import QUANTITIES
from wlplan.planning.transport import Receiver
from wlplan.report.figures.digs import LABEL_PART, draw_digs, label_places
from wlplan.report.figures.paper import (
    BLUE,
    FAINT,
    INK,
    ORANGE,
    frame_map,
    map_panels,
    new_figure,
    tidy,
)
from wlplan.report.figures.relief import (
    PILE,
    STONE,
    add_legend,
    draw_pile,
    draw_toe,
    grow_to_ratio,
    height_above_ground,
    view_of,
)
from wlplan.report.figures.truck import Truck, draw_truck
from wlplan.studies.diggability import DiggabilityMap
from wlplan.types import LoadingPlan, Performance, Pile

# Length of the line that marks a location of a diggability map [m]; at most this part of the view.
_TICK = 1.5
_TICK_PART = 0.09


def plan_figure(
    before: Pile,
    after: Pile,
    plan: LoadingPlan,
    *,
    receiver: Receiver | None = None,
    after_title: str | None = None,
) -> Figure:
    """The pile with its numbered digs, and the pile that is left, side by side.

    A dot marks the dig location, an arrow the heading, and the number on the outside the order.

    Args:
        before: Pile before the first loading.
        after: Pile after the last one, on the same grid.
        plan: N loadings in order, leaves [N].
        receiver: Where the loader dumps, drawn as a truck across its heading.
        after_title: Title of the second panel; by default the number of loads.
    """
    digs = np.stack([np.asarray(plan.pose.x), np.asarray(plan.pose.y)], axis=-1).astype(float)
    heading = np.asarray(plan.pose.heading, float)
    view = view_of(before, digs)
    truck = None if receiver is None else Truck(receiver)
    seen = digs
    if truck is not None and truck.is_near(view):
        seen = np.concatenate([digs, truck.body, truck.way - truck.ahead])
    # Labels are as large as the map allows, and the map widens to hold them.
    radius = LABEL_PART * float(np.ptp(view_of(before, seen), axis=0).max())
    labels = label_places(digs, heading, radius, before)
    view = grow_to_ratio(view_of(before, np.concatenate([seen, labels])))

    figure, panels = map_panels(view, 2)
    norm = Normalize(
        0.0,
        max(float(height_above_ground(before).max()), float(height_above_ground(after).max()), 0.1),
    )
    titles = (f"Before, with {_loads(len(digs))} planned", after_title or "")
    titles = (titles[0], titles[1] or f"After {_loads(len(digs))}")
    for panel, pile, title in zip(panels, (before, after), titles, strict=True):
        draw_pile(panel, pile, PILE, norm)
        frame_map(panel, view, title)
        if truck is not None:
            draw_truck(panel, truck, view)
    draw_digs(panels[0], digs, heading, labels, radius)
    for panel, style in zip(panels, ("solid", "dashed"), strict=True):
        draw_toe(panel, before, style)
    panels[1].plot(*digs.T, "o", color=BLUE, markersize=2.5, zorder=5)
    panels[1].tick_params(labelleft=False)
    panels[1].set_ylabel("")
    bar = figure.colorbar(
        ScalarMappable(norm, PILE), cax=panels[1].inset_axes((1.03, 0.0, 0.035, 1.0))
    )
    bar.set_label("height above the ground [m]")
    bar.outline.set_visible(False)
    add_legend(figure, before)
    return figure


def totals_figure(predicted: Performance, simulated: Performance | None = None) -> Figure:
    """Mass, time and work: each loading above, accumulated below, predicted beside simulated.

    Args:
        predicted: By the world that planned, leaves [N].
        simulated: By the simulator, leaves [N]; None to leave it out.
    """
    figure = new_figure(11.0, 5.8)
    panels = figure.subplots(2, 3, sharex=True)
    series: list[tuple[str, Performance, str, str]] = [("predicted", predicted, BLUE, "o-")]
    if simulated is not None:
        series.append(("simulated", simulated, ORANGE, "s--"))
    for column, (name, (title, unit, _)) in enumerate(QUANTITIES.items()):
        each, total = panels[0, column], panels[1, column]
        sums = []
        for label, performance, colour, style in series:
            values = np.atleast_1d(np.asarray(getattr(performance, name), float))
            load = np.arange(1, len(values) + 1)
            line = {"color": colour, "markersize": 4.5, "linewidth": 1.4, "label": label}
            if style[0] == "s":
                line["markerfacecolor"] = "white"
            each.plot(load, values, style, **line)
            # From nothing before the first loading, without a marker.
            total.plot(np.arange(len(values) + 1), np.append(0.0, np.cumsum(values)), style, **line)
            sums.append(float(values.sum()))
        each.set_title(f"{title.capitalize()} of each load", color=INK)
        each.set_ylabel(f"{title} [{unit}]")
        each.set_ylim(0.0, 1.18 * max(each.get_ylim()[1], 1e-3))
        total.set_title(f"{title.capitalize()} accumulated", color=INK)
        total.set_ylabel(f"{title} [{unit}]")
        total.set_xlabel("load")
        total.set_ylim(bottom=0.0)
        total.text(
            0.97,
            0.06,
            _sum_text(sums, unit),
            transform=total.transAxes,
            ha="right",
            va="bottom",
            color=INK,
            fontsize=9,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2.0},
        )
        for panel in (each, total):
            tidy(panel)
            panel.set_xlim(0.0 if len(load) > 1 else -0.25, len(load) + 0.5)
            panel.xaxis.get_major_locator().set_params(integer=True)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False)
    return figure


def diggability_figure(pile: Pile, diggability: DiggabilityMap) -> Figure:
    """Mass, time and work of one action at locations around the pile.

    The colours of the lines, which stand on the toe along the inward normals, are those of the
    histograms below. Paper, the figure of section 7.4.

    Args:
        pile: The pile the map was made for.
        diggability: Poses and performance, leaves [n].
    """
    pose = diggability.pose
    digs = np.stack([np.asarray(pose.x), np.asarray(pose.y)], axis=-1).astype(float)
    heading = np.asarray(pose.heading, float)
    inward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    view = grow_to_ratio(view_of(pile, digs - _TICK * inward))
    tick = min(_TICK, _TICK_PART * float(np.ptp(view, axis=0).max()))
    ends = np.stack([digs - tick * inward, digs], axis=1)

    ratio = float(np.divide(*np.ptp(view, axis=0)[::-1]))
    figure = new_figure(12.0, 12.0 / 3.3 * ratio + 2.7)
    panels = figure.subplots(2, 3, height_ratios=[12.0 / 3.3 * ratio, 1.6])
    norm = Normalize(0.0, max(float(height_above_ground(pile).max()), 0.1))
    colours = colormaps["viridis"]
    for column, (name, (title, unit, _)) in enumerate(QUANTITIES.items()):
        panel, histogram = panels[0, column], panels[1, column]
        label = f"{'Load' if name == 'mass' else 'Loading'} {title}"
        values = np.asarray(getattr(diggability.performance, name), float)
        edges = _bins(values)
        scale = Normalize(edges[0], edges[-1])
        draw_pile(panel, pile, STONE, norm, contour_alpha=0.35)
        frame_map(panel, view, f"{label} [{unit}]")
        panel.add_collection(
            LineCollection(list(ends), colors="white", linewidths=4.2, capstyle="round", zorder=4)
        )
        panel.add_collection(
            LineCollection(
                list(ends),
                colors=[tuple(c) for c in colours(scale(values))],
                linewidths=2.8,
                capstyle="round",
                zorder=5,
            )
        )
        count, _ = np.histogram(values, edges)
        middle = 0.5 * (edges[1:] + edges[:-1])
        histogram.bar(
            middle, count, width=np.diff(edges), color=colours(scale(middle)), edgecolor="white"
        )
        histogram.axvline(float(np.median(values)), color=INK, linewidth=1.0, linestyle=":")
        histogram.set_title(
            f"median {np.median(values):.3g} {unit}, {values.min():.3g} to {values.max():.3g}",
            fontsize=9,
            color=FAINT,
        )
        histogram.set_xlabel(f"{label.lower()} [{unit}]")
        histogram.yaxis.get_major_locator().set_params(integer=True)
        tidy(histogram)
        if column:
            panel.set_ylabel("")
            panel.tick_params(labelleft=False)
    panels[1, 0].set_ylabel("locations")
    return figure


def _loads(count: int) -> str:
    return "1 load" if count == 1 else f"{count} loads"


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


def _bins(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Edges of histogram bins over the range of the values; never of zero width."""
    low, high = float(values.min()), float(values.max())
    spread = max(high - low, 1e-3 * max(abs(high), 1.0))
    middle = 0.5 * (low + high)
    count = int(np.clip(round(math.sqrt(values.size) * 1.6), 5, 20))
    return np.linspace(middle - 0.5 * spread, middle + 0.5 * spread, count + 1)
