"""Windows: the part of a grid that a loading disturbs, cut out and put back."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from wlplan.terrain.heightmap import part_around
from wlplan.types import Pile, Pose

# Side of the window that is settled after a loading [cells], and how far its centre lies ahead of
# the dig location along the heading [m]: the bucket reaches 4.5 m in, avalanches run up from there.
WINDOW = 96
_WINDOW_AHEAD = 2.0


def window_of(pile: Pile, pose: Pose) -> tuple[Pile, tuple[Array, Array]]:
    """The part of the grid around a dig pose that a loading disturbs, and its first cell.

    The window lies inside the grid. A grid that is smaller is returned whole.
    """
    return part_around(
        pile,
        pose.x + _WINDOW_AHEAD * jnp.cos(pose.heading),
        pose.y + _WINDOW_AHEAD * jnp.sin(pose.heading),
        WINDOW,
    )


def paste(height: Array, part: Array, start: Array) -> Array:
    """The whole grid with a part of it replaced."""
    return lax.dynamic_update_slice(height, part, (start[0], start[1]))


def pad_pile(pile: Pile, block: int) -> Pile:
    """Extends the sides of a pile to multiples of `block` cells; the new ones take no part."""
    nx, ny = pile.height.shape
    widths = ((0, -nx % block), (0, -ny % block))
    if widths == ((0, 0), (0, 0)):
        return pile
    valid = jnp.ones((nx, ny), bool) if pile.valid is None else pile.valid
    return pile.replace(
        height=jnp.pad(pile.height, widths, mode="edge"),
        ground=None if pile.ground is None else jnp.pad(pile.ground, widths, mode="edge"),
        valid=jnp.pad(valid, widths),
    )
