"""Heightmaps of spheres: the volume that stands in each column, and the envelope from above.

The grid is that of `terrain.heightmap.local_axes(CELLS, DISPLACEMENT)`: wide enough for all of the
engine's domain, so that no soil flows across its edge. With more rows it begins further behind the
dig location, and so does the domain: that is how soil in the approach lane is played.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from wlplan.constants import CELL_SIZE

CELLS, DISPLACEMENT = 84, 2.0
"""Cells a side, and how far the map begins before the dig location [m]."""

# Standard deviation to which the maps are smoothed [m]: as little as hides single spheres. Sharing
# a sphere's volume among four cells spreads it by a cell over the root of six.
_COLUMN_SPREAD = 0.13
_SHARED = CELL_SIZE / np.sqrt(6.0)
_ENVELOPE_SPREAD = 0.10


def further(rows: int) -> float:
    """How much further behind a map of so many rows begins than one of `CELLS` [m]."""
    return (rows - CELLS) * CELL_SIZE


def axes(rows: int = CELLS) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the rows ahead of, and of the columns left of, the dig location [m]."""
    across = (np.arange(CELLS) - (CELLS - 1) / 2) * CELL_SIZE
    return np.arange(rows) * CELL_SIZE - (DISPLACEMENT + further(rows)), across


def cells_of(x: np.ndarray, y: np.ndarray, rows: int = CELLS) -> np.ndarray:
    """Positions [m] in units of cells of a map of so many rows, shape [2, n]."""
    cells: np.ndarray = np.stack([x + DISPLACEMENT + further(rows), y]) / CELL_SIZE + np.array(
        [[0.0], [(CELLS - 1) / 2]]
    )
    return cells


def column_height(
    centre: np.ndarray, radius: np.ndarray, packing: float, rows: int = CELLS
) -> np.ndarray:
    """Bulk volume in each column over its area [m]: it sums up to the bulk volume exactly.

    Args:
        centre: Centres of the spheres [m], shape [n, 3].
        radius: Their radii [m], shape [n].
        packing: Part of the bulk volume that is solid.
        rows: Of the map.
    """
    volume = 4.0 / 3.0 * np.pi * radius**3 / packing
    # What lies beyond the grid counts in its outermost cells.
    last = np.array([[rows - 1], [CELLS - 1]])
    u = np.clip(cells_of(centre[:, 0], centre[:, 1], rows), 0.0, last)
    low = np.minimum(u.astype(int), last - 1)
    part = u - low
    height = np.zeros((rows, CELLS))
    for i in (0, 1):
        for j in (0, 1):
            share = np.abs(1 - i - part[0]) * np.abs(1 - j - part[1])
            np.add.at(height, (low[0] + i, low[1] + j), share * volume)
    spread = np.sqrt(_COLUMN_SPREAD**2 - _SHARED**2) / CELL_SIZE
    # Reflecting at the edges keeps the sum.
    smooth: np.ndarray = gaussian_filter(height / CELL_SIZE**2, spread, mode="reflect")
    return smooth


def envelope(centre: np.ndarray, radius: np.ndarray, rows: int = CELLS) -> np.ndarray:
    """Upper surface of the spheres over the floor, smoothed: what a scanner sees [m].

    Args:
        centre: Centres of the spheres [m], shape [n, 3].
        radius: Their radii [m], shape [n].
        rows: Of the map.
    """
    fine = 2  # parts of a cell
    size = CELL_SIZE / fine
    count = np.array([[rows], [CELLS]]) * fine
    # Fine cell [0, 0] is centred half a fine cell before the middle of cell [0, 0].
    u = cells_of(centre[:, 0], centre[:, 1], rows) * fine + (fine - 1) / 2
    nearest = np.round(u).astype(int)
    reach = int(np.ceil(radius.max(initial=0.0) / size))
    top = np.zeros(count.ravel())
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            cell = nearest + np.array([[i], [j]])
            rest = radius**2 - size**2 * ((cell - u) ** 2).sum(axis=0)
            hit = (rest > 0.0) & (cell >= 0).all(axis=0) & (cell < count).all(axis=0)
            np.maximum.at(top, tuple(cell[:, hit]), centre[hit, 2] + np.sqrt(rest[hit]))
    smooth = gaussian_filter(top, _ENVELOPE_SPREAD / size, mode="nearest")
    mean: np.ndarray = smooth.reshape(rows, fine, CELLS, fine).mean(axis=(1, 3))
    return mean


def centre_line(height: np.ndarray) -> np.ndarray:
    """Mean height of the four columns nearest to the centre line [m], shape [cells]."""
    middle = CELLS // 2
    line: np.ndarray = height[:, middle - 2 : middle + 2].mean(axis=1)
    return line
