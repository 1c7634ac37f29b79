"""What stands on a site: ground too high over the floor around it to be driven over."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float

CLEARED = 0.25
"""What stands higher over the floor than this cannot be driven over [m]. Estimate: the belly of a
loader of the class clears 0.4 m, its tyres climb less when laden."""

# A floor steeper than this is none: what rises faster stands on it [degrees].
_STEEPEST_FLOOR = 15.0
# How far the floor is looked for under what stands [m], half the width of a large building, and on
# cells of what size [m].
_SEARCHED, _COARSE = 12.0, 0.3

_NEIGHBOURS = [
    ((i, j), math.hypot(i, j)) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)
]


def standing(ground: Float[Any, "nx ny"], cell_size: float) -> Any:
    """Cells whose ground stands higher over the floor around it than can be driven over.

    The floor is the highest surface below the ground that slopes no more than floors do.

    Args:
        ground: What cannot be moved [m], as an array of numpy's or, also under a trace, of JAX's.
        cell_size: Grid spacing [m].

    Returns:
        Flags [nx, ny].
    """
    if isinstance(ground, np.ndarray):
        ground = ground.astype(np.float64)
        if np.ptp(ground) <= CLEARED:
            return np.zeros(ground.shape, bool)
    times = max(1, round(_COARSE / cell_size))
    step = times * cell_size
    slope = math.tan(math.radians(_STEEPEST_FLOOR))
    low = lower_envelope(-pooled(-ground, times), slope * step, math.ceil(_SEARCHED / step))
    floor = low.repeat(times, axis=0).repeat(times, axis=1)
    floor = floor[: ground.shape[0], : ground.shape[1]]
    stands: Any = ground - floor > CLEARED + slope * step
    return stands


def lower_envelope(height: Float[Any, "nx ny"], rise: float, reach: int) -> Any:
    """The highest surface below another one that nowhere rises faster, over eight neighbours.

    Args:
        height: Surface [m], likewise.
        rise: Most that it rises from a cell to the next one along an axis [m].
        reach: Cells that a low place is looked for away from a high one, at most.
    """

    def lowered(low: Any) -> Any:
        xp = low.__array_namespace__()
        padded = xp.pad(low, 1, mode="edge")
        lowest = low
        for (i, j), apart in _NEIGHBOURS:
            shifted = padded[1 + i : 1 + i + low.shape[0], 1 + j : 1 + j + low.shape[1]]
            lowest = xp.minimum(lowest, shifted + rise * apart)
        return lowest

    if not isinstance(height, np.ndarray):
        # Who only looks at a scan needs no JAX.
        from jax import lax

        return lax.fori_loop(0, reach, lambda _, low: lowered(low), height)
    low = height
    for _ in range(reach):
        lowest = lowered(low)
        if np.array_equal(lowest, low):
            break
        low = lowest
    return low


def pooled(values: Any, times: int) -> Any:
    """Largest value of so many cells a side; the last ones may be cut short; likewise."""
    xp = values.__array_namespace__()
    nx, ny = values.shape
    grown = xp.pad(values, ((0, -nx % times), (0, -ny % times)), mode="edge")
    nx, ny = (n // times for n in grown.shape)
    return grown.reshape(nx, times, ny, times).max(axis=(1, 3))
