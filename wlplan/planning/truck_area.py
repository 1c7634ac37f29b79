"""The area where trucks may stand: a whole truck stands inside one of some polygons."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from wlplan.errors import InputError
from wlplan.site.machine import WheelLoader
from wlplan.site.polygon import Polygon, holds, is_inside
from wlplan.site.receiver import truck_outline

# What a truck may be outside by: places go through degrees and float32 [m].
_ROUNDING = 2e-3
# Places that are tried in a polygon: no nearer to each other than this [m], about so many, turned
# by steps of so many degrees; and turned as this many of its longest edges.
_NEAREST, _PLACES, _TURN, _EDGES = 0.25, 800, 15.0, 4


def stands_inside(
    places: Float[np.ndarray, "n 3"], area: tuple[Polygon, ...] | None, machine: WheelLoader
) -> Bool[np.ndarray, " n"]:
    """Whether the whole truck that belongs to receivers stands inside one of the polygons.

    Args:
        places: x [m], y [m] and heading [rad] of the receivers.
        area: The polygons; None: a truck may stand anywhere.
        machine: What loads it.
    """
    if area is None:
        return np.ones(len(places), bool)
    near, far, half = truck_outline(machine)
    trucks = _shifted(places, 0.5 * (near + far))
    sides = far - near - _ROUNDING, 2.0 * half - _ROUNDING
    inside: np.ndarray = np.any([holds(polygon, trucks, sides) for polygon in area], axis=0)
    return inside


def places_inside(area: tuple[Polygon, ...], machine: WheelLoader) -> Float[np.ndarray, "n 3"]:
    """Receivers all over an area: x [m], y [m] and heading [rad].

    Raises:
        InputError: If no truck fits into it.
    """
    near, far, half = truck_outline(machine)
    tried = []
    for polygon in area:
        outline = polygon[0]
        low, high = outline.min(axis=0), outline.max(axis=0)
        step = max(_NEAREST, math.sqrt(float(np.prod(high - low)) / _PLACES))
        axes = np.meshgrid(*(np.arange(a, b, step) for a, b in zip(low, high, strict=True)))
        points = np.stack([axis.ravel() for axis in axes], axis=-1)
        # The middle too: in it fits what is hardly smaller than the polygon.
        points = np.concatenate([points[is_inside(polygon, points)], _middle(outline)[None]])
        edges = np.roll(outline, -1, axis=0) - outline
        longest = edges[np.argsort(-np.hypot(*edges.T))[:_EDGES]]
        turns = np.concatenate(
            [
                np.radians(np.arange(0.0, 360.0, _TURN)),
                *(
                    np.arctan2(longest[:, 1], longest[:, 0]) + quarter * 0.5 * math.pi
                    for quarter in range(4)
                ),
            ]
        )
        row, turn = (a.ravel() for a in np.meshgrid(np.arange(len(points)), turns, indexing="ij"))
        tried.append(np.concatenate([points[row], turn[:, None]], axis=1))
    places = _shifted(np.concatenate(tried), -0.5 * (near + far))
    inside: np.ndarray = places[stands_inside(places, area, machine)]
    if not len(inside):
        raise InputError(
            f"no truck, {2.0 * half:.1f} m by {far - near:.1f} m, fits into the area for trucks: "
            f"draw it larger."
        )
    return inside


def nearest_of(
    allowed: Float[np.ndarray, "n 3"], places: Float[np.ndarray, "k 3"], machine: WheelLoader
) -> Float[np.ndarray, "k 3"]:
    """For each of some receivers the one among those allowed that is most like it."""
    rows = []
    for place in places:
        turn = np.remainder(allowed[:, 2] - place[2] + math.pi, 2.0 * math.pi) - math.pi
        apart = np.hypot(*(allowed[:, :2] - place[:2]).T)
        rows.append(int(np.argmin(apart + machine.turning_radius * np.abs(turn))))
    nearest: np.ndarray = allowed[rows]
    return nearest


def _shifted(places: Float[np.ndarray, "n 3"], ahead: float) -> Float[np.ndarray, "n 3"]:
    """Places moved along their headings [m]."""
    x, y, heading = places.T
    return np.stack([x + ahead * np.cos(heading), y + ahead * np.sin(heading), heading], axis=-1)


def _middle(ring: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """The centre of area of a ring; of one without area that of its corners."""
    x, y = (ring - ring[0]).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    if abs(cross.sum()) < 1e-9:
        corners: np.ndarray = ring.mean(axis=0)
        return corners
    sums = np.stack([(v + np.roll(v, -1)) @ cross for v in (x, y)])
    middle: np.ndarray = ring[0] + sums / (3.0 * cross.sum())
    return middle
