"""What one action would yield all around a pile. Paper, the figure of section 7.4."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from wlplan.constants import QUANTITIES
from wlplan.report.figures.relief import (
    STONE,
    draw_pile,
    grow_to_ratio,
    height_above_ground,
    view_of,
)
from wlplan.report.figures.style import FAINT, INK, frame_map, new_figure, tidy
from wlplan.site.frame import LOCAL, Frame
from wlplan.studies.diggability import DiggabilityMap
from wlplan.types import Pile

# Yellow is good in every map: much mass, little time and work.
_MUCH_IS_GOOD, _LITTLE_IS_GOOD = colormaps["viridis"], colormaps["viridis_r"]
# Length of the line that marks a location [m]; at most this part of the view.
_TICK = 1.5
_TICK_PART = 0.09


def diggability_figure(pile: Pile, diggability: DiggabilityMap, *, frame: Frame = LOCAL) -> Figure:
    """Mass, time and work of one action at locations around the pile.

    The colours of the lines, which stand on the toe along the inward normals, are those of the
    histograms below. Yellow is good: much mass, little time and work.

    Args:
        pile: The pile the map was made for.
        diggability: Poses and performance, leaves [n].
        frame: What the coordinates on the axes are in.
    """
    pose = diggability.pose
    digs = np.stack([np.asarray(pose.x), np.asarray(pose.y)], axis=-1).astype(float)
    heading = np.asarray(pose.heading, float)
    inward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    view = grow_to_ratio(view_of(pile, digs - _TICK * inward))
    tick = min(_TICK, _TICK_PART * float(np.ptp(view, axis=0).max()))
    ticks = np.stack([digs - tick * inward, digs], axis=1)

    ratio = float(np.divide(*np.ptp(view, axis=0)[::-1]))
    figure = new_figure(12.0, 12.0 / 3.3 * ratio + 2.7)
    panels = figure.subplots(2, 3, height_ratios=[12.0 / 3.3 * ratio, 1.6])
    norm = Normalize(0.0, max(float(height_above_ground(pile).max()), 0.1))
    for column, (name, (title, unit, _)) in enumerate(QUANTITIES.items()):
        panel, histogram = panels[:, column]
        label = f"{'Load' if name == 'mass' else 'Loading'} {title}"
        values = np.asarray(getattr(diggability.performance, name), float)
        edges = _bins(values)
        scale = Normalize(edges[0], edges[-1])
        colours = _MUCH_IS_GOOD if name == "mass" else _LITTLE_IS_GOOD
        draw_pile(panel, pile, STONE, norm, contour_alpha=0.35)
        frame_map(panel, view, f"{label} [{unit}]", frame)
        _draw_ticks(panel, ticks, colours(scale(values)))
        _draw_histogram(histogram, values, edges, scale, colours)
        histogram.set_title(
            f"median {np.median(values):.3g} {unit}, {values.min():.3g} to {values.max():.3g}",
            fontsize=9,
            color=FAINT,
        )
        histogram.set_xlabel(f"{label.lower()} [{unit}]")
        if column:
            panel.set_ylabel("")
            panel.tick_params(labelleft=False)
    panels[1, 0].set_ylabel("locations")
    return figure


def _draw_ticks(
    panel: Axes, ticks: Float[np.ndarray, "n 2 2"], colours: Float[np.ndarray, "n 4"]
) -> None:
    """Lines from point to point [m] on a map, each in its colour, on white ones."""
    for colour, width, zorder in (("white", 4.2, 4), (list(colours), 2.8, 5)):
        panel.add_collection(
            LineCollection(
                list(ticks), colors=colour, linewidths=width, capstyle="round", zorder=zorder
            )
        )


def _draw_histogram(
    panel: Axes,
    values: Float[np.ndarray, " n"],
    edges: Float[np.ndarray, " m"],
    scale: Normalize,
    colours: Colormap,
) -> None:
    """How many values lie between the edges, in their colours, and the median as a line."""
    count, _ = np.histogram(values, edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    panel.bar(middle, count, width=np.diff(edges), color=colours(scale(middle)), edgecolor="white")
    panel.axvline(float(np.median(values)), color=INK, linewidth=1.0, linestyle=":")
    panel.locator_params(axis="y", integer=True)
    tidy(panel)


def _bins(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Edges of histogram bins over the range of the values; never of zero width."""
    low, high = float(values.min()), float(values.max())
    spread = max(high - low, 1e-3 * max(abs(high), 1.0))
    middle = 0.5 * (low + high)
    count = int(np.clip(round(math.sqrt(values.size) * 1.6), 5, 20))
    return np.linspace(middle - 0.5 * spread, middle + 0.5 * spread, count + 1)
