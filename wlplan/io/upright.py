"""Which axis of a file is up, found from the shape of a yard, and turned to be z."""

from __future__ import annotations

import dataclasses

import numpy as np

from wlplan.errors import InputError
from wlplan.io.scans import PointCloud

TURNS: dict[str, tuple[tuple[int, int, int], tuple[int, int, int]]] = {
    "x": ((2, 1, 0), (-1, 1, 1)),
    "y": ((0, 2, 1), (1, -1, 1)),
    "z": ((0, 1, 2), (1, 1, 1)),
    "-x": ((2, 1, 0), (1, 1, -1)),
    "-y": ((0, 2, 1), (1, 1, -1)),
    "-z": ((0, 1, 2), (1, -1, -1)),
}
"""Axis of the file that is up -> which axes become x, y and z, and their signs: rotations all."""

# Points that are looked at, cells along a side in which they are, and fewest points in one that
# counts.
_SOME, _CELLS, _FEW = 100_000, 24, 5
# An axis is up if along it the points of a cell lie this much closer together than along z, and
# this close in parts of the extent of the scan across it.
_THINNER, _THIN = 4.0, 0.15
# The middle height is at least so much nearer to one end of the heights than to the other: there is
# the floor.
_LOPSIDED = 0.2


def up_axis(points: np.ndarray) -> str:
    """The axis that is up, by the shape of a scan: z unless another one fits far better.

    A yard with a pile is a sheet: over each spot of the plane it lies at one height. Seen along
    another axis it is as deep as it is wide.

    Args:
        points: x, y and z, shape [n, 3], in any unit.

    Returns:
        A key of `TURNS`, the floor being below; or "?y", "?x" if the axis is clear but not which
        end of it is up.
    """
    points = np.asarray(points, np.float64)[:: len(points) // _SOME + 1]
    points = points[np.isfinite(points).all(axis=-1)]
    if len(points) < _CELLS * _CELLS:
        return "z"
    low, high = np.quantile(points, (0.005, 0.995), axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=-1)
    points, extent = points[inside], high - low
    if not (extent > 0.0).all():
        # A floor and nothing else.
        axis = int(np.argmin(extent))
        return "z" if axis == 2 or extent[2] == 0.0 else f"?{'xyz'[axis]}"
    thickness = [_thickness((points - low) / extent, axis) * extent[axis] for axis in range(3)]
    axis = int(np.argmin(thickness))
    across = min(extent[k] for k in range(3) if k != axis)
    if thickness[2] < _THINNER * thickness[axis] or thickness[axis] > _THIN * across:
        return "z"
    return _end(points[:, axis], "xyz"[axis])


def _thickness(places: np.ndarray, axis: int) -> float:
    """Deviation along an axis of the points of a cell across it, in the cell of the median point.

    Args:
        places: Points in the unit cube, shape [n, 3].
        axis: Number of the axis.
    """
    i, j = (
        np.minimum(places[:, k] * _CELLS, _CELLS - 1).astype(int) for k in range(3) if k != axis
    )
    cell, value = i * _CELLS + j, places[:, axis]
    count = np.bincount(cell)
    mean = np.bincount(cell, value) / np.maximum(count, 1)
    square = np.bincount(cell, (value - mean[cell]) ** 2) / np.maximum(count, 1)
    return (
        float(np.sqrt(np.median(square[cell][count[cell] >= _FEW]))) if count.max() >= _FEW else 1.0
    )


def _end(heights: np.ndarray, name: str) -> str:
    """Which end of an axis is up: most of a yard is floor."""
    low, middle, high = np.quantile(heights, (0.02, 0.5, 0.98))
    if abs((high - middle) - (middle - low)) < _LOPSIDED * (high - low):
        return f"?{name}"
    return name if middle - low < high - middle else f"-{name}"


def check_upright(axis: str) -> None:
    """Refuse a scan whose axis that is up is another one than z, by what `up_axis` says.

    Raises:
        InputError: If so.
    """
    if axis == "z":
        return
    name = axis.removeprefix("?")
    choice = f"--up {name}" if not axis.startswith("?") else f"--up {name} or --up -{name}"
    raise InputError(
        f"has {name} up, as its shape says, not z: say so with {choice}, or with --up z if it is "
        f"right as it is."
    )


def upright(cloud: PointCloud, up: str | None) -> PointCloud:
    """A point cloud with z up.

    Args:
        cloud: Points in the frame of the file.
        up: Its axis that is up, a key of `TURNS`; None for z, if the shape does not say otherwise.

    Raises:
        InputError: If it does.
    """
    if np.ndim(cloud.points) != 2 or np.shape(cloud.points)[1] != 3:
        return cloud  # whoever grids it says so
    if up is None:
        # A reference system says which axis is up.
        if cloud.crs is None:
            some = slice(None, None, len(cloud.points) // _SOME + 1)
            check_upright(up_axis(cloud.coordinates(some)))
        return cloud
    order, signs = TURNS[up]
    scale = np.ones(3) if cloud.scale is None else np.asarray(cloud.scale)
    offset = np.zeros(3) if cloud.offset is None else np.asarray(cloud.offset)
    return dataclasses.replace(
        cloud,
        points=np.asarray(cloud.points)[:, order],
        scale=scale[list(order)] * signs,
        offset=offset[list(order)] * signs,
        notes=(*cloud.notes, *turning(up)),
    )


def turned(points: np.ndarray, up: str) -> np.ndarray:
    """Points, shape [n, 3], turned so that an axis of theirs, a key of `TURNS`, is z."""
    order, signs = TURNS[up]
    places: np.ndarray = points[:, order] * np.array(signs)
    return places


def turning(up: str) -> tuple[str, ...]:
    """A note of what `turned` did."""
    if up == "z":
        return ()
    order, signs = TURNS[up]
    old = ["-"[: sign < 0] + "xyz"[k] for k, sign in zip(order, signs, strict=True)]
    return (
        f"{up} is up in the file: x, y and z of the pile are {old[0]}, {old[1]} and {old[2]} of it",
    )
