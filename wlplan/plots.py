"""Figures: a plan on its pile, predicted beside simulated totals, diggability maps.

Every function returns a matplotlib figure that is bound to no screen and no global state. Maps
are drawn in the world frame, in metres, north up; light falls from the north-west.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os

import numpy as np
from jaxtyping import Bool, Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon

from wlplan.diggability import DiggabilityMap
from wlplan.io import write_bytes_atomic
from wlplan.pile import ground_height
from wlplan.transport import Receiver
from wlplan.types import LoadingPlan, Performance, Pile

# Colours that people with the common kinds of colour blindness tell apart.
_INK = "#1d2733"
_FAINT = "#6b7785"
_BLUE = "#1f5fa8"
_ORANGE = "#d9700a"
_PILE = LinearSegmentedColormap.from_list(
    "pile", ["#e4e2dc", "#e8d3a8", "#d5a766", "#a97640", "#6b472b"]
)
_STONE = LinearSegmentedColormap.from_list("stone", ["#eae9e6", "#b4b1ab"])

# Rise above the ground that counts as pile [m], as for the toe contour.
_RISE = 0.15
# Spacings of contour lines to choose from [m]; the widest that gives at least this many is taken.
_CONTOUR_STEPS = (2.0, 1.0, 0.5, 0.25, 0.1)
_LEAST_CONTOURS = 4
# Ground shown around the pile [m], and how far a truck may stand outside that view, as a part of
# its side, to be drawn to scale; a truck further away becomes an arrow at the border.
_MARGIN = 2.0
_TRUCK_REACH = 0.75
# Body of the truck that is drawn [m]: length and width of a small hauler. Only a symbol.
_TRUCK_SIZE = (7.0, 2.6)
# Width of one map on paper [inch].
_PANEL_WIDTH = 5.6
# Radius of the numbers of the digs, as a part of the longer side of the view.
_LABEL_PART = 0.02
# Length of the line that marks a location of a diggability map [m]; at most this part of the view.
_TICK = 1.5
_TICK_PART = 0.09

_QUANTITIES = (("mass", "mass", "t"), ("time", "time", "s"), ("work", "work", "kJ"))


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
    view = _view(before, digs)
    truck = None if receiver is None else _Truck(receiver)
    seen = digs
    if truck is not None and truck.is_near(view):
        seen = np.concatenate([digs, truck.body, truck.way - truck.ahead])
    # Labels are as large as the map allows, and the map widens to hold them.
    radius = _LABEL_PART * float(np.ptp(_view(before, seen), axis=0).max())
    labels = _label_places(digs, heading, radius, before)
    view = _grow_to_ratio(_view(before, np.concatenate([seen, labels])))

    figure, panels = _maps(view, 2)
    norm = Normalize(0.0, max(float(_above(before).max()), float(_above(after).max()), 0.1))
    titles = (f"Before, with {_loads(len(digs))} planned", after_title or "")
    titles = (titles[0], titles[1] or f"After {_loads(len(digs))}")
    for panel, pile, title in zip(panels, (before, after), titles, strict=True):
        _draw_pile(panel, pile, _PILE, norm)
        _frame_map(panel, view, title)
        if truck is not None:
            _draw_truck(panel, truck, view)
    _draw_digs(panels[0], digs, heading, labels, radius)
    for panel, style in zip(panels, ("solid", "dashed"), strict=True):
        _draw_toe(panel, before, style)
    panels[1].plot(*digs.T, "o", color=_BLUE, markersize=2.5, zorder=5)
    panels[1].tick_params(labelleft=False)
    panels[1].set_ylabel("")
    bar = figure.colorbar(
        ScalarMappable(norm, _PILE), cax=panels[1].inset_axes((1.03, 0.0, 0.035, 1.0))
    )
    bar.set_label("height above the ground [m]")
    bar.outline.set_visible(False)
    _legend(figure, before)
    return figure


def totals_figure(predicted: Performance, simulated: Performance | None = None) -> Figure:
    """Mass, time and work: each loading above, accumulated below, predicted beside simulated.

    Args:
        predicted: By the world that planned, leaves [N].
        simulated: By the simulator, leaves [N]; None to leave it out.
    """
    figure = _figure(11.0, 5.8)
    panels = figure.subplots(2, 3, sharex=True)
    series: list[tuple[str, Performance, str, str]] = [("predicted", predicted, _BLUE, "o-")]
    if simulated is not None:
        series.append(("simulated", simulated, _ORANGE, "s--"))
    for column, (name, title, unit) in enumerate(_QUANTITIES):
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
        each.set_title(f"{title.capitalize()} of each load", color=_INK)
        each.set_ylabel(f"{title} [{unit}]")
        each.set_ylim(0.0, 1.18 * max(each.get_ylim()[1], 1e-3))
        total.set_title(f"{title.capitalize()} accumulated", color=_INK)
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
            color=_INK,
            fontsize=9,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2.0},
        )
        for panel in (each, total):
            _tidy(panel)
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
    view = _grow_to_ratio(_view(pile, digs - _TICK * inward))
    tick = min(_TICK, _TICK_PART * float(np.ptp(view, axis=0).max()))
    ends = np.stack([digs - tick * inward, digs], axis=1)

    ratio = float(np.divide(*np.ptp(view, axis=0)[::-1]))
    figure = _figure(12.0, 12.0 / 3.3 * ratio + 2.7)
    panels = figure.subplots(2, 3, height_ratios=[12.0 / 3.3 * ratio, 1.6])
    norm = Normalize(0.0, max(float(_above(pile).max()), 0.1))
    colours = colormaps["viridis"]
    for column, (name, title, unit) in enumerate(_QUANTITIES):
        panel, histogram = panels[0, column], panels[1, column]
        label = f"{'Load' if name == 'mass' else 'Loading'} {title}"
        values = np.asarray(getattr(diggability.performance, name), float)
        edges = _bins(values)
        scale = Normalize(edges[0], edges[-1])
        _draw_pile(panel, pile, _STONE, norm, contour_alpha=0.35)
        _frame_map(panel, view, f"{label} [{unit}]")
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
        histogram.axvline(float(np.median(values)), color=_INK, linewidth=1.0, linestyle=":")
        histogram.set_title(
            f"median {np.median(values):.3g} {unit}, {values.min():.3g} to {values.max():.3g}",
            fontsize=9,
            color=_FAINT,
        )
        histogram.set_xlabel(f"{label.lower()} [{unit}]")
        histogram.yaxis.get_major_locator().set_params(integer=True)
        _tidy(histogram)
        if column:
            panel.set_ylabel("")
            panel.tick_params(labelleft=False)
    panels[1, 0].set_ylabel("locations")
    return figure


def png_bytes(figure: Figure, *, dpi: int = 150) -> bytes:
    """A figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(
        buffer,
        format="png",
        dpi=dpi,
        bbox_inches="tight",
        pad_inches=0.12,
        metadata={"Software": None},
    )
    return buffer.getvalue()


