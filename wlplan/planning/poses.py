"""Dig poses as a position along the toe contour and a heading offset.

The contour is that of the pile before the first loading. As loadings take the toe back, the pose
follows: from its point on the contour it moves along the heading to where the pile, as it is by
then, begins. So every pose is at the toe of the current pile, and differentiably so.
"""

from __future__ import annotations

import math
from typing import no_type_check

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from wlplan.site.machine import WA320, WheelLoader
from wlplan.terrain.heightmap import sample, to_world
from wlplan.terrain.toe import TOE_RISE, ToeContour, check_accessible
from wlplan.types import Pile, Pose
from wlplan.xla import on_device

# Largest heading offset from the inward normal [rad]; the training data have 10 degrees and the
# contour's own noise adds to that.
MAX_OFFSET = math.radians(15.0)

# The pile may have bulged out over its old toe, and may have been taken back this far [m].
_FROM, _TO, _STEP = -2.0, 9.0, 0.1
# Neighbouring points further apart than this are not neighbours on the contour [m].
_GAP = 0.5
# Points of a toe come in multiples of so many.
_BLOCK = 1024
# The toe is where the mean over these lines across the bucket rises, in parts of its width.
_ACROSS = (-1.0 / 3.0, -1.0 / 6.0, 0.0, 1.0 / 6.0, 1.0 / 3.0)


@no_type_check
class Toe(struct.PyTreeNode):
    """A toe contour as arrays, for use inside jitted functions.

    The last point is repeated until there is a multiple of 1,024: so what is compiled for one pile
    serves the next, whose toe has another length.
    """

    points: Float[Array, "n 2"]  # [m]
    direction: Float[Array, "n 2"]  # unit vector into the pile
    count: Int[Array, ""]  # points without the repeated ones
    closed: Bool[Array, ""]
    width: float = struct.field(pytree_node=False)  # of the bucket [m]


def toe_of(
    contour: ToeContour, machine: WheelLoader = WA320, dtype: np.dtype | type = np.float32
) -> Toe:
    """The arrays of a contour; only where it is accessible.

    If part of it is not, the rest is an open path that begins after the longest gap; positions in
    the other gaps go to the nearer side.

    Raises:
        InputError: If no part of it is.
    """
    accessible = np.asarray(contour.accessible)
    check_accessible(accessible)
    points, heading = np.asarray(contour.points), np.asarray(contour.heading)
    closed = bool(contour.closed) and bool(accessible.all())
    if not closed and contour.closed:
        # Start behind the longest run of inaccessible points, wherever the numbering began.
        reachable = np.flatnonzero(accessible)
        gaps = np.diff(np.append(reachable, reachable[0] + len(points)))
        first = reachable[(gaps.argmax() + 1) % len(reachable)]
        order = np.roll(np.arange(len(points)), -first)
        points, heading, accessible = points[order], heading[order], accessible[order]
    points, heading = points[accessible], heading[accessible]
    count = len(points)
    rows = np.minimum(np.arange(-(-count // _BLOCK) * _BLOCK), count - 1)
    points, heading = points[rows], heading[rows]
    return Toe(
        points=on_device(points.astype(dtype)),
        direction=on_device(np.stack([np.cos(heading), np.sin(heading)], axis=1).astype(dtype)),
        count=on_device(np.int32(count)),
        closed=on_device(np.bool_(closed)),
        width=machine.bucket_width,
    )


def pose_at(toe: Toe, pile: Pile, position: Float[Array, ""], offset: Float[Array, ""]) -> Pose:
    """The pose at the current toe of a pile.

    Args:
        toe: Contour of the initial pile.
        pile: The pile as it is.
        position: Along the contour, in parts of its length; wraps around a closed contour.
        offset: Heading offset, unbounded; squashed to `MAX_OFFSET`.
    """
    n = toe.count
    index = jnp.where(
        toe.closed,
        (position - jnp.floor(position)) * n,
        jnp.clip(position, 0.0, 1.0) * (n - 1),
    )
    low = jnp.clip(jnp.floor(lax.stop_gradient(index)).astype(jnp.int32), 0, n - 1)
    high = jnp.where(toe.closed, (low + 1) % n, jnp.minimum(low + 1, n - 1))
    # Across a gap in the contour there is nothing to interpolate.
    gap = jnp.abs(toe.points[high] - toe.points[low]).max() > _GAP
    part = jnp.where(gap, jnp.round(index - low), index - low)
    point = (1.0 - part) * toe.points[low] + part * toe.points[high]
    into = (1.0 - part) * toe.direction[low] + part * toe.direction[high]
    heading = jnp.arctan2(into[1], into[0]) + MAX_OFFSET * jnp.tanh(offset)
    anchor = Pose(x=point[0], y=point[1], heading=heading)
    x, y = to_world(anchor, distance_to_toe(pile, anchor, width=toe.width), jnp.zeros_like(heading))
    return Pose(x=x, y=y, heading=heading)


def distance_to_toe(pile: Pile, pose: Pose, *, width: float) -> Float[Array, ""]:
    """Distance along the heading to where the pile begins, over the width of a bucket [m].

    Zero if there is no pile on the way.
    """
    dtype = pile.height.dtype
    along = jnp.arange(_FROM, _TO, _STEP, dtype=dtype)
    across = jnp.asarray(width * np.array(_ACROSS), dtype)
    points = to_world(pose, *jnp.meshgrid(along, across, indexing="ij"))
    rise = sample(pile.height - pile.floor, pile, *points).mean(axis=1)
    reached = rise >= TOE_RISE
    first = jnp.argmax(reached)
    before = jnp.maximum(first - 1, 0)
    climb = rise[first] - rise[before]
    # Between the last point below the level and the first above it, by interpolation.
    part = jnp.where(
        climb > 0.0, (TOE_RISE - rise[before]) / jnp.where(climb > 0.0, climb, 1.0), 0.0
    )
    distance = along[before] + _STEP * jnp.clip(part, 0.0, 1.0)
    return jnp.where(reached.any(), distance, 0.0)
