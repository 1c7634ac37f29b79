"""How far a loader drives by way of a cusp, and what it touches there.

A way is two curves of Dubins that meet in a cusp, where the loader changes from reverse to forward.
Its outline is a row of discs, looked at in some places on each of the curves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from wlplan.planning import dubins
from wlplan.planning.dubins import WORDS, Curve, curve_between
from wlplan.planning.yard import DISCS, Depths, Yard, depth_at, depth_near, depths, disc_radius
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import truck_outline
from wlplan.types import Pile
from wlplan.xla import materialize

# Places on each arc, and on the line between, where the loader is looked at. As it is a row of
# discs, they leave no gap on a line of 20 m; on an arc its corners swing out between them.
_ON_ARC, _ON_LINE = 6, 4


@no_type_check
class Way(struct.PyTreeNode):
    """A way to the receiver, or several; see the module."""

    out: Curve  # from the cusp to where the loading ended; driven backwards
    up: Curve  # from the cusp to the receiver
    length: Float[Array, "*n"]  # of both [m]
    touching: Float[Array, "*n"]  # of it in what must not be touched [m]


class Room(struct.PyTreeNode):
    """All that a way depends on but its ends."""

    yard: Yard
    field: Depths


def room_of(yard: Yard, pile: Pile) -> Room:
    """Room to drive around a pile as it is."""
    return Room(yard, depths(yard, pile))


Place = tuple[Array, Array, Array]
"""X [m], y [m] and heading [rad]."""


Stance = tuple[Array, Array, Array, Array]
"""X [m], y [m], cosine and sine of the heading."""

DepthOf = Callable[[Stance, Place, Room, WheelLoader], Array]


def ways_by(
    cusps: Place,
    start: Place,
    goal: Place,
    room: Room,
    machine: WheelLoader,
    depth_of: DepthOf,
) -> Way:
    """The shortest way by way of each cusp, and what it touches."""
    radius = machine.turning_radius
    shared = room.yard.origin[0]
    x0, y0, heading0 = (leaf[None] for leaf in cusps)
    x1, y1, heading1 = (jnp.stack(pair)[:, None] for pair in zip(start, goal, strict=True))
    both = materialize(_shortest((x0, y0, heading0), (x1, y1, heading1), radius), shared)
    touching = jnp.zeros_like(cusps[0])
    for looks in looks_along(both, radius, shared):
        x, y, c, s, weight = materialize(looks, shared)
        depth = depth_of((x, y, c, s), goal, room, machine)
        touching += (depth * weight).sum(axis=(0, 1))
    out, up = (jax.tree.map(lambda leaf, k=k: leaf[k], both) for k in (0, 1))
    return Way(out, up, dubins.length_of(both, radius).sum(axis=0), touching)


def _discs(machine: WheelLoader) -> list[tuple[float, float]]:
    """How far ahead of its middle the discs of a loader are, and where they are for the truck [m].

    The raised bucket reaches over the side of the truck: the foremost disc ends where it does when
    the loader dumps.
    """
    side, _, _ = truck_outline(machine)
    ahead = machine.length * ((np.arange(DISCS) + 0.5) / DISCS - 0.5)
    return [(float(a), min(float(a), side - disc_radius(machine))) for a in ahead]


def rough_depth(place: Stance, goal: Place, room: Room, machine: WheelLoader) -> Array:
    """How deep the loader is in what it must not touch, over its discs; without derivatives.

    Args:
        place: Its middle and heading.
        goal: Where it dumps.
        room: Around the pile.
        machine: The loader.
    """
    x, y, c, s = place
    depth = jnp.zeros(())
    # Disc by disc: XLA makes faster code of it than of an axis of discs.
    for ahead, at_truck in _discs(machine):
        depth = depth + depth_near(room.field, x + ahead * c, y + ahead * s)
        truck = x + at_truck * c, y + at_truck * s
        depth = depth + _depth_in_truck(*truck, goal, room.yard.reach, machine)
    return depth


def smooth_depth(place: Stance, goal: Place, room: Room, machine: WheelLoader) -> Array:
    """`rough_depth`, but smooth in the place and the goal."""
    x, y, c, s = (leaf[None] for leaf in place)
    ahead, at_truck = (
        jnp.asarray(row, x.dtype).reshape(-1, *[1] * (x.ndim - 1))
        for row in zip(*_discs(machine), strict=True)
    )
    depth = depth_at(room.field, x + ahead * c, y + ahead * s)
    truck = x + at_truck * c, y + at_truck * s
    depth += _depth_in_truck(*truck, goal, room.yard.reach, machine)
    return depth.sum(axis=0)


def _shortest(start: Place, end: Place, radius: float) -> Curve:
    """The shortest curve from each start to each end, of the shape that both broadcast to."""
    shape = jnp.broadcast_shapes(start[0].shape, end[0].shape)
    words = jnp.asarray(WORDS, start[0].dtype).reshape(len(WORDS), *[1] * len(shape), 2)
    x0, y0, heading0 = (leaf[None] for leaf in start)
    x1, y1, heading1 = (leaf[None] for leaf in end)
    curves, exists = curve_between((x0, y0, heading0), (x1, y1, heading1), words, radius)
    lengths = jnp.where(exists, dubins.length_of(curves, radius), jnp.inf)
    row = jnp.argmin(lengths, axis=0)[None]

    def pick(leaf: Array) -> Array:
        return jnp.take_along_axis(jnp.broadcast_to(leaf, lengths.shape), row, axis=0)[0]

    picked: Curve = jax.tree.map(pick, curves)
    return picked


_Looks = tuple[Array, Array, Array, Array, Array]
"""X [m], y [m], cosine and sine of the heading, and the length each place stands for [m]."""


def looks_along(curve: Curve, radius: float, shared: Array) -> Iterator[_Looks]:
    """Places along the first arc of curves, the line and the last arc, on a new first axis."""
    curve = jax.tree.map(lambda leaf: leaf[None], curve)
    h0, h1 = curve.heading, curve.heading + curve.first
    c0, s0, c1, s1 = materialize((jnp.cos(h0), jnp.sin(h0), jnp.cos(h1), jnp.sin(h1)), shared)

    def parts(count: int) -> Array:
        part = jnp.asarray((np.arange(count) + 0.5) / count, h0.dtype)
        return part.reshape(-1, *[1] * (h0.ndim - 1))

    def on_arc(x: Array, y: Array, c: Array, s: Array, heading: Array, turn: Array) -> _Looks:
        side, there = radius * jnp.sign(turn), heading + parts(_ON_ARC) * turn
        ct, st = jnp.cos(there), jnp.sin(there)
        weight = radius * jnp.abs(turn) / _ON_ARC
        return x + side * (st - s), y - side * (ct - c), ct, st, weight

    yield on_arc(curve.x, curve.y, c0, s0, h0, curve.first)
    side = radius * jnp.sign(curve.first)
    x, y = curve.x + side * (s1 - s0), curve.y - side * (c1 - c0)
    far = parts(_ON_LINE) * curve.straight
    yield x + far * c1, y + far * s1, c1, s1, curve.straight / _ON_LINE
    x, y = x + curve.straight * c1, y + curve.straight * s1
    yield on_arc(x, y, c1, s1, h1, curve.last)


def _depth_in_truck(x: Array, y: Array, goal: Place, reach: float, machine: WheelLoader) -> Array:
    """How deep discs are in the truck, as `Depths.depth`."""
    return jnp.maximum(1.0 - truck_distance(x, y, goal, machine) / reach, 0.0)


def truck_distance(x: Array, y: Array, goal: Place, machine: WheelLoader) -> Array:
    """Distance to the outline of the truck [m]; next to nothing inside it."""
    near, far, half = truck_outline(machine)
    c, s = jnp.cos(goal[2]), jnp.sin(goal[2])
    dx, dy = x - goal[0], y - goal[1]
    across = jnp.abs(c * dx + s * dy - 0.5 * (near + far)) - 0.5 * (far - near)
    along = jnp.abs(c * dy - s * dx) - half
    apart = jnp.maximum(across, 0.0) ** 2 + jnp.maximum(along, 0.0) ** 2
    # The square root has no derivative at zero.
    return jnp.sqrt(apart + 1e-6)
