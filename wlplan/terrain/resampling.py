"""A pile on a grid of another spacing."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from wlplan.terrain.grid import Grid, regrid
from wlplan.types import Pile


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
    fields: dict[str, Any] = {
        name: None if (field := getattr(pile, name)) is None else np.asarray(field)
        for name in ("height", "origin", "ground", "valid")
    }
    grid = Grid(cell_size=pile.cell_size, **fields)
    found = regrid(grid, cell_size)
    if found is grid:
        return pile
    return Pile(
        height=jnp.asarray(found.height),
        cell_size=found.cell_size,
        origin=jnp.asarray(found.origin),
        ground=None if found.ground is None else jnp.asarray(found.ground),
        valid=None if found.valid is None else jnp.asarray(found.valid),
    )
