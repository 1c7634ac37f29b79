"""Walls: ground that stands in the way of the bucket, a rigid obstacle.

A wall is where the ground ahead of a column of the bucket rises, within a few cells, by more than a
loader drives over. Its face is taken as vertical. On the local heightfield it is a ramp of a cell
or two, and the middle of the ramp is where the face is best known: it moves smoothly with the pose,
wherever the cells lie.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE
from wlplan.terrain.heightmap import STATE_CELLS, STATE_DISPLACEMENT, local_axes
from wlplan.terrain.standing import CLEARED

NOWHERE = 100.0
"""Where a wall is that is not there [m]: beyond all that a bucket comes to, and finite."""

# Cells as close to a face as this may be a part of its ramp [m].
_FOOT = 2.0 * CELL_SIZE

_ALONG, _ = local_axes(STATE_CELLS, STATE_DISPLACEMENT)


def faces(
    ground: Float[Array, "n lanes b"],
) -> tuple[Float[Array, "n-1 b"], Float[Array, "n-1 b"]]:
    """The faces that the bucket can meet, between each row of the heightfield and the next.

    Args:
        ground: What cannot be moved, in the columns that the bucket covers [m].

    Returns:
        Positions of the faces along the heading, the nearest of all columns [m], and how high the
        ground stands behind them, the highest [m].
    """
    # The ramp may begin a row before the two that its middle lies between, and end one after.
    wide = jnp.pad(ground, ((1, 1), (0, 0), (0, 0)), mode="edge")
    before, after = ground[:-1], ground[1:]
    foot, top = jnp.minimum(wide[:-3], before), jnp.maximum(after, wide[3:])
    middle = 0.5 * (foot + top)
    stands = (top - foot > CLEARED) & (before < middle) & (middle <= after)
    part = jnp.where(stands, middle - before, 0.0) / jnp.where(stands, after - before, 1.0)
    along = jnp.asarray(_ALONG[: len(before), None, None], ground.dtype)
    position = jnp.where(stands, along + CELL_SIZE * part, NOWHERE)
    return position.min(axis=1), jnp.where(stands, top, -NOWHERE).max(axis=1)


def nearest(
    position: Float[Array, "n b"], top: Float[Array, "n b"], edge: Float[Array, " b"]
) -> Float[Array, " b"]:
    """How far the bucket comes: to the first face that stands higher than its edge [m].

    Args:
        position: Positions of faces, see `faces` [m].
        top: How high they stand [m].
        edge: Height of the cutting edge [m].
    """
    return jnp.where(top > edge[None], position, NOWHERE).min(axis=0)


def in_front(x: Float[Array, "*b"] | float, wall: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Positions along the heading, but none on the ramp of a wall nor behind it [m].

    Args:
        x: Positions [m].
        wall: Where the wall's face is [m].
    """
    return jnp.minimum(x, wall - _FOOT)