def save_figure(path: str | os.PathLike[str], figure: Figure, *, dpi: int = 150) -> None:
    """Write a figure as PNG, in one piece or not at all.

    Raises:
        InputError: If the file cannot be written.
    """
    write_bytes_atomic(path, png_bytes(figure, dpi=dpi))


# --- the map under everything


def _above(pile: Pile) -> Float[np.ndarray, "nx ny"]:
    """Height of the surface above the ground [m]."""
    return np.asarray(pile.height, float) - np.asarray(ground_height(pile), float)


def _extent(pile: Pile) -> tuple[float, float, float, float]:
    """Outer borders of the grid [m]: left, right, bottom, top."""
    low = np.asarray(pile.origin, float) - 0.5 * pile.cell_size
    high = low + pile.cell_size * np.array(pile.height.shape)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _view(pile: Pile, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2 2"]:
    """Lower left and upper right corner of what to show [m]: the pile, the points, a margin."""
    cells = np.argwhere(_above(pile) > _RISE)
    if len(cells) == 0:
        cells = np.array([[0, 0], pile.height.shape])
    shown = np.asarray(pile.origin, float) + pile.cell_size * cells
    shown = np.concatenate([shown, points])
    return np.stack([shown.min(axis=0) - _MARGIN, shown.max(axis=0) + _MARGIN])


def _grow_to_ratio(view: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    """Widen the shorter side of a view until neither is more than 1.4 times the other."""
    size = view[1] - view[0]
    grow = 0.5 * np.maximum(size.max() / 1.4 - size, 0.0)
    return np.stack([view[0] - grow, view[1] + grow])


def _relief(height: Float[np.ndarray, "nx ny"], cell_size: float) -> Float[np.ndarray, "nx ny"]:
    """Brightness of a surface lit from the north-west, 1 where it is level."""
    # Light from 315 degrees at 40 degrees above the horizon; slopes are drawn 1.3 times as steep.
    elevation, exaggeration = math.radians(40.0), 1.3
    east, north = np.gradient(exaggeration * height, cell_size)
    light = np.array([-math.sqrt(0.5), math.sqrt(0.5)]) * math.cos(elevation)
    facing = (math.sin(elevation) - east * light[0] - north * light[1]) / np.sqrt(
        1.0 + east**2 + north**2
    )
    return np.clip(1.0 + 0.6 * (facing - math.sin(elevation)), 0.4, 1.13)


def _draw_pile(
    panel: Axes,
    pile: Pile,
    colours: LinearSegmentedColormap,
    norm: Normalize,
    *,
    contour_alpha: float = 0.55,
) -> None:
    """Shaded heights above the ground, contour lines, and hatching over unseen cells."""
    above = _above(pile)
    surface = np.asarray(pile.height, float)
    image = colours(norm(above))[..., :3] * _relief(surface, pile.cell_size)[..., np.newaxis]
    panel.imshow(
        np.clip(image, 0.0, 1.0).transpose(1, 0, 2),
        origin="lower",
        extent=_extent(pile),
        interpolation="bilinear",
        zorder=1,
    )
    x, y = _axes_of(pile)
    step = _contour_step(float(norm.vmax or 0.0))
    levels = np.arange(step, float(above.max()), step)
    if levels.size:
        panel.contour(
            x, y, above.T, levels, colors=_INK, linewidths=0.5, alpha=contour_alpha, zorder=2
        )
    if pile.valid is not None and not np.asarray(pile.valid).all():
        _hatch(panel, pile, ~np.asarray(pile.valid))


def _hatch(panel: Axes, pile: Pile, unseen: Bool[np.ndarray, "nx ny"]) -> None:
    # A border of seen cells closes the outline of unseen ones at the edge of the map.
    flags = np.pad(unseen.astype(float), 1)
    x, y = _axes_of(pile)
    x, y = (np.concatenate([[2 * a[0] - a[1]], a, [2 * a[-1] - a[-2]]]) for a in (x, y))
    grey = panel.contourf(
        x, y, flags.T, levels=[0.5, 1.5], colors=["#f4f4f2"], alpha=0.8, hatches=["////"], zorder=3
    )
    grey.set_edgecolor("#9aa1a8")
    grey.set_linewidth(0.0)


def _draw_toe(panel: Axes, pile: Pile, style: str) -> None:
    """Outline of where a pile stands or stood."""
    above = _above(pile)
    if above.max() > _RISE:
        panel.contour(
            *_axes_of(pile),
            above.T,
            levels=[_RISE],
            colors=[_BLUE],
            linewidths=0.9,
            linestyles=style,
            zorder=4,
        )


def _axes_of(pile: Pile) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]]:
    """Positions of the cell centres along x and y [m]."""
    origin = np.asarray(pile.origin, float)
    nx, ny = pile.height.shape
    return origin[0] + pile.cell_size * np.arange(nx), origin[1] + pile.cell_size * np.arange(ny)


