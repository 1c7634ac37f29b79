"""How steep a pile stands, over more than the noise of its cells, and whether its soil can."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from wlplan.site.soil import Soil

# Distance over which slopes are taken [m]: longer than the noise of a cell.
_SLOPE_OVER = 1.0
# Rise over the ground that counts as pile [m], as for the toe.
_RISE = 0.15
# The steepest of a pile is what all but this part of it is less steep than.
_LEFT_OUT = 0.01
# A pile is steep where more than this part of it is.
_STEEP_PART = 0.2
# Piles rest by so much steeper or less steep than their soil is said to [degrees].
_SPREAD = 4.0


def slopes_of_soil(
    height: Float[np.ndarray, "nx ny"],
    ground: Float[np.ndarray, "nx ny"],
    stands: Bool[np.ndarray, "nx ny"],
    cell: float,
) -> Float[np.ndarray, " n"]:
    """Slopes of the cells with soil, over a metre, away from what stands [degrees].

    Args:
        height: Surface [m].
        ground: Below the soil [m].
        stands: What is no soil.
        cell: Grid spacing [m].
    """
    from scipy import ndimage

    half = max(1, round(0.5 * _SLOPE_OVER / cell))
    free = (height - ground > _RISE) & ~ndimage.binary_dilation(stands, iterations=half)
    padded = np.pad(np.asarray(height, np.float64), half, mode="edge")
    nx, ny = height.shape
    x = padded[2 * half :, half : half + ny] - padded[:nx, half : half + ny]
    y = padded[half : half + nx, 2 * half :] - padded[half : half + nx, :ny]
    slopes: np.ndarray = np.degrees(np.arctan(np.hypot(x, y)[free] / (2.0 * half * cell)))
    return slopes


def steepest_of(slopes: Float[np.ndarray, " n"]) -> float:
    """The steepest slope of a pile, but for a hundredth of it [degrees]."""
    return float(np.quantile(slopes, 1.0 - _LEFT_OUT)) if slopes.size else 0.0


def remarks_on_steepness(slopes: Float[np.ndarray, " n"], soil: Soil) -> list[str]:
    """What to know, and what to choose, where a pile stands steeper than its soil rests.

    Args:
        slopes: Of the pile [degrees].
        soil: What it is taken for.
    """
    repose = math.degrees(soil.repose_angle)
    # Noise and edges make a few steep places on any pile.
    steep = float(np.quantile(slopes, 1.0 - _STEEP_PART)) if slopes.size else 0.0
    if steep <= repose + _SPREAD:
        return []
    return [
        f"a fifth of the pile is steeper than {steep:.0f} degrees, the soil rests at {repose:.0f}: "
        f"it slides all over when it is dug first; --soil NAME@{math.ceil(steep)} takes its slopes "
        f"for those that it rests at"
    ]
