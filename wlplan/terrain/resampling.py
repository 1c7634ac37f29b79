"""A pile on a grid of another spacing."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wlplan.errors import InputError
from wlplan.types import Pile
from wlplan.xla import floats


def resample(pile: Pile, cell_size: float) -> Pile:
    """Put a pile on a grid of another spacing that covers the same area.

    The surface between the cells is bilinear. A finer grid takes its value at the new cell centres,
    a coarser one its mean over each new cell, which keeps the volume. Affine surfaces come out
    exactly. A new cell is valid if every cell that contributes to it is.

    Args:
        pile: Pile with at least 2 x 2 cells, no NaN.
        cell_size: New grid spacing [m].

    Raises:
        InputError: If the spacing is not positive or leaves fewer than 2 x 2 cells.
    """
    if not 0.0 < cell_size < math.inf:
        raise InputError(f"The cell size is {cell_size:g} m: it has to be positive.")
    ratio = cell_size / pile.cell_size
    if math.isclose(ratio, 1.0, rel_tol=1e-6):
        return pile
    old = np.asarray(pile.height).shape
    # The small allowance keeps 95 cells of 0.2 m at 190, not 189, of 0.1 m.
    new = tuple(math.floor(n / ratio + 1e-6) for n in old)
    if min(*old, *new) < 2:
        raise InputError(
            f"A grid of {old[0]} x {old[1]} cells of {pile.cell_size:g} m cannot be resampled to "
            f"{cell_size:g} m: both grids need at least 2 x 2 cells."
        )
    # New cell centres in units of old cells, from the first old cell; what does not fit a whole
    # new cell is left off on both sides alike.
    centres = [
        (np.arange(m) - 0.5 * (m - 1)) * ratio + 0.5 * (n - 1)
        for n, m in zip(old, new, strict=True)
    ]

    def regrid(values: Float[Array, "nx ny"]) -> Float[np.ndarray, "mx my"]:
        rows = _regrid_rows(np.asarray(values, dtype=np.float64), centres[0], ratio)
        return _regrid_rows(rows.T, centres[1], ratio).T

    height = regrid(pile.height)
    ground = valid = None
    if pile.ground is not None:
        # Continuing a line past the outermost centres could lift the ground through the surface.
        ground = floats(np.minimum(regrid(pile.ground), height))
    if pile.valid is not None:
        unseen = ~np.asarray(pile.valid)
        unseen = _any_in_rows(_any_in_rows(unseen, centres[0], ratio).T, centres[1], ratio).T
        valid = jnp.asarray(~unseen)
    first = np.array([centres[0][0], centres[1][0]]) * pile.cell_size
    return Pile(
        height=floats(height),
        cell_size=float(cell_size),
        origin=floats(np.asarray(pile.origin, dtype=np.float64) + first),
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