def _contour_step(highest: float) -> float:
    """Spacing of contour lines for a pile of that height [m]."""
    return next((s for s in _CONTOUR_STEPS if highest / s >= _LEAST_CONTOURS), _CONTOUR_STEPS[-1])


# --- digs and truck


def _label_places(
    digs: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, " n"], radius: float, pile: Pile
) -> Float[np.ndarray, "n 2"]:
    """Places for round labels of that radius [m], off the pile, none over another or a dig.

    The nearest free place wins, straight behind the dig before places to its side. Where the lines
    from two labels to their digs would cross, the labels change places.
    """
    places: list[np.ndarray] = []
    sides = np.radians([0.0, 14.0, -14.0, 28.0, -28.0, 42.0, -42.0, 56.0, -56.0])
    for dig, towards in zip(digs, heading, strict=True):
        place = dig
        for ring in range(80):
            reach = (3.0 + 1.1 * ring) * radius
            tries = dig - reach * np.stack(
                [np.cos(towards + sides), np.sin(towards + sides)], axis=-1
            )
            taken = np.array(places).reshape(-1, 2)
            free = (
                (_distance(tries, digs) > 1.6 * radius)
                & (_distance(tries, taken) > 2.15 * radius)
                & ~_on_pile(tries, pile)
            )
            place = tries[int(np.argmax(free))]
            if free.any():
                break
        places.append(place)
    labels = np.array(places)
    # Each exchange shortens the lines in all, so this ends; the bound is for ties.
    for _ in range(len(labels) ** 2):
        pair = _first_crossing(digs, labels)
        if pair is None:
            break
        labels[list(pair)] = labels[list(pair[::-1])]
    return labels


