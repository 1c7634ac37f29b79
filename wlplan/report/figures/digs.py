"""The digs of a plan on a map: arrows in the colour of their order, the numbers in their tails."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.patches import Circle

from wlplan.report.figures.style import INK, add_arrow
from wlplan.report.legs import approaches

ORDER = LinearSegmentedColormap.from_list("order", ("#5bb8f0", "#1f5fa8", "#0b1f3a"))
"""Light to dark, told apart by everybody, and none of them the colour of soil."""
# Of more digs than this each tenth is numbered, and their arrows are short [m].
MOST_NUMBERED = 20
_EVERY, _SHORT = 10, 1.8
# A number lies so many of its radii behind its dig at least.
_BEHIND = 4.0
# Radius of a number [inch], and its letters [point].
_RADIUS, _LETTERS = 0.105, 8.5
# Brightness above which letters on a colour are dark.
_BRIGHT = 0.55


def order_colours(count: int) -> Float[np.ndarray, "n 4"]:
    """The colours of loads in their order."""
    colours: np.ndarray = ORDER(Normalize(1, max(count, 2))(np.arange(1, count + 1)))
    return colours


def rows_numbered(count: int) -> list[int]:
    """Rows of the digs whose numbers a map shows: all, or of many the first and each tenth."""
    many = count > MOST_NUMBERED
    return [n for n in range(count) if not many or n == 0 or (n + 1) % _EVERY == 0]


def number_radius(metres_per_inch: float) -> float:
    """Radius of a number on a map of that scale [m]."""
    return _RADIUS * metres_per_inch


def number_places(
    digs: Float[np.ndarray, "n 2"],
    heading: Float[np.ndarray, " n"],
    radius: float,
    rows: Sequence[int],
) -> Float[np.ndarray, "m 2"]:
    """Places for round numbers of that radius [m], straight behind digs.

    The nearest place wins that is free of other numbers and of the tips of all arrows: so each
    number lies on its own arrow, and none over another.

    Args:
        digs: Where the tips of all arrows are [m].
        heading: Of them [rad].
        radius: Of the numbers [m].
        rows: Of the digs that get a number.
    """
    places = np.zeros((0, 2))
    for row in rows:
        back = -np.array([math.cos(heading[row]), math.sin(heading[row])])
        tries = digs[row] + radius * np.arange(_BEHIND, 400.0, 0.5)[:, None] * back
        free = (_distance(tries, digs) > 1.8 * radius) & (_distance(tries, places) > 2.1 * radius)
        places = np.concatenate([places, tries[int(np.argmax(free))][None]])
    return places


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
    colours: Float[np.ndarray, "n 4"],
    *,
    numbers: range,
    numbered: Sequence[int],
    approach: float,
    metres_per_inch: float,
) -> None:
    """Arrows along which the loader comes, up to where the bucket goes in, with numbers.

    Args:
        panel: The map.
        digs: Where the bucket goes in [m].
        heading: Into the pile [rad].
        colours: Of each.
        numbers: Of the loads.
        numbered: Rows of those whose numbers are shown.
        approach: From where the loader waits to the dig [m].
        metres_per_inch: Scale of the map.
    """
    many = len(digs) > MOST_NUMBERED
    for n, (start, tip) in enumerate(approaches(digs, heading, _SHORT if many else approach)):
        add_arrow(
            panel,
            start,
            tip,
            colour=colours[n],
            line=1.1 if many else 1.9,
            head=7.0 if many else 11.0,
            zorder=6,
            casing=not many,
        )
    # Where arrows lie over each other their tips are seen.
    panel.scatter(
        digs[:, 0],
        digs[:, 1],
        c=colours,
        s=5.0 if many else 14.0,
        edgecolors="white",
        linewidths=0.6,
        zorder=7,
    )
    radius = number_radius(metres_per_inch)
    places = number_places(digs, heading, radius, numbered)
    for n, place in zip(numbered, places, strict=True):
        # A number beyond the tail is led to it.
        panel.plot(*np.stack([place, digs[n]]).T, color=colours[n], linewidth=0.8, zorder=5)
        draw_number(panel, place, numbers[n], colours[n], radius)


def draw_number(
    panel: Axes,
    place: Float[np.ndarray, "2"],
    number: int,
    colour: Float[np.ndarray, "4"],
    radius: float,
) -> None:
    """A round number on a map, of that radius [m]."""
    panel.add_patch(
        Circle(
            (float(place[0]), float(place[1])),
            radius,
            facecolor=colour,
            edgecolor="white",
            linewidth=0.8,
            zorder=8,
        )
    )
    bright = float(np.dot(colour[:3], (0.3, 0.59, 0.11))) > _BRIGHT
    panel.text(
        float(place[0]),
        float(place[1]),
        str(number),
        color=INK if bright else "white",
        fontsize=_LETTERS if number < 100 else 0.75 * _LETTERS,
        fontweight="bold",
        ha="center",
        va="center_baseline",
        zorder=9,
        clip_on=True,
    )
