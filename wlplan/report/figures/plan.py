"""A plan on its pile: what is dug in which order and by which ways, and the pile that is left."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure

from wlplan.report.figures.digs import (
    MOST_NUMBERED,
    ORDER,
    draw_digs,
    number_radius,
    order_colours,
    rows_numbered,
)
from wlplan.report.figures.key import KeyLine, handle
from wlplan.report.figures.orientation import draw_orientation
from wlplan.report.figures.relief import (
    PILE,
    STANDS,
    UNSEEN,
    contour_step,
    draw_pile,
    draw_toe,
    height_above_ground,
    shaped,
    view_of,
)
from wlplan.report.figures.style import (
    FAINT,
    GREEN,
    INK,
    axes_at,
    bare_figure,
    frame_map,
    without_coordinates,
)
from wlplan.report.figures.truck import Truck, draw_area, draw_truck, trucks_of
from wlplan.report.figures.ways import draw_ways
from wlplan.report.legs import approaches
from wlplan.site.frame import LOCAL, Frame
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.polygon import Polygon
from wlplan.site.receiver import Receiver
from wlplan.terrain.standing import standing
from wlplan.types import LoadingPlan, Pile

# Ground around what a map shows [m].
_MARGIN = 0.8
# Widths of the map of the plan and of the one beside it, gaps, room for the labels of axes, and
# for the strip of key numbers [inch].
_WIDE, _NARROW, _GAP, _LABELS, _STRIP = 7.4, 3.7, 0.35, 0.62, 0.8
# The least and the largest height of a map over its width, also of one of a step.
_FLATTEST, _TALLEST = 0.85, 1.1
_STEP = 0.6, 1.1
# Of the approach, in the small maps of steps [m]; of more digs there the first and the last have
# numbers.
_LANE, _FEW = 3.5, 5
# Width of a letter of the key figures' words [inch], and how much wider their values are.
_LETTER, _LARGE = 0.085, 2.3
# Height of the colour bar and of a line of the key [inch].
_BAR, _LINE = 0.62, 0.235


@dataclasses.dataclass(frozen=True)
class PlanOnPile:
    """What the maps of a plan show.

    Attributes:
        before: Pile before the first loading.
        plan: N loadings in order, leaves [N].
        receiver: Where the loader dumps, drawn as a truck across its heading; leaves (K,) for
            trucks with places of their own; None: nothing.
        ways: Points of the way of each load: x [m], y [m], heading [rad] and gear; empty if they
            are not known.
        area: Polygons that trucks may stand in; None: anywhere.
        frame: What the coordinates on the axes are in.
        machine: The loader, for its approach and how the truck stands to it.
    """

    before: Pile
    plan: LoadingPlan
    receiver: Receiver | None = None
    ways: Sequence[Float[np.ndarray, "_ 4"]] = ()
    area: tuple[Polygon, ...] | None = None
    frame: Frame = LOCAL
    machine: WheelLoader = WA320

    @property
    def digs(self) -> Float[np.ndarray, "n 2"]:
        """Where the bucket goes in [m]."""
        pose = self.plan.pose
        return np.stack([np.asarray(pose.x), np.asarray(pose.y)], axis=-1).astype(float)

    @property
    def heading(self) -> Float[np.ndarray, " n"]:
        """Into the pile [rad]."""
        return np.asarray(self.plan.pose.heading, float)

    @property
    def has_ways(self) -> bool:
        """Whether a way is known."""
        return any(len(way) for way in self.ways)

    @property
    def trucks(self) -> list[Truck]:
        """One at each of the different places."""
        if self.receiver is None:
            return []
        return [dataclasses.replace(one, machine=self.machine) for one in trucks_of(self.receiver)]

    @property
    def norm(self) -> Normalize:
        """Scale of the heights above the ground, the same in all maps."""
        return Normalize(0.0, max(float(height_above_ground(self.before).max()), 0.1))

    @property
    def points(self) -> Float[np.ndarray, "n 2"]:
        """What a map of the work has to show [m]: approaches, and ways and trucks if near."""
        lanes = approaches(self.digs, self.heading, self.machine.approach_distance).reshape(-1, 2)
        # What is near is near the pile: a short way to go round it counts too.
        view = view_of(self.before, lanes)
        near = [truck.body for truck in self.trucks if truck.is_near(view)]
        if not near:
            return lanes
        return np.concatenate([lanes, *near, *(way[:, :2] for way in self.ways)])

    def view(self, ratio: tuple[float, float]) -> Float[np.ndarray, "2 2"]:
        """Corners of the map of the work [m], its height over its width within those limits."""
        points = self.points
        view = np.stack([points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN])
        # Room that is left over shows the pile.
        return shaped(view, ratio, towards=view_of(self.before, self.digs).mean(axis=0))


def plan_figure(
    shown: PlanOnPile,
    after: Pile,
    *,
    after_title: str | None = None,
    figures: Sequence[tuple[str, str]] = (),
) -> Figure:
    """The work on the pile, the pile that is left, a key, and the most important figures above.

    Args:
        shown: What to show.
        after: Pile after the last loading, on the same grid.
        after_title: Title of the second map; by default the number of loads.
        figures: The most important ones, each with a line or two of words; at most five.
    """
    view = shown.view((_FLATTEST, _TALLEST))
    height = _WIDE * _ratio(view)
    key = key_of(shown)
    beside = height - _BAR - _LINE * (len(key) + 1) - 0.25
    top = _STRIP if figures else 0.0
    figure = bare_figure(
        _LABELS + _WIDE + _GAP + _NARROW + 0.1, _LABELS + height + 0.4 + top + 0.05
    )
    draw_work(axes_at(figure, _LABELS, _LABELS, _WIDE, height), shown, view, _WIDE)

    left = _LABELS + _WIDE + _GAP
    panel = axes_at(figure, left, _LABELS + height - beside, _NARROW, beside)
    whole = shaped(view_of(shown.before, shown.digs), (beside / _NARROW,) * 2)
    draw_left(panel, shown, after, whole, after_title)
    without_coordinates(panel)
    bar = axes_at(figure, left, _LABELS + height - beside - 0.28, _NARROW, 0.13)
    draw_height_bar(figure, bar, shown)
    lines = axes_at(figure, left, _LABELS, _NARROW, _LINE * len(key))
    lines.set_axis_off()
    lines.legend(
        handles=[handle(line) for line in key],
        labels=[line.words for line in key],
        loc="lower left",
        bbox_to_anchor=(-0.03, -0.04),
        borderaxespad=0.0,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handlelength=2.6,
        labelspacing=0.35,
    )
    _write_strip(figure, figures)
    return figure


def work_figure(shown: PlanOnPile, *, width: float = 4.6) -> Figure:
    """The work on the pile alone.

    Args:
        shown: What to show.
        width: Of the map [inch].
    """
    view = shown.view((_FLATTEST, _TALLEST))
    height = width * _ratio(view)
    figure = bare_figure(width + _LABELS + 0.1, height + _LABELS + 0.4)
    draw_work(axes_at(figure, _LABELS, _LABELS, width, height), shown, view, width)
    return figure


def left_figure(
    shown: PlanOnPile, after: Pile, title: str | None = None, *, width: float = 4.6
) -> Figure:
    """The pile that is left, with a bar for its heights, as high as `work_figure`.

    Args:
        shown: What was done.
        after: Pile after the last loading.
        title: By default the number of loads.
        width: Of the map [inch].
    """
    height = width * _ratio(shown.view((_FLATTEST, _TALLEST)))
    figure = bare_figure(width + _LABELS + 0.1, height + _LABELS + 0.4)
    panel = axes_at(figure, _LABELS, _LABELS + _BAR, width, height - _BAR)
    view = shaped(view_of(shown.before, shown.digs), ((height - _BAR) / width,) * 2)
    draw_left(panel, shown, after, view, title)
    panel.set_xlabel("")
    draw_height_bar(figure, axes_at(figure, _LABELS, _LABELS - 0.05, width, 0.13), shown)
    return figure


def step_figure(shown: PlanOnPile, pile: Pile, rows: slice, *, width: float = 2.2) -> Figure:
    """Some loads that follow each other, on the pile as it is before them.

    Args:
        shown: The whole plan.
        pile: Before the first of these loads.
        rows: These loads.
        width: Of the map [inch].
    """
    numbers = range(1, len(shown.digs) + 1)[rows]
    digs, heading = shown.digs[rows], shown.heading[rows]
    numbered = [*range(len(digs))] if len(digs) <= _FEW else [0, len(digs) - 1]
    lanes = approaches(shown.digs, shown.heading, _LANE).reshape(-1, 2)
    view = shaped(view_of(shown.before, lanes), _STEP)
    # All steps have one view, in which the numbers of each have room.
    radius = number_radius(float(np.ptp(view[:, 0])) / width)
    far = approaches(shown.digs, shown.heading, max(_LANE, 7.0 * radius)).reshape(-1, 2)
    view = shaped(view_of(shown.before, far), _STEP)
    figure = bare_figure(width + 0.1, width * _ratio(view) + 0.4)
    panel = axes_at(figure, 0.05, 0.05, width, width * _ratio(view))
    draw_pile(panel, pile, PILE, shown.norm)
    more = f"s {numbers[0]} to {numbers[-1]}" if len(numbers) > 1 else f" {numbers[0]}"
    frame_map(panel, view, f"Load{more}", shown.frame)
    panel.title.set_fontsize(9)
    without_coordinates(panel)
    draw_toe(panel, shown.before, "dashed")
    draw_digs(
        panel,
        digs,
        heading,
        order_colours(len(shown.digs))[rows],
        numbers=numbers,
        numbered=numbered,
        approach=_LANE,
        metres_per_inch=float(np.ptp(view[:, 0])) / width,
    )
    return figure


def draw_work(panel: Axes, shown: PlanOnPile, view: Float[np.ndarray, "2 2"], width: float) -> None:
    """The pile before the first load, with all digs, ways and trucks.

    Args:
        panel: That is drawn into.
        shown: What to show.
        view: Corners of the map [m].
        width: Of the panel [inch].
    """
    count = len(shown.digs)
    loads = "1 load" if count == 1 else f"{count} loads"
    draw_pile(panel, shown.before, PILE, shown.norm)
    frame_map(panel, view, f"Before, with {loads} planned", shown.frame)
    draw_toe(panel, shown.before, "solid")
    if shown.area is not None:
        draw_area(panel, shown.area)
    for truck in shown.trucks:
        draw_truck(panel, truck, view)
    colours = order_colours(count)
    if shown.has_ways:
        draw_ways(panel, shown.ways, colours)
    scale = float(np.ptp(view[:, 0])) / width
    draw_digs(
        panel,
        shown.digs,
        shown.heading,
        colours,
        numbers=range(1, count + 1),
        numbered=rows_numbered(count),
        approach=shown.machine.approach_distance,
        metres_per_inch=scale,
    )
    draw_orientation(panel, view, shown.points)


def draw_left(
    panel: Axes,
    shown: PlanOnPile,
    after: Pile,
    view: Float[np.ndarray, "2 2"],
    title: str | None = None,
) -> None:
    """The pile that is left, and where it stood."""
    count = len(shown.digs)
    draw_pile(panel, after, PILE, shown.norm)
    frame_map(panel, view, title or f"After {count} load{'s'[: count > 1]}", shown.frame)
    draw_toe(panel, shown.before, "dashed")


def draw_height_bar(figure: Figure, place: Axes, shown: PlanOnPile) -> None:
    """The colours of the heights, in axes of their own."""
    bar = figure.colorbar(ScalarMappable(shown.norm, PILE), cax=place, orientation="horizontal")
    bar.set_label("height above the ground [m]", fontsize=8.5, color=INK, labelpad=1.0)
    bar.ax.tick_params(labelsize=8, length=2, colors=FAINT)
    bar.outline.set_visible(False)


def _ratio(view: Float[np.ndarray, "2 2"]) -> float:
    """Height over width."""
    size = np.ptp(view, axis=0)
    return float(size[1] / size[0])


def key_of(shown: PlanOnPile) -> list[KeyLine]:
    """What the lines of the maps of a plan mean, those alone that are drawn."""
    middle, count = to_hex(ORDER(0.5)), len(shown.digs)
    order = "numbered in order" if count <= MOST_NUMBERED else "light to dark in order"
    lines = [KeyLine("arrow", middle, f"approach and dig, {order}")]
    if shown.has_ways:
        lines += [
            KeyLine("reverse", middle, "back in reverse"),
            KeyLine("forward", middle, "forward to the truck"),
        ]
    step = contour_step(float(height_above_ground(shown.before).max()))
    lines += [
        KeyLine("line", INK, "toe of the pile; dashed: as it was"),
        KeyLine("thin", INK, f"contour lines every {step:g} m"),
    ]
    if shown.area is not None:
        lines.append(KeyLine("line", GREEN, "where trucks may stand"))
    if standing(np.asarray(shown.before.floor), shown.before.cell_size).any():
        lines.append(KeyLine("solid", STANDS, "stands there, and is not soil"))
    if has_unseen(shown.before, shown.view((_FLATTEST, _TALLEST))):
        lines.append(KeyLine("unseen", UNSEEN["edgecolor"], "not seen by the scan"))
    return lines


def has_unseen(pile: Pile, view: Float[np.ndarray, "2 2"]) -> bool:
    """Whether a map shows ground that the scan did not see, or that lies beyond it."""
    low = np.asarray(pile.origin, float) - 0.5 * pile.cell_size
    high = low + pile.cell_size * np.array(pile.height.shape)
    beyond = bool((view[0] < low).any() or (view[1] > high).any())
    return beyond or (pile.valid is not None and not bool(np.asarray(pile.valid).all()))


def _write_strip(figure: Figure, figures: Sequence[tuple[str, str]]) -> None:
    """The key figures above the maps, each as wide as its longest line."""
    width, height = (float(side) for side in figure.get_size_inches())
    lengths = [
        max(_LARGE * len(value), *(len(line) for line in words.split("\n"))) + 3
        for value, words in figures
    ]
    # Where there is room, they do not stand wider apart than it takes.
    inch = min((width - _LABELS) / max(sum(lengths), 1), _LETTER)
    x, y = _LABELS / width, 1.0 - 0.34 / height
    for (value, words), length in zip(figures, lengths, strict=True):
        figure.text(x, y, value, fontsize=17, fontweight="bold", color=INK, va="bottom")
        figure.text(x, y - 0.06 / height, words, fontsize=8.5, color=FAINT, va="top")
        x += length * inch / width
