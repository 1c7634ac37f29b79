"""Good ways of many loads at once, outside of any trace: where trucks stand, where loads are dug.

One program serves all who ask, since the search of a way takes long to compile.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from wlplan.parallel import ParallelMap
from wlplan.planning.driving import Room, room_of
from wlplan.planning.lane import lane_touching
from wlplan.planning.search import Cusps
from wlplan.planning.way import cusps_to, way_to
from wlplan.planning.yard import Yard
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.types import Pile, Pose

# Ways that one core looks for at a time.
_PORTION = 8


class GoodWays(NamedTuple):
    """The best ways that a quick search finds, leaves [n, ...]."""

    cusps: Cusps
    length: Float[Any, "*n"]  # of the best few in the mean [m]
    touching: Float[Any, "*n"]  # of them and of the lane in what must not be touched [m]


def good_ways(
    pile: Pile, yard: Yard, machine: WheelLoader, poses: Pose, receivers: Receiver
) -> GoodWays:
    """Ways from dig poses to a receiver each.

    Args:
        pile: The pile as it is.
        yard: What stands still around it.
        machine: What drives.
        poses: Leaves [n].
        receivers: Leaves [n].
    """
    ends = np.stack([np.asarray(leaf) for leaf in jax.tree.leaves((poses, receivers))], axis=1)
    count = len(ends)
    # Always whole portions: the last one is filled up with its last row.
    rows = np.minimum(np.arange(-(-count // _PORTION) * _PORTION), count - 1)
    shared = pile, _room(yard, pile), Site(machine=machine)
    found = _of_portions(shared, ends[rows].reshape(-1, _PORTION, ends.shape[1]))
    ways: GoodWays = jax.tree.map(
        lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:])[:count], found
    )
    return ways


def _of_portion(shared: tuple[Pile, Room, Site], ends: Float[Array, "n 6"]) -> GoodWays:
    pile, room, site = shared
    machine = site.machine

    def one(both: Float[Array, "6"]) -> GoodWays:
        pose, receiver = Pose(*both[:3]), Receiver(*both[3:])
        cusps = cusps_to(pose, receiver, room, machine, thorough=False)
        length, touching, _ = way_to(pose, receiver, room, machine, cusps=cusps)
        return GoodWays(
            cusps, length, touching + lane_touching(pose, receiver, pile, room.yard, machine)
        )

    found: GoodWays = jax.vmap(one)(ends)
    return found


_of_portions = ParallelMap(_of_portion)
_room = jax.jit(room_of)
