"""A map of heights by numpy alone, and the same map on a grid of another spacing."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from wlplan.errors import InputError


@dataclasses.dataclass(frozen=True)
class Grid:
    """As `wlplan.Pile`, whose fields these are, in numpy."""

    height: Float[np.ndarray, "nx ny"]
    cell_size: float
    origin: Float[np.ndarray, "2"]
    ground: Float[np.ndarray, "nx ny"] | None = None
    valid: Bool[np.ndarray, "nx ny"] | None = None


def regrid(grid: Grid, cell_size: float) -> Grid:
    """Put a map on a grid of another spacing that covers the same area.

    The surface between the cells is bilinear. A finer grid takes its value at the new cell centres,
    a coarser one its mean over each new cell, which keeps the volume. Affine surfaces come out
    exactly. A new cell is valid if every cell that contributes to it is.

    Args:
        grid: With at least 2 x 2 cells, no NaN.
        cell_size: New grid spacing [m].

    Raises:
        InputError: If the spacing is not positive or leaves fewer than 2 x 2 cells.
    """
    if not 0.0 < cell_size < math.inf:
        raise InputError(f"The cell size is {cell_size:g} m: it has to be positive.")
    dtype = grid.height.dtype
    ratio = cell_size / grid.cell_size
    if math.isclose(ratio, 1.0, rel_tol=1e-6):
        return grid
    old = np.asarray(grid.height).shape
    # The small allowance keeps 95 cells of 0.2 m at 190, not 189, of 0.1 m.
    new = tuple(math.floor(n / ratio + 1e-6) for n in old)
    if min(*old, *new) < 2:
        raise InputError(
            f"A grid of {old[0]} x {old[1]} cells of {grid.cell_size:g} m cannot be resampled to "
            f"{cell_size:g} m: both grids need at least 2 x 2 cells."
        )
    # New cell centres in units of old cells, from the first old cell; what does not fit a whole
    # new cell is left off on both sides alike.
    centres = [
        (np.arange(m) - 0.5 * (m - 1)) * ratio + 0.5 * (n - 1)
        for n, m in zip(old, new, strict=True)
    ]

    def mapped(values: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "mx my"]:
        rows = _regrid_rows(np.asarray(values, dtype=np.float64), centres[0], ratio)
        return _regrid_rows(rows.T, centres[1], ratio).T

    height = mapped(grid.height)
    ground = valid = None
    if grid.ground is not None:
        # Continuing a line past the outermost centres could lift the ground through the surface.
        ground = np.minimum(mapped(grid.ground), height).astype(dtype)
    if grid.valid is not None:
        unseen = ~np.asarray(grid.valid)
        unseen = _any_in_rows(_any_in_rows(unseen, centres[0], ratio).T, centres[1], ratio).T
        valid = ~unseen
    first = np.array([centres[0][0], centres[1][0]]) * grid.cell_size
    return Grid(
        height=height.astype(dtype),
        cell_size=float(cell_size),
        origin=(np.asarray(grid.origin, dtype=np.float64) + first).astype(dtype),
        ground=ground,
        valid=valid,
    )


def _regrid_rows(
    values: Float[np.ndarray, "n k"], centres: Float[np.ndarray, " m"], ratio: float
) -> Float[np.ndarray, "m k"]:
    """Sample (ratio < 1) or average (ratio > 1) the piecewise linear surface along axis 0.

    The half cell outside the first and the last centre continues their line.
    """

    def piece(
        position: Float[np.ndarray, " k"],
    ) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 1"]]:
        left = np.clip(np.floor(position).astype(int), 0, len(values) - 2)
        return left, (position - left)[:, np.newaxis]

    if ratio < 1.0:
        left, t = piece(centres)
        between: np.ndarray = (1.0 - t) * values[left] + t * values[left + 1]
        return between
    area = np.zeros_like(values)  # integral from the first centre to each other one
    np.cumsum(0.5 * (values[1:] + values[:-1]), axis=0, out=area[1:])

    def integral(position: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k m"]:
        left, t = piece(position)
        rise = values[left + 1] - values[left]
        total: np.ndarray = area[left] + values[left] * t + rise * (0.5 * t * t)
        return total

    mean: np.ndarray = (integral(centres + 0.5 * ratio) - integral(centres - 0.5 * ratio)) / ratio
    return mean


def _any_in_rows(
    flags: Bool[np.ndarray, "n k"], centres: Float[np.ndarray, " m"], ratio: float
) -> Bool[np.ndarray, "m k"]:
    """Whether any row that contributes to the new one, as in `_regrid_rows`, has its flag set."""
    half = 0.5 * ratio if ratio > 1.0 else 0.0
    # The allowance leaves out rows whose weight is zero but for rounding.
    first = np.clip(np.floor(centres - half + 1e-6).astype(int), 0, len(flags) - 2)
    last = np.clip(np.ceil(centres + half - 1e-6).astype(int), 1, len(flags) - 1)
    count = np.concatenate([np.zeros_like(flags[:1], dtype=int), np.cumsum(flags, axis=0)])
    found: np.ndarray = count[last + 1] > count[np.minimum(first, last)]
    return found