def _first_crossing(
    starts: Float[np.ndarray, "n 2"], ends: Float[np.ndarray, "n 2"]
) -> tuple[int, int] | None:
    """Two of the segments from starts to ends that cross; None if there are none."""

    def side(a, b, c):
        """Sign of the turn from a to b to c, for each pair of segments."""
        return np.sign(
            (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1])
            - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
        )

    p, q = starts[:, np.newaxis], ends[:, np.newaxis]
    r, t = starts[np.newaxis], ends[np.newaxis]
    cross = (side(p, q, r) * side(p, q, t) < 0) & (side(r, t, p) * side(r, t, q) < 0)
    found = np.argwhere(np.triu(cross, 1))
    return (int(found[0, 0]), int(found[0, 1])) if len(found) else None


def _on_pile(points: Float[np.ndarray, "n 2"], pile: Pile) -> Bool[np.ndarray, " n"]:
    """Whether points lie over cells that count as pile; never outside the map."""
    cells = np.rint((points - np.asarray(pile.origin, float)) / pile.cell_size).astype(int)
    shape = np.array(pile.height.shape)
    inside = np.all((cells >= 0) & (cells < shape), axis=-1)
    i, j = np.clip(cells, 0, shape - 1).T
    return inside & (_above(pile)[i, j] > _RISE)


def _distance(
    points: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " n"]:
    """Distance to the nearest of the others [m]; infinite if there are none."""
    apart = points[:, np.newaxis] - others[np.newaxis]
    return np.min(np.hypot(apart[..., 0], apart[..., 1]), axis=1, initial=np.inf)


def _draw_digs(
    panel: Axes,
    digs: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, " n"],
    labels: Float[np.ndarray, "n 2"],
    radius: float,
) -> None:
    panel.add_collection(
        LineCollection(
            list(np.stack([labels, digs], axis=1)),
            colors=_BLUE,
            linewidths=0.7,
            alpha=0.8,
            zorder=5,
        )
    )
    reach = 3.4 * radius
    # The numbers fit their circles: a point is 1/72 inch.
    low, high = panel.get_xlim()
    points_per_metre = 72.0 * _PANEL_WIDTH / (high - low)
    for number, (dig, towards, label) in enumerate(zip(digs, heading, labels, strict=True), 1):
        tip = dig + reach * np.array([math.cos(towards), math.sin(towards)])
        panel.add_patch(
            FancyArrowPatch(
                tuple(dig),
                tuple(tip),
                arrowstyle="-|>",
                mutation_scale=9.0,
                color=_BLUE,
                linewidth=1.2,
                shrinkA=0.0,
                shrinkB=0.0,
                zorder=6,
            )
        )
        panel.add_patch(
            Circle(
                tuple(label), radius, facecolor=_BLUE, edgecolor="white", linewidth=0.8, zorder=8
            )
        )
        panel.text(
            label[0],
            label[1],
            str(number),
            color="white",
            fontsize=min(9.0, radius * points_per_metre * (1.0 if number < 100 else 0.75)),
            fontweight="bold",
            ha="center",
            va="center_baseline",
            zorder=9,
        )
    panel.plot(
        *digs.T, "o", color=_BLUE, markersize=4.0, markeredgecolor="white", mew=0.6, zorder=7
    )


@dataclasses.dataclass(frozen=True)
class _Truck:
    """A truck that stands across the end of the loader's way; corners and points [m]."""

    receiver: Receiver

    @property
    def ahead(self) -> Float[np.ndarray, "2"]:
        """Unit vector along the loader's heading."""
        heading = float(self.receiver.heading)
        return np.array([math.cos(heading), math.sin(heading)])

    @property
    def way(self) -> Float[np.ndarray, "2 2"]:
        """Start and end of the last stretch of the loader's way."""
        stand = np.array([float(self.receiver.x), float(self.receiver.y)])
        return np.stack([stand - 4.0 * self.ahead, stand])

    @property
    def body(self) -> Float[np.ndarray, "4 2"]:
        return self._box(0.0, 1.0, 1.0)

    @property
    def bed(self) -> Float[np.ndarray, "4 2"]:
        """What is loaded: the body without the cab at its left end."""
        return self._box(-0.10, 0.72, 0.84)

    def _box(self, shift: float, long: float, wide: float) -> Float[np.ndarray, "4 2"]:
        length, width = _TRUCK_SIZE
        left = np.array([-self.ahead[1], self.ahead[0]])
        centre = self.way[1] + (0.5 * width + 0.3) * self.ahead + shift * length * left
        along, across = 0.5 * long * length * left, 0.5 * wide * width * self.ahead
        return centre + np.stack([along + across, along - across, -along - across, across - along])

    def is_near(self, view: Float[np.ndarray, "2 2"]) -> bool:
        """Whether it stands near enough to a view to widen it."""
        reach = _TRUCK_REACH * np.ptp(view, axis=0).max()
        return bool(np.all((self.body > view[0] - reach) & (self.body < view[1] + reach)))


