"""The way from the end of a loading to the receiver: reverse out, turn, drive up to the truck.

A way is two curves of Dubins that meet in a cusp: out of the pile backwards (arc, straight line,
arc), and up to the receiver forwards. What is left to choose is the cusp, see
`wlplan.planning.search`; what a way by a cusp costs is in `wlplan.planning.driving`. The best few
ways are blended. `experiments/ways.py` holds them against a search of all ways of one cusp.

Points of a way are the middle of the loader. It stands `approach_distance` behind the dig location
when the loading has ended.
"""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.planning import dubins
from wlplan.planning.driving import Place, Room, Way, looks_along, smooth_depth, ways_by
from wlplan.planning.search import DETOUR, Cusps, fans_of, open_lengths, placed, searcher
from wlplan.planning.yard import Yard, is_unseen
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import Receiver
from wlplan.types import Pose

# The best few ways are blended over this length [m].
_BLENDED, _BLEND = 6, 0.1


def way_to(
    pose: Pose,
    receiver: Receiver,
    room: Room,
    machine: WheelLoader,
    *,
    cusps: Cusps | None = None,
    thorough: bool = True,
) -> tuple[Float[Array, ""], Float[Array, ""], Way]:
    """The way from a dig pose to a receiver.

    Args:
        pose: Dig location and heading.
        receiver: Where the loader stands when it dumps.
        room: Around the pile as it is.
        machine: What drives.
        cusps: Of the best ways where they are known, for instance from a pose nearby.
        thorough: Otherwise: whether the best way is wanted, or a good one in half the time.

    Returns:
        Length [m] and what of it touches [m], blended over the best ways so that both are smooth in
        pose and receiver, neither below the best; and the best way.
    """
    if cusps is None:
        cusps = cusps_to(pose, receiver, room, machine, thorough=thorough)
    start, goal = ends_of(pose, receiver, machine)
    last = ways_by(placed(cusps, start, goal), start, goal, room, machine, smooth_depth)
    cost = last.length + DETOUR * last.touching
    weight = jax.nn.softmax(-cost / _BLEND)
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(cost)], last)
    return (weight * last.length).sum(), (weight * last.touching).sum(), best


def cusps_to(
    pose: Pose, receiver: Receiver, room: Room, machine: WheelLoader, *, thorough: bool = True
) -> Cusps:
    """The cusps of the best ways, which is what takes time; without derivatives.

    Arguments as of `way_to`.
    """
    search = searcher(machine, thorough, jax.default_backend() == "cpu")
    found = search(*ends_of(pose, receiver, machine), room)
    best: Cusps = jax.tree.map(lambda leaf: leaf[:_BLENDED], found)
    return best


def open_length(pose: Pose, receiver: Receiver, machine: WheelLoader) -> Float[Array, ""]:
    """Length of the way, were nothing in it, to half a metre [m]; arguments as of `way_to`."""
    start, goal = ends_of(pose, receiver, machine)
    fans, known = fans_of(machine.turning_radius, start[0].dtype)
    return (known + open_lengths(fans, start, goal, machine.turning_radius)).min()


def ends_of(pose: Pose, receiver: Receiver, machine: WheelLoader) -> tuple[Place, Place]:
    """Where the loading ended, and where the loader dumps."""
    back = machine.approach_distance
    x, y = pose.x - back * jnp.cos(pose.heading), pose.y - back * jnp.sin(pose.heading)
    return (x, y, pose.heading), (receiver.x, receiver.y, receiver.heading)


def unseen_along(way: Way, yard: Yard, radius: float) -> Float[Array, ""]:
    """Length of one way over ground that the scan did not see [m]."""
    total = jnp.zeros((), way.length.dtype)
    for curve in (way.out, way.up):
        for x, y, _, _, weight in looks_along(curve, radius, yard.origin[0]):
            total = total + (is_unseen(yard, x, y) * weight).sum()
    return total


def points_of(way: Way, radius: float, spacing: float = 0.25) -> Float[np.ndarray, "n 4"]:
    """The points of one way: x [m], y [m], heading [rad] and gear, -1 reverse and 1 forward.

    Args:
        way: Leaves without axes.
        radius: Of its arcs [m].
        spacing: Largest distance between points [m].
    """
    parts = []
    for curve, gear in ((way.out, -1.0), (way.up, 1.0)):
        leaves = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), curve)
        lengths = radius * abs(leaves.first), leaves.straight, radius * abs(leaves.last)
        ends = np.cumsum([0.0, *lengths])
        # The ends of arcs are points, so that a straight line between points stays on the way.
        steps = [
            np.linspace(a, b, max(math.ceil((b - a) / spacing), 1), endpoint=False)
            for a, b in itertools.pairwise(ends)
            if b - a > 1e-6
        ]
        distance = np.concatenate([*steps, [ends[-1]]])
        x, y, heading = dubins.along(leaves, distance, radius)
        heading = np.angle(np.exp(1j * heading))
        points = np.stack([x, y, heading, np.full(len(x), gear)], axis=-1)
        parts.append(points[::-1] if gear < 0.0 else points)
    return np.concatenate(parts)
