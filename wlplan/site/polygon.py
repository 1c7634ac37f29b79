"""Polygons with holes, and which rectangles lie inside one."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

Polygon: TypeAlias = tuple[Float[np.ndarray, "_ 2"], ...]
"""Corners of an outline and of its holes [m]."""

# Rectangles that are looked at together.
_AT_ONCE = 4096


def is_inside(polygon: Polygon, points: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Whether points lie inside a polygon."""
    x, y = points[:, :1], points[:, 1:]
    inside = np.zeros(len(points), bool)
    for first, second in _edges(polygon):
        (x0, y0), (x1, y1) = first.T, second.T
        rise = np.where(y0 == y1, 1.0, y1 - y0)
        # An edge is crossed on the way to the east where it spans the point's north. Even and odd:
        # a hole takes out what its outline has put in.
        crossed = ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / rise)
        inside ^= crossed.sum(axis=1) % 2 == 1
    return inside


def holds(
    polygon: Polygon, places: Float[np.ndarray, "n 3"], sides: tuple[float, float]
) -> Bool[np.ndarray, " n"]:
    """Whether whole rectangles lie inside a polygon.

    Args:
        polygon: Outline and holes [m].
        places: Middle x [m], y [m] and heading [rad] of each.
        sides: Along its heading and across [m].
    """
    parts = (places[n : n + _AT_ONCE] for n in range(0, len(places), _AT_ONCE))
    return np.concatenate([np.zeros(0, bool), *(_hold(polygon, part, sides) for part in parts)])


def _hold(
    polygon: Polygon, places: Float[np.ndarray, "n 3"], sides: tuple[float, float]
) -> Bool[np.ndarray, " n"]:
    inside = is_inside(polygon, places[:, :2])
    c, s = np.cos(places[:, 2:]), np.sin(places[:, 2:])
    for ends in _edges(polygon):
        along, across = [], []
        for corner in ends:
            dx, dy = corner[:, 0] - places[:, :1], corner[:, 1] - places[:, 1:2]
            along.append(c * dx + s * dy)
            across.append(c * dy - s * dx)
        # The part of an edge, from 0 to 1, that is within the sides: first those, then those.
        low, high = np.zeros_like(along[0]), np.ones_like(along[0])
        for (first, second), side in zip((along, across), sides, strict=True):
            step = second - first
            step = np.where(step == 0.0, 1e-12, step)
            enters, ends_at = (-0.5 * side - first) / step, (0.5 * side - first) / step
            low = np.maximum(low, np.minimum(enters, ends_at))
            high = np.minimum(high, np.maximum(enters, ends_at))
        inside &= ~(low < high).any(axis=1)
    return inside


def _edges(polygon: Polygon) -> list[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]]:
    """First and second ends of the edges of each ring."""
    return [(ring, np.roll(ring, -1, axis=0)) for ring in polygon]
