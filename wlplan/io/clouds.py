"""Point clouds put on a grid."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.io.scans import Heightmap, PointCloud, check_size, real_numbers
from wlplan.terrain.floor import fill_unseen

# A point cloud is gridded at this many times its mean spacing where that is more than a cell: two
# points a cell leave few cells empty.
_SPACINGS = 1.5


def grid_points(cloud: PointCloud) -> Heightmap:
    """Put a point cloud on a grid: the median height of each cell that has points.

    The cells are 0.1 m wide, or more where the points lie farther apart. Cells without points are
    unseen, but for single ones amid seen cells, and hold a smooth fill.

    Raises:
        InputError: If there are fewer than three points, or they span a map of a size that no pile
            has.
    """
    points = real_numbers("points", cloud.points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"`points` has shape {points.shape}: it has to be n by 3, x, y and z.")
    points = points[np.isfinite(points).all(axis=-1)]
    if len(points) < 3:
        raise InputError("has fewer than three points: export the point cloud again.")
    low = points.min(axis=0)[:2]
    extent = np.maximum(points.max(axis=0)[:2] - low, 1e-3)
    cell = max(CELL_SIZE, _SPACINGS * math.sqrt(float(np.prod(extent)) / len(points)))
    # Points on a regular grid land amid the cells, not on their borders.
    shape = tuple(int(n) for n in np.rint(extent / cell) + 1)
    check_size(shape, cell)
    index = np.ravel_multi_index(tuple(np.rint((points[:, :2] - low) / cell).astype(int).T), shape)
    order = np.lexsort((points[:, 2], index))
    cells, start, count = np.unique(index[order], return_index=True, return_counts=True)
    height = np.full(shape, np.nan)
    height.flat[cells] = points[order, 2][start + (count - 1) // 2]
    seen = np.isfinite(height)
    padded = ndimage.binary_closing(np.pad(seen, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    height = fill_unseen(height, seen)
    return Heightmap(height, cell, low, seen | padded)
