"""How a face is worked well, as terms of an objective: wide, straight on, never undercut.

Operators' guides ask for it (Terex, Wheel loader operator's manual; Caterpillar, Performance
handbook): a face two buckets wide, so that no slot is dug; met straight, the machine not
articulated; none that stands steeper than the soil rests and higher than the bucket reaches.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.planning.lane import LANE_END
from wlplan.planning.loading import Loading
from wlplan.terrain.characteristics import characteristics
from wlplan.terrain.heightmap import sample, sample_local, to_world
from wlplan.terrain.standing import CLEARED

# Steps in which the strips beside the lane, and the face ahead, are looked at [m].
_STEP = 0.4
# Soil this much higher than can be driven over counts in full [m].
_RAMP = 0.1
# How far ahead of the dig location a face is looked at [m].
_AHEAD = 6.0
# A face this much steeper than the soil rests is steep [rad].
_STEEPER = math.radians(5.0)


def slot(loading: Loading) -> Float[Array, ""]:
    """Metres of the lane with soil on both sides, nearer than half a bucket: a slot [m]."""
    machine, pile = loading.site.machine, loading.pile
    first, last = -machine.approach_distance, -LANE_END
    rows = max(round((last - first) / _STEP), 1)
    columns = max(round(0.5 * machine.bucket_width / _STEP), 1)
    along = first + (last - first) * (np.arange(rows) + 0.5) / rows
    beside = 0.5 * machine.bucket_width * (1.0 + (np.arange(columns) + 0.5) / columns)
    left = np.concatenate([beside, -beside])
    grid = np.meshgrid(along, left, indexing="ij")
    x, y = to_world(loading.pose, *(jnp.asarray(axis, pile.height.dtype) for axis in grid))
    over = sample(pile.height - pile.floor, pile, x, y) - CLEARED
    most = jnp.clip(over / _RAMP, 0.0, 1.0).reshape(rows, 2, columns).max(axis=2)
    return most.min(axis=1).sum() * (last - first) / rows


def oblique(loading: Loading) -> Float[Array, ""]:
    """One less the cosine of the angle between heading and face: 0 straight on, 1 along it [1]."""
    return 1.0 - jnp.cos(characteristics(sample_local(loading.pile, loading.pose)).incidence)


def undercut(loading: Loading) -> Float[Array, ""]:
    """Height of the face ahead above what the bucket reaches, where it is steeper than repose [m].

    The bucket reaches as high as the boom does when it stands upright.
    """
    machine, pile = loading.site.machine, loading.pile
    reach = machine.pivot_height + machine.boom_length
    ahead = np.arange(0.0, _AHEAD + _STEP, _STEP)
    steep = math.tan(loading.site.soil.repose_angle + _STEEPER) * ahead
    x, y = to_world(
        loading.pose, *(jnp.asarray(axis, pile.height.dtype) for axis in (ahead, 0.0 * ahead))
    )
    face = sample(pile.height - pile.floor, pile, x, y)
    allowed = jnp.asarray(np.maximum(reach, steep), face.dtype)
    return jax.nn.relu(face - allowed).max()
