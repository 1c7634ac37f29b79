"""The floor under a scanned pile, and the cells that the scan did not see.

Both end in the same smooth interpolation: the harmonic surface through the cells that are known,
free at the edge of the map. It never leaves the range of the values that it joins.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy import ndimage, sparse
from scipy.sparse import linalg

from wlplan.errors import InputError

# Ground is what a loader can reach from the edge of the map over slopes below this, relative to
# the lie of the land [rad]: half way between the 20 degrees of the flattest piles of the paper
# and the slopes of a yard.
_GENTLE = math.radians(12.0)
# The part of the relief below which reachable cells count as ground, so that a ramp up the pile
# does not make its top ground, and the least that this comes to [m].
_LOW_PART = 0.3
_LOW_LEAST = 0.35
# Steepest lie of the land [rad]; a steeper fit has caught the pile, unless at least this part of
# the edge lies this close to it [m]: then it is a sloping yard, up to the steepest of those.
_STEEPEST_LAND, _STEEPEST_YARD = math.radians(8.0), math.radians(15.0)
_PLANE_PART, _PLANE_NEAR = 0.7, 0.15
# Width of the Gaussian under which slopes are taken [m], wide enough for centimetres of noise.
_SMOOTHING = 0.25
# Width added round the footprint, so that its edge lies on ground that no pile touches [m].
_SKIRT = 0.4
# Narrowest part of a footprint [m]; kerbs and stones are narrower and stay part of the ground.
_NARROWEST = 1.0
# Unknown cells up to which the harmonic surface is solved directly; above, on a coarser grid.
_DIRECT = 40_000


def fill_unseen(height: ArrayLike, valid: ArrayLike) -> Float[np.ndarray, "nx ny"]:
    """Fill the cells that a scan did not see smoothly from the seen ones around them.

    Args:
        height: Surface [m]; where `valid` is False it may be anything, NaN too.
        valid: Cells that the scan saw.

    Returns:
        The surface [m], float64, unchanged where it was seen.

    Raises:
        InputError: If no cell was seen.
    """
    valid = np.asarray(valid)
    if not valid.any():
        raise InputError("The scan saw no cell of the map: every cell is marked as not valid.")
    return _harmonic(np.asarray(height, np.float64), ~valid)


def estimate_ground(
    height: ArrayLike,
    cell_size: float,
    valid: ArrayLike | None = None,
    standing: Bool[np.ndarray, "nx ny"] | None = None,
) -> Float[np.ndarray, "nx ny"]:
    """Estimate the floor under a scanned pile from the ground around its toe.

    The ground is what can be reached from the edge of the map without climbing: over gentle slopes
    and not far above the lie of the land, a plane fitted to the low part of the edge. What cannot
    be reached and is wide enough is pile. Under it the ground is that plane plus the harmonic
    surface through what the ground around it deviates from the plane, so a pile on a plane is
    recovered exactly. Elsewhere the ground is the surface itself.

    Args:
        height: Surface [m].
        cell_size: Grid spacing [m].
        valid: Cells that the scan saw; the others are filled first and start no ground.
        standing: Cells of what is neither ground nor pile; filled likewise, but no edge of the map.

    Returns:
        The ground [m], float64, nowhere above the (filled) surface. Where no ground is in sight,
        because the pile runs over every edge of the map, it is level at the lowest cell.
    """
    seen = np.ones(np.shape(height), bool) if valid is None else np.asarray(valid)
    edge = seen & ~ndimage.binary_erosion(seen)
    if standing is not None and (seen & ~standing).any():
        seen, edge = seen & ~standing, edge & ~standing
        edge = edge if edge.any() else seen & ~ndimage.binary_erosion(seen)
    surface = fill_unseen(height, seen)
    footprint, land = _footprint(surface, cell_size, seen, edge)
    if standing is not None:
        footprint = footprint | standing
    if footprint.all():
        return np.full_like(surface, surface.min())
    floor = np.minimum(surface, land + _harmonic(surface - land, footprint))
    return np.where(footprint, floor, surface)


def _footprint(
    surface: Float[np.ndarray, "nx ny"],
    cell_size: float,
    seen: Bool[np.ndarray, "nx ny"],
    edge: Bool[np.ndarray, "nx ny"],
) -> tuple[Bool[np.ndarray, "nx ny"], Float[np.ndarray, "nx ny"]]:
    """Cells under the pile with a skirt of ground around it, and the lie of the land [m].

    The edge is where the seen part of the map ends.
    """
    land = _lie_of_the_land(surface, edge, cell_size)
    rise = surface - land
    smooth = ndimage.gaussian_filter(rise, _SMOOTHING / cell_size, mode="nearest")
    slope = np.hypot(*np.gradient(smooth, cell_size))
    low = max(_LOW_LEAST, _LOW_PART * float(np.max(rise)))
    gentle = (slope < math.tan(_GENTLE)) & (smooth < low)
    reached = ndimage.binary_propagation(edge & gentle, mask=gentle)
    if not reached.any():
        return np.ones_like(seen), land
    pile = ~reached
    # Distances do the work of an opening and a closing with round windows, at any cell size.
    core = _distance(pile, cell_size) > 0.5 * _NARROWEST
    pile &= _distance(~core, cell_size) <= 0.5 * _NARROWEST + cell_size
    return _distance(~pile, cell_size) <= _SKIRT, land


def _distance(inside: Bool[np.ndarray, "nx ny"], cell_size: float) -> Float[np.ndarray, "nx ny"]:
    """Distance to the nearest cell that is not inside [m]; the map has no edge to be near."""
    if inside.all():
        return np.full(inside.shape, np.inf)
    distance: np.ndarray = ndimage.distance_transform_edt(inside) * cell_size
    return distance


def _lie_of_the_land(
    surface: Float[np.ndarray, "nx ny"], edge: Bool[np.ndarray, "nx ny"], cell_size: float
) -> Float[np.ndarray, "nx ny"]:
    """Plane through the low part of the edge of the map [m].

    A quantile regression: absolute deviations with three times the weight below the plane as above,
    which a pile over up to half of the edge does not lift.
    """
    i, j = np.nonzero(edge)
    scale = 2.0 / max(surface.shape)
    basis = np.stack([np.ones(i.size), i * scale - 1.0, j * scale - 1.0], axis=-1)
    value = surface[edge]
    weight = np.ones(i.size)
    for step in range(60):
        root = np.sqrt(weight)
        plane = np.linalg.lstsq(basis * root[:, np.newaxis], value * root, rcond=None)[0]
        residual = value - basis @ plane
        weight = np.where(residual > 0.0, 0.25, 0.75) / np.maximum(np.abs(residual), 2.0**-step)
    slope = math.atan(math.hypot(plane[1], plane[2]) * scale / cell_size)
    on_plane = np.mean(np.abs(value - basis @ plane) < _PLANE_NEAR) >= _PLANE_PART
    if slope > (_STEEPEST_YARD if on_plane else _STEEPEST_LAND):
        plane = np.array([np.quantile(value, 0.1), 0.0, 0.0])
    grid_i, grid_j = np.indices(surface.shape)
    land: np.ndarray = (
        plane[0] + plane[1] * (grid_i * scale - 1.0) + plane[2] * (grid_j * scale - 1.0)
    )
    return land


def _harmonic(
    values: Float[np.ndarray, "nx ny"], unknown: Bool[np.ndarray, "nx ny"]
) -> Float[np.ndarray, "nx ny"]:
    """Replace the unknown cells by the mean of their neighbours, solved for all at once.

    At the edge of the map a cell has fewer neighbours: the surface is free there. A large hole is
    solved on a grid of half the resolution and smoothed, so the cost stays linear in its size.
    """
    result = np.where(unknown, 0.0, values)
    count = int(unknown.sum())
    if count == 0:
        return result
    if count <= _DIRECT:
        result[unknown] = _solve_laplace(result, unknown)
        return result
    result[unknown] = _double(_harmonic(*_halve(result, unknown)), values.shape)[unknown]
    for _ in range(30):
        result[unknown] = _mean_of_neighbours(result)[unknown]
    return result


def _solve_laplace(
    values: Float[np.ndarray, "nx ny"], unknown: Bool[np.ndarray, "nx ny"]
) -> Float[np.ndarray, " n"]:
    count = int(unknown.sum())
    index = np.full(values.shape, -1)
    index[unknown] = np.arange(count)
    degree, known = np.zeros(count), np.zeros(count)
    rows, columns = [], []
    for here, there in _neighbours():
        a, b = index[here], index[there]
        inside = a >= 0
        np.add.at(degree, a[inside], 1.0)
        np.add.at(known, a[inside], np.where(b[inside] < 0, values[there][inside], 0.0))
        both = inside & (b >= 0)
        rows.append(a[both])
        columns.append(b[both])
    row, column = np.concatenate(rows), np.concatenate(columns)
    links = sparse.coo_array((-np.ones(row.size), (row, column)), shape=(count, count))
    solution: np.ndarray = linalg.spsolve((links + sparse.diags_array(degree)).tocsc(), known)
    return solution


def _neighbours() -> list[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Pairs of slices that put each cell beside its neighbour on each of the four sides."""
    low, high, every = slice(None, -1), slice(1, None), slice(None)
    pairs = [((low, every), (high, every)), ((every, low), (every, high))]
    return pairs + [(b, a) for a, b in pairs]