def _draw_truck(panel: Axes, truck: _Truck, view: Float[np.ndarray, "2 2"]) -> None:
    centre = truck.body.mean(axis=0)
    if not np.all((centre > view[0]) & (centre < view[1])):
        middle = view.mean(axis=0)
        away = centre - middle
        reach = float(np.min(0.5 * np.ptp(view, axis=0) / np.maximum(np.abs(away), 1e-9)))
        panel.annotate(
            f"truck\n{np.hypot(*away):.0f} m",
            xy=tuple(middle + 0.98 * reach * away),
            xytext=tuple(middle + 0.80 * reach * away),
            ha="center",
            va="center",
            fontsize=9,
            color=_INK,
            arrowprops={"arrowstyle": "-|>", "color": _INK},
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 2.0},
            zorder=10,
        )
        return
    panel.add_patch(
        Polygon(truck.body, closed=True, facecolor=_INK, edgecolor="white", linewidth=0.8, zorder=6)
    )
    panel.add_patch(
        Polygon(truck.bed, closed=True, facecolor="#c9ced4", edgecolor="none", zorder=7)
    )
    panel.add_patch(
        FancyArrowPatch(
            tuple(truck.way[0]),
            tuple(truck.way[1]),
            arrowstyle="-|>",
            mutation_scale=11.0,
            color=_INK,
            linewidth=1.6,
            shrinkA=0.0,
            shrinkB=0.0,
            zorder=7,
        )
    )
    panel.annotate(
        "truck",
        tuple(truck.way[0]),
        textcoords="offset points",
        xytext=tuple(-12.0 * truck.ahead),
        ha="center",
        va="center",
        fontsize=9,
        color=_INK,
        zorder=8,
    )


# --- paper


def _figure(width: float, height: float) -> Figure:
    """An empty figure [inch] that is not known to pyplot."""
    figure = Figure(figsize=(width, height), layout="compressed", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _maps(view: Float[np.ndarray, "2 2"], count: int) -> tuple[Figure, list[Axes]]:
    """A row of panels that fit a view."""
    size = np.ptp(view, axis=0)
    figure = _figure(count * _PANEL_WIDTH + 1.0, _PANEL_WIDTH * float(size[1] / size[0]) + 1.0)
    return figure, list(np.atleast_1d(figure.subplots(1, count)))


def _frame_map(panel: Axes, view: Float[np.ndarray, "2 2"], title: str) -> None:
    panel.set_xlim(view[0, 0], view[1, 0])
    panel.set_ylim(view[0, 1], view[1, 1])
    panel.set_aspect("equal")
    panel.set_title(title, color=_INK, fontsize=11)
    panel.set_xlabel("x, east [m]")
    panel.set_ylabel("y, north [m]")
    panel.set_facecolor("white")
    _tidy(panel, grid=False)


def _tidy(panel: Axes, *, grid: bool = True) -> None:
    for name, spine in panel.spines.items():
        spine.set_color("#b4bac1")
        if grid and name in ("top", "right"):
            spine.set_visible(False)
    panel.tick_params(colors=_FAINT, labelsize=8.5, length=3)
    panel.xaxis.label.set_color(_INK)
    panel.yaxis.label.set_color(_INK)
    if grid:
        panel.grid(True, axis="y", color="#e4e7ea", linewidth=0.8)
        panel.set_axisbelow(True)


def _legend(figure: Figure, pile: Pile) -> None:
    parts = [
        f"contour lines every {_contour_step(float(_above(pile).max())):g} m",
        "dot: dig location, arrow: heading, number: order",
        "blue outline: toe before",
    ]
    if pile.valid is not None and not np.asarray(pile.valid).all():
        parts.append("hatched: not seen by the scan")
    figure.supxlabel("   ·   ".join(parts), fontsize=8.5, color=_FAINT)


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
