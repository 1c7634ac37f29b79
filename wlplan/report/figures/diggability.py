"""What loads would yield all around a pile. Paper, the figure of section 7.4."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from wlplan.constants import QUANTITIES
from wlplan.report.figures.orientation import draw_orientation
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
from wlplan.types import Pile, Pose

# Yellow is good in every map: much mass, little time and work.
_MUCH_IS_GOOD, _LITTLE_IS_GOOD = colormaps["viridis"], colormaps["viridis_r"]
# Length of the arrow that marks a location [m]; at most this part of the view.
_TICK = 1.5
_TICK_PART = 0.09
# Width of one map, and height of the histogram below it [inch].
_MAP, _HISTOGRAM = 12.0 / 3.3, 1.6


@dataclasses.dataclass(frozen=True)
class Shade:
    """One quantity of all locations.

    Attributes:
        title: Its name, in the middle of a sentence.
        unit: Of the values.
        digits: After the point, in tables.
        values: Of each location.
        much_is_good: Or little.
    """

    title: str
    unit: str
    digits: int
    values: Float[np.ndarray, " n"]
    much_is_good: bool

    @property
    def median(self) -> float:
        """Of the values."""
        return float(np.median(self.values))

    @property
    def best(self) -> int:
        """Which location is best."""
        return int(self.values.argmax() if self.much_is_good else self.values.argmin())

    @property
    def colours(self) -> Colormap:
        """Yellow is good."""
        return _MUCH_IS_GOOD if self.much_is_good else _LITTLE_IS_GOOD


def diggability_figure(pile: Pile, diggability: DiggabilityMap, *, frame: Frame = LOCAL) -> Figure:
    """Mass, time and work of loads at locations around the pile.

    The colours of the arrows, which end on the toe along the headings, are those of the histograms
    below. Yellow is good: much mass, little time and work.

    Args:
        pile: The pile the map was made for.
        diggability: Poses and performance, leaves [n].
        frame: What the coordinates on the axes are in.
    """
    shades = [
        Shade(
            f"{'load' if name == 'mass' else 'loading'} {title}",
            unit,
            digits,
            np.asarray(getattr(diggability.performance, name), float),
            name == "mass",
        )
        for name, (title, unit, digits) in QUANTITIES.items()
    ]
    return shades_figure(pile, diggability.pose, shades, frame=frame)


def shades_figure(
    pile: Pile, pose: Pose, shades: Sequence[Shade], *, frame: Frame = LOCAL
) -> Figure:
    """Maps side by side with their histograms, as in `diggability_figure`.

    Args:
        pile: The pile the map was made for.
        pose: The locations, leaves [n].
        shades: What the colours of each map say.
        frame: What the coordinates on the axes are in.
    """
    digs = np.stack([np.asarray(pose.x), np.asarray(pose.y)], axis=-1).astype(float)
    heading = np.asarray(pose.heading, float)
    inward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    view = grow_to_ratio(view_of(pile, digs - _TICK * inward))
    tick = min(_TICK, _TICK_PART * float(np.ptp(view, axis=0).max()))

    tall = _MAP * float(np.divide(*np.ptp(view, axis=0)[::-1]))
    figure = new_figure(1.1 + _MAP * len(shades), tall + _HISTOGRAM + 1.1)
    panels = figure.subplots(2, len(shades), height_ratios=[tall, _HISTOGRAM], squeeze=False)
    norm = Normalize(0.0, max(float(height_above_ground(pile).max()), 0.1))
    for column, shade in enumerate(shades):
        panel, histogram = panels[:, column]
        values = np.asarray(shade.values, float)
        edges = _bins(values)
        scale = Normalize(edges[0], edges[-1])
        draw_pile(panel, pile, STONE, norm, contour_alpha=0.35)
        title = f"{shade.title[:1].upper()}{shade.title[1:]} [{shade.unit}]"
        frame_map(panel, view, title, frame)
        _draw_arrows(panel, digs, tick * inward, shade.colours(scale(values)))
        _draw_histogram(histogram, values, edges, scale, shade.colours)
        middle, low, high = (
            f"{value:,.{shade.digits}f}" for value in (shade.median, values.min(), values.max())
        )
        words = f"median {middle} {shade.unit}, {low} to {high}"
        histogram.set_title(words, fontsize=9, color=FAINT)
        histogram.set_xlabel(f"{shade.title} [{shade.unit}]")
        if column:
            panel.set_ylabel("")
            panel.tick_params(labelleft=False)
    draw_orientation(panels[0, 0], view, digs)
    panels[1, 0].set_ylabel("locations")
    return figure


def _draw_arrows(
    panel: Axes,
    digs: Float[np.ndarray, "n 2"],
    along: Float[np.ndarray, "n 2"],
    colours: Float[np.ndarray, "n 4"],
) -> None:
    """Arrows that end at points [m] on a map, each in its colour, on white ones."""
    length = float(np.hypot(*along[0]))
    for colour, width, zorder in (("white", 0.11, 4), (list(colours), 0.07, 5)):
        panel.quiver(
            *digs.T,
            *along.T,
            color=colour,
            pivot="tip",
            angles="xy",
            scale_units="xy",
            scale=1.0,
            units="xy",
            width=width * length,
            headwidth=3.4 if zorder == 4 else 4.2,
            headlength=4.0,
            headaxislength=3.4,
            zorder=zorder,
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
