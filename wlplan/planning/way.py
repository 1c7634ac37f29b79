"""The way from the end of a loading to the receiver: reverse out, turn, drive up to the truck.

A way is two curves of Dubins that meet in a cusp, where the loader changes from reverse to forward:
out of the pile backwards (arc, straight line, arc), and up to the receiver forwards. What is left
to choose is the cusp. A fan of cusps is tried: reverse straight and then along an arc, and the
shortest way from there; the same from the receiver's end; and reverse around two arcs. The best
are shifted a little, twice, as the last of them are to be good. A way costs its length, and what
it touches.

Points of a way are the middle of the loader. It stands `approach_distance` behind the dig location
when the loading has ended.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.planning import dubins
from wlplan.planning.dubins import WORDS, Curve, curve_between
from wlplan.planning.yard import (
    Depths,
    Yard,
    depth_at,
    depths,
    is_standing,
    is_unseen,
)
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import Receiver, truck_outline
from wlplan.terrain.heightmap import sample, to_world
from wlplan.terrain.standing import CLEARED
from wlplan.types import Pile, Pose
from wlplan.xla import materialize

# The fan. Reversing straight [m] and then along an arc [degrees], from either end; and around an
# arc, straight on and around another arc, likewise.
_STRAIGHT = (0.0, 3.0, 6.5, 11.0, 16.0)
_ARC = (0.0, 15.0, 30.0, 45.0, 65.0, 90.0, 120.0)
_TWICE = ((35.0, 70.0), (0.0, 4.0), (0.0, 40.0, 80.0, 120.0))
# By how much the best cusps are shifted at most [m] and turned [rad], in one round after the other;
# each to as many places around as there are of them, which makes a round as large as the fan.
_ROUNDS = ((2.0, 0.45), (0.7, 0.15))
_BEST = 11
# Places on each of the two curves where the loader is looked at.
_LOOKS = 14
# Metres of way that one metre in the middle of an obstacle is worth: no way around is longer.
_DETOUR = 20.0
# The lane is looked at in steps of this length, and soil this much higher than can be driven over
# counts in full [m].
_LANE_STEP, _LANE_RAMP = 0.4, 0.1
# The best few ways are blended over this length [m].
_BLENDED, _BLEND = 6, 0.1


LANE_END = 0.3
"""How far before the dig location, where the pile begins, the approach lane ends [m]."""


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


def way_to(
    pose: Pose, receiver: Receiver, room: Room, machine: WheelLoader
) -> tuple[Float[Array, ""], Float[Array, ""], Way]:
    """The way from a dig pose to a receiver.

    Args:
        pose: Dig location and heading.
        receiver: Where the loader stands when it dumps.
        room: Around the pile as it is.
        machine: What drives.

    Returns:
        Length [m] and what of it touches [m], blended over the best ways so that both are smooth in
        pose and receiver, neither below the best; and the best way.
    """
    back = machine.approach_distance
    start = (
        pose.x - back * jnp.cos(pose.heading),
        pose.y - back * jnp.sin(pose.heading),
        pose.heading,
    )
    goal = (receiver.x, receiver.y, receiver.heading)
    cusps = _search(*lax.stop_gradient((start, goal)), room, machine)
    at = _placed(jax.tree.map(lambda leaf: leaf[:_BLENDED], cusps), start, goal)
    last = _ways(at, start, goal, room, machine)
    cost = last.length + _DETOUR * last.touching
    weight = jax.nn.softmax(-cost / _BLEND)
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(cost)], last)
    return (weight * last.length).sum(), (weight * last.touching).sum(), best


_Place = tuple[Array, Array, Array]
"""X [m], y [m] and heading [rad]."""


class _Cusps(NamedTuple):
    """Cusps in the frame of one of the ends, so that they move with it."""

    local: Float[Array, "k 3"]  # x, y, heading
    at_start: Bool[Array, " k"]  # or else at the receiver


def _placed(cusps: _Cusps, start: _Place, goal: _Place) -> _Place:
    """Cusps in the frame of the pile."""
    x, y, heading = (jnp.where(cusps.at_start, a, b) for a, b in zip(start, goal, strict=True))
    c, s = jnp.cos(heading), jnp.sin(heading)
    ahead, left, turn = cusps.local.T
    return x + c * ahead - s * left, y + s * ahead + c * left, heading + turn


def _search(start: _Place, goal: _Place, room: Room, machine: WheelLoader) -> _Cusps:
    """The best cusps, the very best first; without derivatives.

    One loop over rounds of one size: its body is compiled once.
    """
    dtype = start[0].dtype
    fan = jnp.asarray(_fan(machine.turning_radius), dtype)
    places = jnp.asarray(_halton(_BEST), dtype)
    scales = jnp.asarray([(0.0, 0.0, 0.0)] * 2 + [(d, d, turn) for d, turn in _ROUNDS], dtype)

    def one(best: tuple[_Cusps, Array], number: Array) -> tuple[tuple[_Cusps, Array], None]:
        (local, at_start), costs = best
        around = (local[:, None] + (scales[number][None] * places)[None]).reshape(-1, 3)
        tried = _Cusps(
            jnp.where(number < 2, fan, around),
            jnp.where(number < 2, number == 0, jnp.repeat(at_start, _BEST)),
        )
        at = _placed(tried, start, goal)
        ways = _ways(at, start, goal, room, machine)
        all_costs = jnp.concatenate([costs, ways.length + _DETOUR * ways.touching])
        _, rows = lax.top_k(-all_costs, _BEST)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b])[rows], best[0], tried)
        return (both, all_costs[rows]), None

    none = _Cusps(jnp.zeros((_BEST, 3), dtype), jnp.zeros(_BEST, bool))
    first = none, jnp.full(_BEST, jnp.inf, dtype)
    (cusps, _), _ = lax.scan(one, first, jnp.arange(2 + len(_ROUNDS)))
    return cusps


@functools.cache
def _fan(radius: float) -> Float[np.ndarray, "k 3"]:
    """The cusps that are tried first, in the frame of an end."""
    straight, arc = np.meshgrid(_STRAIGHT, np.radians(_either_way(_ARC)), indexing="ij")
    none = np.zeros(arc.size)
    origin = none, none, none
    single = _reverse(origin, straight.ravel(), arc.ravel(), radius)
    first, middle, last = (
        axis.ravel()
        for axis in np.meshgrid(
            np.radians(_either_way(_TWICE[0])),
            _TWICE[1],
            np.radians(_either_way(_TWICE[2])),
            indexing="ij",
        )
    )
    none = np.zeros(first.size)
    double = _reverse(_reverse((none, none, none), none, first, radius), middle, last, radius)
    fan = np.concatenate([np.stack(single, axis=-1), np.stack(double, axis=-1)])
    assert len(fan) == _BEST**2, "a round is as large as the fan"
    return fan


def _either_way(angles: tuple[float, ...]) -> list[float]:
    return sorted({sign * angle for sign in (-1.0, 1.0) for angle in angles})


_Places = tuple[np.ndarray, np.ndarray, np.ndarray]


def _reverse(place: _Places, straight: np.ndarray, turn: np.ndarray, radius: float) -> _Places:
    """Where one is after reversing straight [m] and then along an arc that turns the heading."""
    x, y, heading = place
    x, y = x - straight * np.cos(heading), y - straight * np.sin(heading)
    chord, middle = 2.0 * radius * np.sin(np.abs(0.5 * turn)), heading + 0.5 * turn
    return x - chord * np.cos(middle), y - chord * np.sin(middle), heading + turn


def _halton(count: int) -> Float[np.ndarray, "count 3"]:
    """Places spread evenly in a cube from -1 to 1: the sequence of Halton."""

    def inverse(number: int, base: int) -> float:
        value, part = 0.0, 1.0
        while number:
            part /= base
            value += part * (number % base)
            number //= base
        return value

    return np.array(
        [[2.0 * inverse(n, base) - 1.0 for base in (2, 3, 5)] for n in range(1, count + 1)]
    )


def _ways(cusps: _Place, start: _Place, goal: _Place, room: Room, machine: WheelLoader) -> Way:
    """The shortest way by way of each cusp, and what it touches."""
    radius = machine.turning_radius
    shared = room.yard.origin[0]
    out, up = materialize([_shortest(cusps, end, radius) for end in (start, goal)], shared)
    length = dubins.length_of(out, radius) + dubins.length_of(up, radius)
    parts = [_looks(curve, radius) for curve in (out, up)]
    looks = [jnp.concatenate(leaves, axis=1) for leaves in zip(*parts, strict=True)]
    x, y, c, s, weight = materialize(looks, shared)
    third = machine.length / 3.0

    def discs(front: float) -> tuple[Array, Array]:
        ahead = jnp.asarray([-third, 0.0, front], x.dtype)[:, None, None]
        return x[None] + ahead * c[None], y[None] + ahead * s[None]

    depth = depth_at(room.field, *discs(third))
    # The raised bucket reaches over the side of the truck.
    depth += _depth_in_truck(*discs(third - machine.overhang), goal, room.yard.reach, machine)
    return Way(out, up, length, (depth.sum(axis=0) * weight).sum(axis=1))


def _shortest(start: _Place, end: _Place, radius: float) -> Curve:
    """The shortest curve from each start to the one end."""
    x, y, heading = (leaf[:, None] for leaf in start)
    words = jnp.asarray(WORDS, start[0].dtype)[None]
    curves, exists = curve_between((x, y, heading), end, words, radius)
    lengths = jnp.where(exists, dubins.length_of(curves, radius), jnp.inf)
    row = jnp.argmin(lengths, axis=1)[:, None]

    def pick(leaf: Array) -> Array:
        return jnp.take_along_axis(jnp.broadcast_to(leaf, lengths.shape), row, axis=1)[:, 0]

    picked: Curve = jax.tree.map(pick, curves)
    return picked


def _looks(curve: Curve, radius: float) -> tuple[Array, ...]:
    """Places along curves: x, y, cosine and sine of the heading, and the length each stands for."""
    heading, first, straight, last = (
        leaf[:, None] for leaf in (curve.heading, curve.first, curve.straight, curve.last)
    )
    length = dubins.length_of(curve, radius)[:, None]
    distance = length * jnp.asarray((np.arange(_LOOKS) + 0.5) / _LOOKS, length.dtype)[None]
    arc = radius * jnp.abs(first)
    # The heading on the first arc, or at its end; and then on the last one.
    turned = heading + jnp.sign(first) * jnp.minimum(distance, arc) / radius
    there = turned + jnp.sign(last) * jnp.maximum(distance - arc - straight, 0.0) / radius
    on_line = jnp.clip(distance - arc, 0.0, straight)
    side, other = radius * jnp.sign(first), radius * jnp.sign(last)
    c1, s1, c, s = jnp.cos(turned), jnp.sin(turned), jnp.cos(there), jnp.sin(there)
    line = heading + first
    x = curve.x[:, None] + side * (s1 - jnp.sin(heading)) + on_line * jnp.cos(line)
    y = curve.y[:, None] - side * (c1 - jnp.cos(heading)) + on_line * jnp.sin(line)
    weight = jnp.broadcast_to(length / _LOOKS, c.shape)
    return x + other * (s - s1), y - other * (c - c1), c, s, weight


def _depth_in_truck(x: Array, y: Array, goal: _Place, reach: float, machine: WheelLoader) -> Array:
    """How deep discs are in the truck, as `Depths.depth`."""
    return jnp.maximum(1.0 - _truck_distance(x, y, goal, machine) / reach, 0.0)


def _truck_distance(x: Array, y: Array, goal: _Place, machine: WheelLoader) -> Array:
    """Distance to the outline of the truck [m]; next to nothing inside it."""
    near, far, half = truck_outline(machine)
    c, s = jnp.cos(goal[2]), jnp.sin(goal[2])
    dx, dy = x - goal[0], y - goal[1]
    across = jnp.abs(c * dx + s * dy - 0.5 * (near + far)) - 0.5 * (far - near)
    along = jnp.abs(c * dy - s * dx) - half
    apart = jnp.maximum(across, 0.0) ** 2 + jnp.maximum(along, 0.0) ** 2
    # The square root has no derivative at zero.
    return jnp.sqrt(apart + 1e-6)


def lane_touching(
    pose: Pose, receiver: Receiver, pile: Pile, yard: Yard, machine: WheelLoader
) -> Float[Array, ""]:
    """Length of the approach lane in which something stands that cannot be driven over [m].

    The lane is as wide as the bucket and runs straight to the dig location, from where the rear of
    the loader is when the loading ends.

    Args:
        pose: Dig location and heading.
        receiver: Whose truck must not stand there either.
        pile: The pile as it is.
        yard: What stands still there.
        machine: What drives.
    """
    dtype = pile.height.dtype
    first, last = -machine.approach_distance - 0.5 * machine.length, -LANE_END
    rows = max(round((last - first) / _LANE_STEP), 1)
    columns = max(round(machine.bucket_width / _LANE_STEP), 1)
    along = jnp.asarray(first + (last - first) * (np.arange(rows) + 0.5) / rows, dtype)
    left = machine.bucket_width * ((np.arange(columns) + 0.5) / columns - 0.5)
    x, y = to_world(pose, *jnp.meshgrid(along, jnp.asarray(left, dtype), indexing="ij"))
    soil = jnp.clip((sample(pile.height - pile.floor, pile, x, y) - CLEARED) / _LANE_RAMP, 0.0, 1.0)
    goal = receiver.x, receiver.y, receiver.heading
    truck = jnp.clip(1.0 - _truck_distance(x, y, goal, machine) / _LANE_RAMP, 0.0, 1.0)
    most = jnp.maximum(jnp.maximum(soil, truck), is_standing(yard, x, y)).max(axis=1)
    return most.sum() * (last - first) / rows


def unseen_along(way: Way, yard: Yard, radius: float) -> Float[Array, ""]:
    """Length of one way over ground that the scan did not see [m]."""
    total = jnp.zeros((), way.length.dtype)
    for curve in (way.out, way.up):
        x, y, _, _, weight = _looks(jax.tree.map(lambda leaf: leaf[None], curve), radius)
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