def _mean_of_neighbours(values: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "nx ny"]:
    total, count = np.zeros_like(values), np.zeros_like(values)
    for here, there in _neighbours():
        total[here] += values[there]
        count[here] += 1.0
    mean: np.ndarray = total / count
    return mean


def _halve(
    values: Float[np.ndarray, "nx ny"], unknown: Bool[np.ndarray, "nx ny"]
) -> tuple[Float[np.ndarray, "mx my"], Bool[np.ndarray, "mx my"]]:
    """Mean over the known ones of every 2 x 2 cells; unknown where there is none."""
    odd = [(0, n % 2) for n in values.shape]
    shape = [(n + n % 2) // 2 for n in values.shape]

    def total(cells: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "mx my"]:
        sums: np.ndarray = np.pad(cells, odd).reshape(shape[0], 2, shape[1], 2).sum(axis=(1, 3))
        return sums

    known = total((~unknown).astype(float))
    return total(np.where(unknown, 0.0, values)) / np.maximum(known, 1.0), known == 0


def _double(
    coarse: Float[np.ndarray, "mx my"], shape: tuple[int, ...]
) -> Float[np.ndarray, "nx ny"]:
    """Bilinear interpolation from the grid of `_halve` back to the fine one."""
    i, j = (
        np.clip(0.5 * np.arange(n) - 0.25, 0.0, m - 1)
        for n, m in zip(shape, coarse.shape, strict=True)
    )
    fine: np.ndarray = ndimage.map_coordinates(coarse, np.meshgrid(i, j, indexing="ij"), order=1)
    return fine
