"""Point clouds put on a grid.

Points are looked at part by part, and sorted strip by strip of the map, so that beside the points
themselves, however the file has them, little memory is taken: 5 bytes a point and the map.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.io.overview import coarse_cell, where_piles_are
from wlplan.io.scans import Heightmap, PointCloud, check_size, real_numbers
from wlplan.io.sensor import NEAR, at_sensor
from wlplan.terrain.floor import fill_unseen
from wlplan.terrain.standing import lower_envelope

# A point cloud is gridded at this many times its mean spacing where that is more than a cell: two
# points a cell leave few cells empty.
_SPACINGS = 1.5
# Tiles in which points are counted, at least [m]; they grow until the mean one holds so many, and
# until there are no more than these in all and along a side.
_TILE, _MANY = 1.0, 6.0
_MOST_TILES, _MOST_ALONG = 2_000_000, 2.0**31
# Groups of points that are this many tiles apart from the others, and hold less than this part of
# the largest group, are strays: birds, reflections, somebody who walked by the scanner.
_GAP, _SMALL = 3, 0.01
# Points of a patch of so many cells a side that are this far above the next lower one belong to
# another layer [m], if those below are at least this part and so many of the patch's: a roof, a
# conveyor, a branch. Fewer are noise.
_PATCH, _LAYERS, _LOWER, _FEW = 5, 1.0, 0.05, 3
# Where nothing was seen below an upper layer, it is one if it hangs so near [m], over a drop as
# steep as this [degrees]; and the highest drop that is looked for [m].
_NEARBY, _DROP, _TALLEST = 1.0, 60.0, 12.0
# Lines of coordinates that lie this many times the mean spacing apart come from rounding, and up to
# this distance it does no harm [m]. Within this part of the spacing they are a regular grid.
_ROUNDED, _HARMLESS, _REGULAR = 3.0, 0.25, 0.1
# More lines than this lie closer together than either.
_MOST_LINES = 4_000_000


def grid_points(cloud: PointCloud) -> Heightmap:
    """Put a point cloud on a grid: the median height of each cell that has points.

    The cells are 0.1 m wide, or more where the points lie farther apart. Where points lie in two
    layers the lower one counts. Left out are points apart from the others, and those at the place
    of the sensor, at zero. Cells without points are unseen, but for single ones amid seen cells,
    and hold a smooth fill.

    Raises:
        InputError: If there are fewer than three points, they span a map of a size that no pile
            has, or their coordinates are rounded to more than a cell.
    """
    # Only their kind and shape are looked at here: there may be many.
    real_numbers("points", np.asarray(cloud.points)[:0])
    if cloud.points.ndim != 2 or cloud.points.shape[1] != 3:
        raise InputError(f"`points` has shape {cloud.points.shape}: it has to be n by 3, x, y, z.")
    kept, returns = _usable(cloud)
    if kept.sum() < 3:
        raise InputError("has fewer than three points: export the point cloud again.")
    area, strays = _together(cloud, kept)
    number = int(kept.sum())
    spacing = math.sqrt(area / number)
    cell, rounded = _cell(cloud, kept, spacing)
    low, high = _span(cloud, kept)
    extent = np.maximum(high - low, 1e-3)
    # Points on a regular grid land amid the cells, not on their borders.
    shape = tuple(int(n) for n in np.rint(extent / cell) + 1)
    check_size(shape, cell, lambda: _overview(cloud, kept, low, extent))
    height, hanging, upper = _medians(cloud, kept, low, cell, shape)
    layers = (f"{hanging} points hang over others: the lower ones count",) if hanging else ()
    seen = np.isfinite(height)
    if hanging:
        seen &= ~_of_upper_layer(height, upper, cell)
    padded = ndimage.binary_closing(np.pad(seen, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    height = fill_unseen(height, seen)
    notes = (*cloud.notes, *returns, *strays, *rounded, *layers)
    return Heightmap(height, cell, low, seen | padded, crs=cloud.crs, notes=notes)


def _kept_parts(
    cloud: PointCloud, kept: Bool[np.ndarray, " n"]
) -> Iterator[tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"]]]:
    """Numbers and coordinates [m] of the points that are kept, part by part."""
    for part in cloud.parts():
        rows = np.flatnonzero(kept[part]) + part.start
        if len(rows) == part.stop - part.start:
            yield rows, cloud.coordinates(part)
        elif len(rows):
            yield rows, cloud.coordinates(rows)


def _usable(cloud: PointCloud) -> tuple[Bool[np.ndarray, " n"], tuple[str, ...]]:
    """Points that are finite and not at the place of the sensor, and notes of those that are."""
    kept = np.ones(len(cloud.points), bool)
    rows, near = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for part in cloud.parts():
        places = cloud.coordinates(part)
        kept[part] = np.isfinite(places).all(axis=-1)
        close = np.flatnonzero((np.abs(places) < NEAR).all(axis=-1))
        rows.append(close + part.start)
        near.append(places[close])
    found = np.concatenate(rows)
    out, notes = at_sensor(np.concatenate(near), int(kept.sum()) - len(found))
    kept[found[out]] = False
    return kept, notes


def _span(
    cloud: PointCloud, kept: Bool[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Least and largest x and y of the points that are kept [m]."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for _, places in _kept_parts(cloud, kept):
        low = np.minimum(low, places[:, :2].min(axis=0))
        high = np.maximum(high, places[:, :2].max(axis=0))
    return low, high


@dataclasses.dataclass(frozen=True)
class _Tiles:
    """Squares of the plane that hold points, in the order of their keys.

    Attributes:
        side: Of a square [m].
        key: Number of each square, its place along x times 2^32 plus that along y.
        count: Points in each of them.
    """

    side: float
    key: np.ndarray
    count: np.ndarray

    def places(self) -> np.ndarray:
        """Number of each square along x and along y, shape [t, 2]."""
        both: np.ndarray = np.stack([self.key >> 32, self.key & 0xFFFFFFFF], axis=-1)
        return both

    def doubled(self) -> _Tiles:
        """The same in squares of twice the side."""
        place = self.places() >> 1
        return _merged(2.0 * self.side, [((place[:, 0] << 32) + place[:, 1], self.count)])


def _merged(side: float, tables: list[tuple[np.ndarray, np.ndarray]]) -> _Tiles:
    """One table of squares from several pairs of keys and counts."""
    key, where = np.unique(np.concatenate([keys for keys, _ in tables]), return_inverse=True)
    count = np.bincount(where.reshape(-1), weights=np.concatenate([n for _, n in tables]))
    return _Tiles(side, key, count)


def _key(
    places: Float[np.ndarray, "m k"], low: Float[np.ndarray, "2"], side: float
) -> Int[np.ndarray, " m"]:
    """Key of the square that each point lies in."""
    i, j = np.floor((places[:, :2] - low) / side).astype(np.int64).T
    key: np.ndarray = (i << 32) + j
    return key


def _together(cloud: PointCloud, kept: Bool[np.ndarray, " n"]) -> tuple[float, tuple[str, ...]]:
    """The area that points that lie together cover [m^2], and a note of the others.

    Those are taken out of `kept`.
    """
    low, high = _span(cloud, kept)
    longest = float((high - low).max())
    side = _TILE
    while longest / side >= _MOST_ALONG and side < math.inf:
        side *= 2.0
    if not side < math.inf:
        raise InputError("has coordinates that are no lengths in metres: check its units.")
    tiles = _Tiles(side, np.empty(0, np.int64), np.empty(0))
    for _, places in _kept_parts(cloud, kept):
        keys, counts = np.unique(_key(places, low, tiles.side), return_counts=True)
        tiles = _merged(tiles.side, [(tiles.key, tiles.count), (keys, counts)])
        while len(tiles.key) > _MOST_TILES:
            tiles = tiles.doubled()
    total = int(kept.sum())
    while total < _MANY * len(tiles.key) and 2.0 * tiles.side <= longest:
        tiles = tiles.doubled()
    pairs = cKDTree(tiles.places()).query_pairs(_GAP - 0.5, output_type="ndarray")
    links = sparse.coo_array(
        (np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(tiles.key),) * 2
    )
    _, group = sparse.csgraph.connected_components(links, directed=False)
    size = np.bincount(group, weights=tiles.count)
    main = (size >= _SMALL * size.max())[group]
    area = float(main.sum()) * tiles.side**2
    note: tuple[str, ...] = ()
    if not main.all():
        note = (_leave_strays(cloud, kept, low, tiles, main),)
    # Few tiles overestimate the area at their borders.
    low, high = _span(cloud, kept)
    return min(area, float(np.prod(np.maximum(high - low, 1e-3)))), note


def _leave_strays(
    cloud: PointCloud,
    kept: Bool[np.ndarray, " n"],
    low: Float[np.ndarray, "2"],
    tiles: _Tiles,
    main: Bool[np.ndarray, " t"],
) -> str:
    """Take the points in tiles that are not the main ones out of `kept`; a note of them."""
    # The middle tile along each axis, half of the points on either side.
    place, weight = tiles.places()[main], tiles.count[main]
    middle = np.empty(2)
    for axis in (0, 1):
        order = np.argsort(place[:, axis])
        half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
        middle[axis] = low[axis] + (place[order[half], axis] + 0.5) * tiles.side
    total, left, farthest = int(kept.sum()), 0, 0.0
    for rows, places in _kept_parts(cloud, kept):
        away = ~main[np.searchsorted(tiles.key, _key(places, low, tiles.side))]
        if away.any():
            kept[rows[away]] = False
            left += int(away.sum())
            farthest = max(farthest, float(np.hypot(*(places[away, :2] - middle).T).max()))
    return (
        f"left out {left} of {total} points that lie apart from the others, up "
        f"to {farthest:.0f} m from the middle"
    )


def _cell(
    cloud: PointCloud, kept: Bool[np.ndarray, " n"], spacing: float
) -> tuple[float, tuple[str, ...]]:
    """Side of a cell for points of a mean spacing [m], and a note if rounding decides it.

    Raises:
        InputError: If coordinates are rounded to much more than a cell of the models.
    """
    each = [_step(cloud, kept, axis) for axis in (0, 1)]
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


def _step(cloud: PointCloud, kept: Bool[np.ndarray, " n"], axis: int) -> float:
    """Median distance of neighbouring values of a coordinate [m]; 0 if there are very many."""
    values = np.empty(0)
    for _, places in _kept_parts(cloud, kept):
        values = np.unique(np.concatenate([values, places[:, axis]]))
        if len(values) > _MOST_LINES:
            return 0.0
    gaps = np.diff(values)
    return float(np.median(gaps)) if len(gaps) else 0.0


def _medians(
    cloud: PointCloud,
    kept: Bool[np.ndarray, " n"],
    low: Float[np.ndarray, "2"],
    cell: float,
    shape: tuple[int, ...],
) -> tuple[Float[np.ndarray, "nx ny"], int, Float[np.ndarray, "nx ny"]]:
    """The median height of the lower layer in each cell [m], NaN in empty ones.

    Returns:
        The map, how many points belong to upper layers, and the lowest of these in each cell [m],
        NaN where there is none.
    """
    height, upper = np.full(shape, np.nan), np.full(shape, np.nan)
    hanging = 0
    # A cell reaches half into the next patch: its points wait for the next strip.
    index, z = np.empty(0, np.int64), np.empty(0)
    for rows, stop in _strips(cloud, kept, low[0], _PATCH * cell):
        places = cloud.coordinates(rows)
        patches = np.floor((places[:, :2] - low) / (_PATCH * cell)).astype(np.int64)
        lower = _lower_layer(patches[:, 0] * shape[1] + patches[:, 1], places[:, 2])
        hanging += int((~lower).sum())
        over = np.rint((places[~lower, :2] - low) / cell).astype(np.int64)
        np.fmin.at(upper, (over[:, 0], over[:, 1]), places[~lower, 2])
        places = places[lower]
        cells = np.rint((places[:, :2] - low) / cell).astype(np.int64)
        index = np.concatenate([index, cells[:, 0] * shape[1] + cells[:, 1]])
        z = np.concatenate([z, places[:, 2]])
        complete = index < stop * _PATCH * shape[1]
        _put_medians(height, index[complete], z[complete])
        index, z = index[~complete], z[~complete]
    _put_medians(height, index, z)
    return height, hanging, upper


def _of_upper_layer(
    height: Float[np.ndarray, "nx ny"], upper: Float[np.ndarray, "nx ny"], cell: float
) -> Bool[np.ndarray, "nx ny"]:
    """Cells in which only an upper layer was seen: as high as it hangs nearby, and over a drop.

    Args:
        height: Of the lowest layer in each cell [m], NaN in empty ones.
        upper: Of the layers above [m], NaN where there is none.
        cell: Grid spacing [m].
    """
    size = 2 * max(1, round(_NEARBY / cell)) + 1
    hangs = np.isfinite(upper)
    low = ndimage.grey_erosion(np.where(hangs, upper, np.inf), size=(size, size))
    high = ndimage.grey_dilation(np.where(hangs, upper, -np.inf), size=(size, size))
    surface = np.where(np.isfinite(height), height, np.inf)
    rise = math.tan(math.radians(_DROP)) * cell
    below = lower_envelope(surface, rise, math.ceil(_TALLEST / rise))
    with np.errstate(invalid="ignore"):
        over = surface - below > _LAYERS
        found: np.ndarray = over & (height > low - 0.5 * _LAYERS) & (height < high + 0.5 * _LAYERS)
    return found


def _put_medians(
    height: Float[np.ndarray, "nx ny"], index: Int[np.ndarray, " n"], z: Float[np.ndarray, " n"]
) -> None:
    """Write the median of the points of each cell into a map, whose cells are numbered."""
    order = np.lexsort((z, index))
    cells, start, count = np.unique(index[order], return_index=True, return_counts=True)
    height.flat[cells] = z[order][start + (count - 1) // 2]


def _strips(
    cloud: PointCloud, kept: Bool[np.ndarray, " n"], west: float, width: float
) -> Iterator[tuple[Int[np.ndarray, " m"], int]]:
    """Numbers of the points in strips of the map across x, from west to east.

    A strip is as many columns of patches as hold the points of a part, or one.

    Args:
        cloud: All points.
        kept: Those that count.
        west: Least x [m].
        width: Width of a column [m].

    Yields:
        The points of a strip, in the order of the cloud, and the column that the next one starts
        with.
    """

    def column(places: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, " m"]:
        columns: np.ndarray = np.floor((places[:, 0] - west) / width).astype(np.int64)
        return columns

    count = np.zeros(1, np.int64)
    for _, places in _kept_parts(cloud, kept):
        more = np.bincount(column(places))
        long, short = (count, more) if len(count) >= len(more) else (more, count)
        long[: len(short)] += short
        count = long
    strip_of, most = np.zeros(len(count), np.int64), next(cloud.parts()).stop
    filled = 0
    for k in range(1, len(count)):
        filled += count[k - 1]
        full = filled + count[k] > most
        strip_of[k] = strip_of[k - 1] + full
        filled = 0 if full else filled
    sizes = np.bincount(strip_of, weights=count).astype(np.int64)
    ends = np.cumsum(sizes)
    # A counting sort: numpy's would take eight bytes a point.
    order = np.empty(int(ends[-1]), np.uint32 if len(kept) < 2**32 else np.int64)
    place = ends - sizes
    for rows, places in _kept_parts(cloud, kept):
        strip = strip_of[column(places)]
        sort = np.argsort(strip, kind="stable")
        found, start, number = np.unique(strip[sort], return_index=True, return_counts=True)
        for k, a, n in zip(found, start, number, strict=True):
            order[place[k] : place[k] + n] = rows[sort[a : a + n]]
            place[k] += n
    last_columns = np.flatnonzero(np.diff(strip_of, append=len(sizes)))
    for start, end, last in zip(ends - sizes, ends, last_columns, strict=True):
        yield order[start:end].astype(np.int64), int(last) + 1


def _lower_layer(
    patches: Int[np.ndarray, " n"], z: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which points belong to the lowest layer of their patch.

    Args:
        patches: Number of the patch of each point.
        z: Heights [m].
    """
    if not len(z):
        return np.ones(0, bool)
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
    kept = np.empty(len(z), bool)
    kept[order] = gaps == (gaps - gap)[first][number]
    return kept


def _overview(
    cloud: PointCloud,
    kept: Bool[np.ndarray, " n"],
    low: Float[np.ndarray, "2"],
    extent: Float[np.ndarray, "2"],
) -> str:
    """Where the piles are in a cloud that is too large, from the mean heights of wide cells."""
    cell = coarse_cell(extent)
    shape = tuple(int(n) for n in extent // cell + 1)
    total, count = np.zeros(math.prod(shape)), np.zeros(math.prod(shape))
    for _, places in _kept_parts(cloud, kept):
        i, j = ((places[:, :2] - low) // cell).astype(np.int64).T
        index = i * shape[1] + j
        total += np.bincount(index, places[:, 2], minlength=len(total))
        count += np.bincount(index, minlength=len(count))
    height = (total / np.maximum(count, 1.0)).reshape(shape)
    seen = (count > 0).reshape(shape)
    return where_piles_are(height, seen, cell, low + 0.5 * cell, unit=cloud.unit)
