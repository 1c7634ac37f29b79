"""The digs of a plan on a map, their numbers placed so that no line crosses another."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from wlplan.report.figures.relief import RISE, height_above_ground
from wlplan.report.figures.style import BLUE, PANEL_WIDTH, add_arrow
from wlplan.types import Pile

# Radius of the numbers of the digs, as a part of the longer side of the view.
LABEL_PART = 0.02
# More digs than this have colours instead of numbers.
MOST_NUMBERED = 20
# Light to dark, told apart by everybody, and none of them the colour of soil.
ORDER = LinearSegmentedColormap.from_list("order", ("#8fd3ff", "#1f5fa8", "#0b1f3a"))


def label_places(
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

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Sign of the turn from a to b to c, for each pair of segments."""
        sign: np.ndarray = np.sign(
            (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1])
            - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
        )
        return sign

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
    on_pile: np.ndarray = inside & (height_above_ground(pile)[i, j] > RISE)
    return on_pile


def _distance(
    points: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " n"]:
    """Distance to the nearest of the others [m]; infinite if there are none."""
    apart = points[:, np.newaxis] - others[np.newaxis]
    nearest: np.ndarray = np.min(np.hypot(apart[..., 0], apart[..., 1]), axis=1, initial=np.inf)
    return nearest


def draw_digs(
    panel: Axes,
    digs: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, " n"],
    labels: Float[np.ndarray, "n 2"],
    radius: float,
) -> None:
    """Dig locations, headings and numbers of a plan, on a map."""
    panel.add_collection(
        LineCollection(
            list(np.stack([labels, digs], axis=1)),
            colors=BLUE,
            linewidths=0.7,
            alpha=0.8,
            zorder=5,
        )
    )
    reach = 3.4 * radius
    # The numbers fit their circles: a point is 1/72 inch.
    low, high = panel.get_xlim()
    points_per_metre = 72.0 * PANEL_WIDTH / (high - low)
    for number, (dig, towards, label) in enumerate(zip(digs, heading, labels, strict=True), 1):
        tip = dig + reach * np.array([math.cos(towards), math.sin(towards)])
        add_arrow(panel, dig, tip, colour=BLUE, line=1.2, head=9.0, zorder=6)
        panel.add_patch(
            Circle(tuple(label), radius, facecolor=BLUE, edgecolor="white", linewidth=0.8, zorder=8)
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
    panel.plot(*digs.T, "o", color=BLUE, markersize=4.0, markeredgecolor="white", mew=0.6, zorder=7)


def draw_many_digs(
    figure: Figure,
    panel: Axes,
    digs: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, " n"],
    radius: float,
) -> None:
    """Dig locations and headings, whose colours say the order, with a bar of the colours."""
    norm = Normalize(1, len(digs))
    back = digs - 2.2 * radius * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    colours = ORDER(norm(np.arange(1, len(digs) + 1)))
    panel.add_collection(
        LineCollection(
            list(np.stack([back, digs], axis=1)), colors=colours, linewidths=1.4, zorder=6
        )
    )
    panel.scatter(
        digs[:, 0], digs[:, 1], c=colours, s=20.0, edgecolors="white", linewidths=0.6, zorder=7
    )
    bar = figure.colorbar(
        ScalarMappable(norm, ORDER),
        cax=panel.inset_axes((0.58, 0.055, 0.38, 0.022)),
        orientation="horizontal",
    )
    bar.set_ticks([1, len(digs)], labels=["load 1", str(len(digs))])
    bar.ax.tick_params(labelsize=8, length=2)
    bar.outline.set_visible(False)
