"""The approach lane: straight to the dig location, over ground that a loader can drive over."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.planning.driving import truck_distance
from wlplan.planning.yard import Yard, is_standing
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import Receiver
from wlplan.terrain.heightmap import sample, to_world
from wlplan.terrain.standing import CLEARED
from wlplan.types import Pile, Pose

# The lane is looked at in steps of this length [m]: ridges of a cell or two are left in it. Soil
# begins to count this much below what can be driven over, and the truck so far away [m].
_LANE_STEP, _SOIL_RAMP, _TRUCK_RAMP = 0.2, 0.05, 0.1


LANE_END = 0.3
"""How far before the dig location, where the pile begins, the approach lane ends [m]."""


def lane_touching(
    pose: Pose, receiver: Receiver | None, pile: Pile, yard: Yard, machine: WheelLoader
) -> Float[Array, ""]:
    """Length of the approach lane in which something stands that cannot be driven over [m].

    The lane is as wide as the bucket and runs straight to the dig location, from where the rear of
    the loader is when the loading ends.

    Args:
        pose: Dig location and heading.
        receiver: Whose truck must not stand there either; None: there is no truck.
        pile: The pile as it is.
        yard: What stands still there.
        machine: What drives.
    """
    dtype = pile.height.dtype
    first, last = -machine.approach_distance - 0.5 * machine.length, -LANE_END
    rows = max(round((last - first) / _LANE_STEP), 1)
    columns = max(round(machine.bucket_width / _LANE_STEP), 1) + 1
    along = jnp.asarray(first + (last - first) * (np.arange(rows) + 0.5) / rows, dtype)
    # From edge to edge, and a little further.
    left = (machine.bucket_width + _SOIL_RAMP) * np.linspace(-0.5, 0.5, columns)
    x, y = to_world(pose, *jnp.meshgrid(along, jnp.asarray(left, dtype), indexing="ij"))
    over = sample(pile.height - pile.floor, pile, x, y) - (CLEARED - _SOIL_RAMP)
    soil = jnp.clip(over / _SOIL_RAMP, 0.0, 1.0)
    blocked = jnp.maximum(soil, is_standing(yard, x, y))
    if receiver is not None:
        goal = receiver.x, receiver.y, receiver.heading
        truck = jnp.clip(1.0 - truck_distance(x, y, goal, machine) / _TRUCK_RAMP, 0.0, 1.0)
        blocked = jnp.maximum(blocked, truck)
    most = blocked.max(axis=1)
    return most.sum() * (last - first) / rows
