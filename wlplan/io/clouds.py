"""Point clouds put on a grid."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.io.scans import Heightmap, PointCloud, check_size, real_numbers
from wlplan.terrain.floor import fill_unseen

# A point cloud is gridded at this many times its mean spacing where that is more than a cell: two
# points a cell leave few cells empty.
_SPACINGS = 1.5
# Tiles in which points are counted, at least [m]; they grow until the mean one holds so many.
_TILE, _MANY = 1.0, 6.0
# Groups of points that are this many tiles apart from the others, and hold less than this part of
# the largest group, are strays: birds, reflections, somebody who walked by the scanner.
_GAP, _SMALL = 3, 0.01
# Points of a patch of so many cells a side that are this far above the next lower one belong to
# another layer [m], if those below are at least this part and so many of the patch's: a roof, a
# conveyor, a branch. Fewer are noise.
_PATCH, _LAYERS, _LOWER, _FEW = 5, 1.0, 0.2, 3
# Lines of coordinates that lie this many times the mean spacing apart come from rounding, and up to
# this distance it does no harm [m]. Within this part of the spacing they are a regular grid.
_ROUNDED, _HARMLESS, _REGULAR = 3.0, 0.25, 0.1


def grid_points(cloud: PointCloud) -> Heightmap:
    """Put a point cloud on a grid: the median height of each cell that has points.

    The cells are 0.1 m wide, or more where the points lie farther apart. Where points lie in two
    layers the lower one counts. Points apart from the others are left out. Cells without points are
    unseen, but for single ones amid seen cells, and hold a smooth fill.

    Raises:
        InputError: If there are fewer than three points, they span a map of a size that no pile
            has, or their coordinates are rounded to more than a cell.
    """
    points = real_numbers("points", cloud.points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"`points` has shape {points.shape}: it has to be n by 3, x, y and z.")
    points = points[np.isfinite(points).all(axis=-1)]
    if len(points) < 3:
        raise InputError("has fewer than three points: export the point cloud again.")
    kept, area, strays = _together(points[:, :2])
    points = points[kept]
    spacing = math.sqrt(area / len(points))
    cell, rounded = _cell(points[:, :2], spacing)
    low = points.min(axis=0)[:2]
    extent = np.maximum(points.max(axis=0)[:2] - low, 1e-3)
    # Points on a regular grid land amid the cells, not on their borders.
    shape = tuple(int(n) for n in np.rint(extent / cell) + 1)
    check_size(shape, cell)
    index = np.ravel_multi_index(tuple(np.rint((points[:, :2] - low) / cell).astype(int).T), shape)
    patches = np.floor((points[:, :2] - low) / (_PATCH * cell)).astype(int)
    lower, layers = _lower_layer(patches[:, 0] * shape[1] + patches[:, 1], points[:, 2])
    index, z = index[lower], points[lower, 2]
    order = np.lexsort((z, index))
    cells, start, count = np.unique(index[order], return_index=True, return_counts=True)
    height = np.full(shape, np.nan)
    height.flat[cells] = z[order][start + (count - 1) // 2]
    seen = np.isfinite(height)
    padded = ndimage.binary_closing(np.pad(seen, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    height = fill_unseen(height, seen)
    notes = (*cloud.notes, *strays, *rounded, *layers)
    return Heightmap(height, cell, low, seen | padded, crs=cloud.crs, notes=notes)


def _together(
    places: Float[np.ndarray, "n 2"],
) -> tuple[Bool[np.ndarray, " n"], float, tuple[str, ...]]:
    """Points that lie together, the area that they cover [m^2], and a note of the others."""
    low = places.min(axis=0)
    longest = float((places.max(axis=0) - low).max())
    tile = _TILE
    while True:
        tiles, of_point, count = np.unique(
            np.floor((places - low) / tile), axis=0, return_inverse=True, return_counts=True
        )
        if len(places) >= _MANY * len(tiles) or 2.0 * tile > longest:
            break
        tile *= 2.0
    pairs = cKDTree(tiles).query_pairs(_GAP - 0.5, output_type="ndarray")
    links = sparse.coo_array(
        (np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(tiles), len(tiles))
    )
    _, group = sparse.csgraph.connected_components(links, directed=False)
    size = np.bincount(group, weights=count)
    main = size >= _SMALL * size.max()
    kept = main[group][of_point.reshape(-1)]
    area = float(main[group].sum()) * tile**2
    # Few tiles overestimate the area at their borders.
    span = places[kept].max(axis=0) - places[kept].min(axis=0)
    area = min(area, float(np.prod(np.maximum(span, 1e-3))))
    if kept.all():
        return kept, area, ()
    centre = np.median(places[kept], axis=0)
    farthest = float(np.hypot(*(places[~kept] - centre).T).max())
    note = (
        f"left out {int((~kept).sum())} of {len(kept)} points that lie apart from the others, up "
        f"to {farthest:.0f} m from the middle"
    )
    return kept, area, (note,)


def _cell(places: Float[np.ndarray, "n 2"], spacing: float) -> tuple[float, tuple[str, ...]]:
    """Side of a cell for points of a mean spacing [m], and a note if rounding decides it.

    Raises:
        InputError: If coordinates are rounded to much more than a cell of the models.
    """
    steps = [np.diff(np.unique(values)) for values in places.T]
    each = [float(np.median(gaps)) if len(gaps) else 0.0 for gaps in steps]
    step = max(each)
    if all(abs(one - spacing) < _REGULAR * spacing for one in each):
        return max(CELL_SIZE, step), ()
    cell = max(CELL_SIZE, _SPACINGS * spacing)
    if step <= max(_ROUNDED * spacing, CELL_SIZE):
        return cell, ()
    if step > _HARMLESS:
        raise InputError(
            f"has coordinates that are rounded to {step:.3g} m: export it in double precision, or "
            f"with an offset taken off."
        )
    return max(cell, step), (f"coordinates are rounded to {step:.3g} m: the cells are as wide",)


def _lower_layer(
    patches: Int[np.ndarray, " n"], z: Float[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], tuple[str, ...]]:
    """Which points belong to the lowest layer of their patch, and a note of the others.

    Args:
        patches: Number of the patch of each point.
        z: Heights [m].
    """
    order = np.lexsort((z, patches))
    patch, height = patches[order], z[order]
    same = np.insert(np.diff(patch) == 0, 0, False)
    number = np.cumsum(~same) - 1
    first = np.flatnonzero(~same)
    sizes = np.diff(np.append(first, len(z)))
    # Points below each one in its patch.
    below = np.arange(len(z)) - first[number]
    gap = same & (np.diff(height, prepend=height[0]) > _LAYERS)
    gap &= (below >= _FEW) & (below >= _LOWER * sizes[number])
    # The lowest gap ends the layer.
    gaps = np.cumsum(gap)
    lower: np.ndarray = gaps == (gaps - gap)[first][number]
    kept = np.empty(len(z), bool)
    kept[order] = lower
    if lower.all():
        return kept, ()
    return kept, (f"{int((~lower).sum())} points hang over others: the lower ones count",)
