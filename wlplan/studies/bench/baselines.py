"""The automaton as others would write it: NumPy, Numba, and a public library where there is one.

`numpy_sweeps` and `numba_sweeps` are `automaton.sweeps`, sweep by sweep, on a grid without floor or
mask. Both work in the precision of the surface that they are given.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from wlplan.terrain.automaton import FLOW_FRACTION

Surface = Float[np.ndarray, "nx ny"]
# A number in the precision of a surface.
_Real = np.floating[Any]

Sweeps = Callable[[Surface, float, int], Surface]
"""`sweeps(height, drop, count)`: the surface after some sweeps, see `automaton.sweeps`."""

# Sweeps between two looks at the slopes, as in `automaton.converged`, and when to give up.
_EVERY, _MOST = 100, 100_000
# Height of a wall that no pile reaches [cells].
_WALL = 1e3


class Rested(NamedTuple):
    """A surface that has come to rest [m], and how many sweeps it took; None: not counted."""

    height: Float[Array | np.ndarray, "nx ny"]
    sweeps: int | None


def numpy_sweeps(height: Surface, drop: float, count: int) -> Surface:
    """The sweeps of `automaton.sweeps` in NumPy.

    Args:
        height: Surface [m].
        drop: Largest stable height difference between two cells that share a side [m].
        count: Number of sweeps.
    """
    # A mirrored rim stands for the border. Seen as one row of cells, every edge to a neighbour is
    # a fixed step along it; those that wrap around join two cells of the rim and do no harm.
    rimmed = np.pad(height, 1, mode="edge")
    outflow = np.empty_like(rimmed)
    cells, flows = rimmed.ravel(), outflow.ravel()
    width = rimmed.shape[1]
    edges = []
    for step, distance in ((1, 1.0), (width, 1.0), (width - 1, 2**0.5), (width + 1, 2**0.5)):
        rise, stable = np.empty_like(cells[step:]), np.empty_like(cells[step:])
        limit = cells.dtype.type(drop * distance)
        ends = (cells[:-step], cells[step:], flows[:-step], flows[step:])
        edges.append((*ends, rise, stable, limit))
    inside, inside_flows = rimmed[1:-1, 1:-1], outflow[1:-1, 1:-1]
    for _ in range(count):
        outflow.fill(0.0)
        for here, there, from_here, from_there, rise, stable, limit in edges:
            np.subtract(here, there, out=rise)
            # np.clip into a buffer takes longer.
            np.maximum(np.minimum(rise, limit, out=stable), -limit, out=stable)
            np.subtract(rise, stable, out=rise)
            np.add(from_here, rise, out=from_here)
            np.subtract(from_there, rise, out=from_there)
        inside_flows *= FLOW_FRACTION
        inside -= inside_flows
        rimmed[0], rimmed[-1] = rimmed[1], rimmed[-2]
        rimmed[:, 0], rimmed[:, -1] = rimmed[:, 1], rimmed[:, -2]
    return inside.copy()


def numba_sweeps(height: Surface, drop: float, count: int) -> Surface:
    """The sweeps of `automaton.sweeps` in Numba; arguments as for `numpy_sweeps`.

    Raises:
        ImportError: If Numba is not installed.
    """
    kind = height.dtype.type
    rimmed = np.pad(height, 1, mode="edge")
    limits = (kind(drop), kind(drop * 2**0.5), kind(FLOW_FRACTION))
    _numba_kernel()(rimmed, rimmed.copy(), *limits, count)
    return rimmed[1:-1, 1:-1].copy()


@functools.cache
def _numba_kernel() -> Callable[..., None]:
    import numba

    # The tests wrap every function to check its shapes, which Numba cannot see through.
    sweep = numba.njit(inspect.unwrap(_sweep_cells))

    def many(
        cells: Surface, other: Surface, side: _Real, diagonal: _Real, part: _Real, count: int
    ) -> None:
        for _ in range(count // 2):
            sweep(cells, other, side, diagonal, part)
            sweep(other, cells, side, diagonal, part)
        if count % 2 == 1:
            sweep(cells, other, side, diagonal, part)
            cells[:] = other

    kernel: Callable[..., None] = numba.njit(inspect.unwrap(many))
    return kernel


def _sweep_cells(cells: Surface, after: Surface, side: _Real, diagonal: _Real, part: _Real) -> None:
    """One sweep from an array with a mirrored rim into another; side and diagonal are limits [m].

    Every edge is looked at from both ends: the compiler turns a loop that only reads its
    neighbours into vector instructions, which makes it five times as fast as one that visits each
    edge once and writes to both.
    """
    n, m = cells.shape[0] - 2, cells.shape[1] - 2
    for i in range(1, n + 1):
        for j in range(1, m + 1):
            here = cells[i, j]
            rise = here - cells[i - 1, j]
            flow = rise - min(max(rise, -side), side)
            rise = here - cells[i + 1, j]
            flow += rise - min(max(rise, -side), side)
            rise = here - cells[i, j - 1]
            flow += rise - min(max(rise, -side), side)
            rise = here - cells[i, j + 1]
            flow += rise - min(max(rise, -side), side)
            rise = here - cells[i - 1, j - 1]
            flow += rise - min(max(rise, -diagonal), diagonal)
            rise = here - cells[i - 1, j + 1]
            flow += rise - min(max(rise, -diagonal), diagonal)
            rise = here - cells[i + 1, j - 1]
            flow += rise - min(max(rise, -diagonal), diagonal)
            rise = here - cells[i + 1, j + 1]
            flow += rise - min(max(rise, -diagonal), diagonal)
            after[i, j] = here - part * flow
        after[i, 0] = after[i, 1]
        after[i, m + 1] = after[i, m]
    for j in range(m + 2):
        after[0, j] = after[1, j]
        after[n + 1, j] = after[n, j]


def rest(
    sweeps: Sweeps, height: Surface, *, cell_size: float, repose_angle: float, tolerance: float
) -> Rested:
    """Sweeps until no slope exceeds the angle of repose by more than the tolerance.

    Args:
        sweeps: The automaton.
        height: Surface [m].
        cell_size: Grid spacing [m].
        repose_angle: Angle of repose [rad].
        tolerance: How much steeper the result may be [rad].
    """
    drop = cell_size * math.tan(repose_angle)
    limit = cell_size * math.tan(repose_angle + tolerance)
    count = 0
    while count < _MOST and steepest_rise(height) > limit:
        height = sweeps(height, drop, _EVERY)
        count += _EVERY
    return Rested(height, count)


def steepest_rise(height: Surface) -> float:
    """Largest height difference between neighbours over their distance in cells [m]."""
    return max(
        float(np.abs(rise).max()) / distance
        for rise, distance in (
            (height[1:] - height[:-1], 1.0),
            (height[:, 1:] - height[:, :-1], 1.0),
            (height[1:, 1:] - height[:-1, :-1], 2**0.5),
            (height[1:, :-1] - height[:-1, 1:], 2**0.5),
        )
    )


def aeolis_rest(
    height: Surface, *, cell_size: float, repose_angle: float, tolerance: float
) -> Rested:
    """The avalanches of AeoLiS, a model of wind-blown sand, in NumPy; arguments as for `rest`.

    Another automaton, with four neighbours: it ends where AeoLiS finds the surface at rest or this
    package would, whichever is first. The former can be a little steeper across a diagonal.

    Raises:
        ImportError: If AeoLiS is not installed.
    """
    from aeolis.avalanching import avalanche

    # Its flow is fixed for cells of 1 m. The bed's outermost cells take in what reaches them and
    # lose it: a wall around the window keeps the soil away from them.
    bed = np.pad(height.astype(np.float64) / cell_size, 1, constant_values=_WALL)
    nx, ny = bed.shape
    ones = np.ones_like(bed)
    degrees = math.degrees(repose_angle)
    state: dict[str, Any] = {
        "zb": bed,
        "zne": np.zeros_like(bed),
        **{"ds": ones, "dn": ones, "SWL": -ones, "zs": bed.copy()},
        **{"theta_stat": degrees, "theta_dyn": degrees},
    }
    settings = {"process_avalanche": True, "nx": ny - 1, "ny": nx - 1, "max_iter_ava": _EVERY}
    limit = math.tan(repose_angle + tolerance)
    inside = bed[1:-1, 1:-1]
    count = 0
    while count < _MOST and steepest_rise(inside) > limit:
        earlier = inside.copy()
        avalanche(state, settings)
        count += _EVERY
        if np.array_equal(inside, earlier):
            break
    return Rested((inside * cell_size).astype(height.dtype), count)
