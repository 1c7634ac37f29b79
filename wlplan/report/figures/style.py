"""How all figures look: colours, sizes, axes, arrows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from wlplan.site.frame import LOCAL, Frame

# Colours that people with the common kinds of colour blindness tell apart.
INK = "#1d2733"
FAINT = "#6b7785"
PALE = "#c9ced4"
BLUE = "#1f5fa8"
ORANGE = "#d9700a"
GREEN = "#3a7d44"
# Width of one map [inch].
PANEL_WIDTH = 5.6


def new_figure(width: float, height: float) -> Figure:
    """An empty figure [inch] that is not known to pyplot."""
    figure = Figure(figsize=(width, height), layout="compressed", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def bare_figure(width: float, height: float) -> Figure:
    """As `new_figure`, but who draws says where axes are, see `axes_at`."""
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def axes_at(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """New axes at a place of a figure, counted from its lower left [inch]."""
    across, up = (float(side) for side in figure.get_size_inches())
    return figure.add_axes((left / across, bottom / up, width / across, height / up))


def map_panels(view: Float[np.ndarray, "2 2"], count: int) -> tuple[Figure, list[Axes]]:
    """A row of panels that fit a view."""
    size = np.ptp(view, axis=0)
    figure = new_figure(count * PANEL_WIDTH + 1.0, PANEL_WIDTH * float(size[1] / size[0]) + 1.0)
    return figure, list(np.atleast_1d(figure.subplots(1, count)))


def frame_map(
    panel: Axes, view: Float[np.ndarray, "2 2"], title: str, frame: Frame = LOCAL
) -> None:
    """Limits, labels and title of a map [m]; the labels are in the coordinates of the scan."""
    panel.set_xlim(view[0, 0], view[1, 0])
    panel.set_ylim(view[0, 1], view[1, 1])
    panel.set_aspect("equal")
    panel.set_title(title, color=INK, fontsize=11)
    panel.set_xlabel("x, east [m]")
    panel.set_ylabel("y, north [m]")
    panel.set_facecolor("white")
    for axis, offset in ((panel.xaxis, frame.offset[0]), (panel.yaxis, frame.offset[1])):
        # Coordinates of a survey are long.
        axis.set_major_locator(MaxNLocator(4 if offset else 7, steps=[1, 2, 5, 10]))
        if offset:
            axis.set_major_formatter(_shifted(offset))
    tidy(panel, grid=False)


def without_coordinates(panel: Axes) -> None:
    """Takes the coordinates off the axes of a map."""
    panel.tick_params(labelleft=False, labelbottom=False, length=0)
    panel.set_xlabel("")
    panel.set_ylabel("")


def _shifted(offset: float) -> FuncFormatter:
    """Labels of an axis that add an offset [m]."""
    return FuncFormatter(lambda value, _: f"{value + offset:.10g}")


def tidy(panel: Axes, *, grid: bool = True) -> None:
    """Axes without what distracts from the data."""
    for name, spine in panel.spines.items():
        spine.set_color("#b4bac1")
        if grid and name in ("top", "right"):
            spine.set_visible(False)
    panel.tick_params(colors=FAINT, labelsize=8.5, length=3)
    panel.xaxis.label.set_color(INK)
    panel.yaxis.label.set_color(INK)
    if grid:
        panel.grid(True, axis="y", color="#e4e7ea", linewidth=0.8)
        panel.set_axisbelow(True)


def add_arrow(
    panel: Axes,
    start: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    *,
    colour: str | Float[np.ndarray, "4"],
    line: float,
    head: float,
    zorder: int,
    casing: bool = False,
) -> None:
    """An arrow on a map, from point to point [m].

    Args:
        panel: The map.
        start: Where its line begins, without a gap.
        end: Where its head ends, likewise.
        colour: Of line and head.
        line: Width of the line [point].
        head: Size of the head [point].
        zorder: Arrows are drawn over what has a smaller one.
        casing: Whether it has a white edge, to stand out from what is under it.
    """
    edge = [patheffects.withStroke(linewidth=line + 1.4, foreground="white", alpha=0.8)]
    panel.add_patch(
        FancyArrowPatch(
            (float(start[0]), float(start[1])),
            (float(end[0]), float(end[1])),
            arrowstyle="-|>",
            mutation_scale=head,
            color=colour,
            linewidth=line,
            shrinkA=0.0,
            shrinkB=0.0,
            path_effects=edge if casing else None,
            zorder=zorder,
        )
    )
