"""Triangles put on a grid."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.io.overview import coarse_cell, where_piles_are
from wlplan.io.scans import Box, check_size, corners, nothing_inside

# Lines across triangles and cells on them that are worked on at once.
_AT_ONCE = 1 << 20
# Times that a map may be covered by faces; more are no surface of a yard.
_MOST_COVERS = 200
# Part of a cell by which a face reaches over its edge, so that none falls between two faces.
_EDGE = 1e-6


def upper_surface(
    triangles: Float[np.ndarray, "t 3 3"], box: Box | None = None
) -> tuple[Float[np.ndarray, "nx ny"], Bool[np.ndarray, "nx ny"], float, Float[np.ndarray, "2"]]:
    """The highest face over the centre of each cell.

    Args:
        triangles: Corners of the faces, x, y and z [m].
        box: Rectangle outside of which nothing is looked at; None for all of it.

    Returns:
        Heights [m], NaN where no face is; which cells have one; the side of a cell [m]; x and y of
        the centre of cell [0, 0] [m], shape [2].

    Raises:
        InputError: If the map has a size that no pile has, very many faces lie over one another, or
            nothing lies inside the rectangle.
    """
    low, high = triangles[:, :, :2].min(axis=(0, 1)), triangles[:, :, :2].max(axis=(0, 1))
    if box is not None:
        inside = np.maximum(low, corners(box)[0]), np.minimum(high, corners(box)[1])
        if not (inside[0] < inside[1]).all():
            raise nothing_inside(low, high)
        low, high = inside
    extent = high - low

    def overview() -> str:
        coarse = coarse_cell(extent)
        height = _rasterised(triangles, low, coarse, _shape(extent, coarse))
        return where_piles_are(height, np.isfinite(height), coarse, low + 0.5 * coarse)

    with np.errstate(over="ignore"):
        shape = _shape(np.minimum(extent, 1e9), CELL_SIZE)
    check_size(shape, CELL_SIZE, overview)
    height = _rasterised(triangles, low, CELL_SIZE, shape)
    return height, np.isfinite(height), CELL_SIZE, low + 0.5 * CELL_SIZE


def _shape(extent: Float[np.ndarray, "2"], cell: float) -> tuple[int, int]:
    """Cells that an extent [m] has room for."""
    nx, ny = np.maximum(np.floor(extent / cell + _EDGE), 1.0).astype(int)
    return int(nx), int(ny)


def _rasterised(
    triangles: Float[np.ndarray, "t 3 3"],
    low: Float[np.ndarray, "2"],
    cell: float,
    shape: tuple[int, int],
) -> Float[np.ndarray, "nx ny"]:
    """Heights of the highest faces [m], -inf turned into NaN where there is none.

    A face is cut along the lines of cells that it crosses, and each cut holds the cells between the
    two edges that it meets there, whatever the shape of the face.
    """
    # In cells from the first centre; corners in the order of x.
    places = triangles.copy()
    places[:, :, :2] = (places[:, :, :2] - low) / cell - 0.5
    places = np.take_along_axis(places, np.argsort(places[:, :, :1], axis=1), axis=1)
    (x0, y0, z0), (x1, y1, z1), (x2, y2, z2) = (places[:, k].T for k in range(3))
    lowest, highest = places[:, :, 2].min(axis=1), places[:, :, 2].max(axis=1)
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    standing = np.abs(area) < 1e-12
    area = np.where(standing, 1.0, area)
    along_x = ((z1 - z0) * (y2 - y0) - (z2 - z0) * (y1 - y0)) / area
    along_y = ((x1 - x0) * (z2 - z0) - (x2 - x0) * (z1 - z0)) / area
    first = np.clip(np.ceil(x0 - _EDGE), 0, shape[0]).astype(np.int64)
    last = np.clip(np.floor(x2 + _EDGE), -1, shape[0] - 1).astype(np.int64)
    lines = np.where(standing, 0, np.maximum(last - first + 1, 0))
    height = np.full(shape, -np.inf)
    room = _MOST_COVERS * height.size
    for face, step in _spread(lines):
        i = first[face] + step
        x = i.astype(float)
        # The long edge from the first to the last corner, and the one of the others that is met.
        a = _at(x, x0[face], y0[face], x2[face], y2[face])
        left = _at(x, x0[face], y0[face], x1[face], y1[face])
        right = _at(x, x1[face], y1[face], x2[face], y2[face])
        b = np.where(x <= x1[face], left, right)
        start = np.clip(np.ceil(np.minimum(a, b) - _EDGE), 0, shape[1]).astype(np.int64)
        end = np.clip(np.floor(np.maximum(a, b) + _EDGE), -1, shape[1] - 1).astype(np.int64)
        cells = np.maximum(end - start + 1, 0)
        room -= int(cells.sum()) + len(cells)
        if room < 0:
            raise InputError(
                "has very many faces over one another, which is no surface: export that only."
            )
        for cut, step in _spread(cells):
            j, k = start[cut] + step, face[cut]
            z = z0[k] + along_x[k] * (x[cut] - x0[k]) + along_y[k] * (j - y0[k])
            # Slivers that stand nearly upright must not reach beyond their corners.
            np.maximum.at(height, (i[cut], j), np.clip(z, lowest[k], highest[k]))
    return np.where(np.isneginf(height), np.nan, height)


def _at(
    x: Float[np.ndarray, " n"],
    xa: Float[np.ndarray, " n"],
    ya: Float[np.ndarray, " n"],
    xb: Float[np.ndarray, " n"],
    yb: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Where a line from a to b is at some x, within its ends: its y."""
    width = xb - xa
    part = np.where(width > 0.0, (x - xa) / np.where(width > 0.0, width, 1.0), 0.5)
    y: np.ndarray = ya + np.clip(part, 0.0, 1.0) * (yb - ya)
    return y


def _spread(
    counts: Int[np.ndarray, " n"],
) -> Iterator[tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]]:
    """Numbers 0 to n - 1, each as often as its count, and the steps within; some at once."""
    ends = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        done = int(ends[begin] - counts[begin])
        stop = max(int(np.searchsorted(ends, done + _AT_ONCE, side="right")), begin + 1)
        part = counts[begin:stop]
        number = np.repeat(np.arange(begin, stop), part)
        step = np.arange(len(number)) - np.repeat(np.cumsum(part) - part, part)
        if len(number):
            yield number, step
        begin = stop
