"""The way from the end of a loading to the receiver: reverse out, turn, drive up to the truck.

A way is two curves of Dubins that meet in a cusp, where the loader changes from reverse to forward:
out of the pile backwards (arc, straight line, arc), and up to the receiver forwards. What is left
to choose is the cusp. A fan of cusps is tried: reverse straight and then along an arc, and the
shortest way from there; the same from the receiver's end; and reverse around two arcs. The best
are shifted, by less and less. A way costs its length, and what it touches. `experiments/ways.py`
holds what is found against a search of all ways of one cusp.

Points of a way are the middle of the loader. It stands `approach_distance` behind the dig location
when the loading has ended.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.planning import dubins
from wlplan.planning.dubins import WORDS, Curve, curve_between
from wlplan.planning.yard import (
    DISCS,
    Depths,
    Yard,
    depth_at,
    depth_near,
    depths,
    disc_radius,
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
_STRAIGHT = (0.0, 2.0, 4.0, 7.0, 11.0, 16.0)
_ARC = (0.0, 15.0, 30.0, 45.0, 65.0, 90.0, 120.0)
_TWICE = ((30.0, 60.0, 90.0), (0.0, 4.0), (0.0, 40.0, 80.0, 120.0))
# The best cusps are shifted, each to so many places, by at most so much [m] and turned by at most
# so much [rad], in one round after the other. A part of the fans is as large as a round.
_BEST, _SHIFTS = 9, 12
_ROUNDS = ((2.0, 0.45), (1.3, 0.3), (0.8, 0.18), (0.45, 0.1), (0.2, 0.05))
_QUICK = ((0.8, 0.18),)
# Places on each arc, and on the line between, where the loader is looked at. As it is a row of
# discs, they leave no gap on a line of 20 m; on an arc its corners swing out between them.
_ON_ARC, _ON_LINE = 6, 4
# Metres of way that one metre in the middle of an obstacle is worth: no way around is longer, also
# where a corner is only grazed.
_DETOUR = 100.0
# The lane is looked at in steps of this length [m]: ridges of a cell or two are left in it. Soil
# begins to count this much below what can be driven over, and the truck so far away [m].
_LANE_STEP, _SOIL_RAMP, _TRUCK_RAMP = 0.2, 0.05, 0.1
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
    start, goal = _ends(pose, receiver, machine)
    last = _ways(_placed(cusps, start, goal), start, goal, room, machine, _depth)
    cost = last.length + _DETOUR * last.touching
    weight = jax.nn.softmax(-cost / _BLEND)
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(cost)], last)
    return (weight * last.length).sum(), (weight * last.touching).sum(), best


def cusps_to(
    pose: Pose, receiver: Receiver, room: Room, machine: WheelLoader, *, thorough: bool = True
) -> Cusps:
    """The cusps of the best ways, which is what takes time; without derivatives.

    Arguments as of `way_to`.
    """
    search = _searcher(machine, thorough, jax.default_backend() == "cpu")
    found = search(*_ends(pose, receiver, machine), room)
    best: Cusps = jax.tree.map(lambda leaf: leaf[:_BLENDED], found)
    return best


def open_length(pose: Pose, receiver: Receiver, machine: WheelLoader) -> Float[Array, ""]:
    """Length of the way, were nothing in it, to half a metre [m]; arguments as of `way_to`."""
    start, goal = _ends(pose, receiver, machine)
    fans, known = _fans(machine.turning_radius, start[0].dtype)
    return (known + _lengths_on(fans, start, goal, machine.turning_radius)).min()


def _ends(pose: Pose, receiver: Receiver, machine: WheelLoader) -> tuple[_Place, _Place]:
    """Where the loading ended, and where the loader dumps."""
    back = machine.approach_distance
    x, y = pose.x - back * jnp.cos(pose.heading), pose.y - back * jnp.sin(pose.heading)
    return (x, y, pose.heading), (receiver.x, receiver.y, receiver.heading)


_Place = tuple[Array, Array, Array]
"""X [m], y [m] and heading [rad]."""


_Placed = tuple[Array, Array, Array, Array]
"""X [m], y [m], cosine and sine of the heading."""

_DepthOf = Callable[[_Placed, _Place, Room, WheelLoader], Array]


class Cusps(NamedTuple):
    """Cusps of ways, the best first, in the frame of one of the ends, so that they move with it."""

    local: Float[Array, "k 3"]  # x, y, heading
    at_start: Bool[Array, " k"]  # or else at the receiver


def _placed(cusps: Cusps, start: _Place, goal: _Place) -> _Place:
    """Cusps in the frame of the pile."""
    x, y, heading = (jnp.where(cusps.at_start, a, b) for a, b in zip(start, goal, strict=True))
    c, s = jnp.cos(heading), jnp.sin(heading)
    ahead, left, turn = cusps.local.T
    return x + c * ahead - s * left, y + s * ahead + c * left, heading + turn


@functools.cache
def _searcher(
    machine: WheelLoader, thorough: bool, one_by_one: bool
) -> Callable[[_Place, _Place, Room], Cusps]:
    """`search(start, goal, room)`: the best cusps, the very best first; without derivatives.

    Args:
        machine: What drives.
        thorough: Whether the best are shifted in all rounds, or only in one.
        one_by_one: Whether the members of a batch are searched for one after the other: each stops
            where it may, and a CPU gains nothing from a batch.
    """
    size, radius = _BEST * _SHIFTS, machine.turning_radius
    count = 2 * len(_fan(radius)[0])
    parts = count // size
    assert parts * size == count, "a part of the fans is as large as a round"
    scales = _ROUNDS if thorough else _QUICK
    rounds = _halton(len(scales) * size).reshape(-1, size, 3)
    rounds *= np.array([(far, far, turn) for far, turn in scales])[:, None]

    def search(start: _Place, goal: _Place, room: Room) -> Cusps:
        dtype = start[0].dtype
        shifts = jnp.asarray(rounds, dtype)
        fans, known = _fans(radius, dtype)
        # Those with the shortest ways come first: once one that is clear is shorter than all that
        # are left, they need no look.
        length = known + _lengths_on(fans, start, goal, radius)
        order = jnp.argsort(length)
        fans = jax.tree.map(lambda leaf: leaf[order].reshape(parts, size, *leaf.shape[1:]), fans)
        least = length[order][::size]

        def of_fan(state: _Search) -> Array:
            part = jnp.minimum(state.part, parts - 1)
            return (state.part < parts) & (state.costs[0] > least[part])

        def unfinished(state: _Search) -> Array:
            return of_fan(state) | (state.round < len(scales))

        def step(state: _Search) -> _Search:
            more, best = of_fan(state), state.best
            part = jnp.minimum(state.part, parts - 1)
            shift = shifts[jnp.minimum(state.round, len(scales) - 1)]
            around = jnp.repeat(best.local, _SHIFTS, axis=0) + shift
            tried = Cusps(
                jnp.where(more, fans.local[part], around),
                jnp.where(more, fans.at_start[part], jnp.repeat(best.at_start, _SHIFTS)),
            )
            ways = _ways(_placed(tried, start, goal), start, goal, room, machine, _depth_near)
            costs = jnp.concatenate([state.costs, ways.length + _DETOUR * ways.touching])
            both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), best, tried)
            _, rows = lax.top_k(-costs, _BEST)
            one = more.astype(jnp.int32)
            return _Search(
                jax.tree.map(lambda leaf: leaf[rows], both),
                costs[rows],
                state.part + one,
                state.round + 1 - one,
            )

        none = Cusps(jnp.zeros((_BEST, 3), dtype), jnp.zeros(_BEST, bool))
        zero = jnp.zeros((), jnp.int32)
        begin = _Search(none, jnp.full(_BEST, jnp.inf, dtype), zero, zero)
        return lax.while_loop(unfinished, step, begin).best

    if one_by_one:
        search = jax.custom_batching.sequential_vmap(search)

    @jax.custom_jvp
    def constant(start: _Place, goal: _Place, room: Room) -> Cusps:
        return search(start, goal, room)

    @constant.defjvp
    def _(primals: tuple[_Place, _Place, Room], _: Any) -> tuple[Cusps, Cusps]:
        found = constant(*primals)
        none: Any = np.zeros(found.at_start.shape, jax.dtypes.float0)
        return found, Cusps(jnp.zeros_like(found.local), none)

    return constant


class _Search(NamedTuple):
    """The state of a search."""

    best: Cusps
    costs: Array  # of these, the least first
    part: Array  # of the fans that comes next
    round: Array  # that comes next


def _fans(radius: float, dtype: Any) -> tuple[Cusps, Array]:
    """The cusps of both fans, and the lengths of the ways back to the ends they belong to [m]."""
    fan, lengths = _fan(radius)
    at_start = jnp.asarray(np.arange(2 * len(fan)) < len(fan))
    cusps = Cusps(jnp.asarray(np.tile(fan, (2, 1)), dtype), at_start)
    return cusps, jnp.asarray(np.tile(lengths, 2), dtype)


def _lengths_on(fans: Cusps, start: _Place, goal: _Place, radius: float) -> Array:
    """Lengths of the shortest curves from the cusps of fans to the other ends [m]."""
    ends = (jnp.where(fans.at_start, b, a)[None] for a, b in zip(start, goal, strict=True))
    x1, y1, heading1 = ends
    x0, y0, heading0 = (leaf[None] for leaf in _placed(fans, start, goal))
    words = jnp.asarray(WORDS, x0.dtype).reshape(len(WORDS), 1, 2)
    curves, exists = curve_between((x0, y0, heading0), (x1, y1, heading1), words, radius)
    return jnp.where(exists, dubins.length_of(curves, radius), jnp.inf).min(axis=0)


@functools.cache
def _fan(radius: float) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """The cusps that are tried first, in the frame of an end, and the ways from there to it [m]."""
    straight, arc = np.meshgrid(_STRAIGHT, np.radians(_either_way(_ARC)), indexing="ij")
    first, middle, last = (
        axis.ravel()
        for axis in np.meshgrid(
            np.radians(_either_way(_TWICE[0])),
            _TWICE[1],
            np.radians(_either_way(_TWICE[2])),
            indexing="ij",
        )
    )
    straight = np.concatenate([straight.ravel(), middle])
    last = np.concatenate([arc.ravel(), last])
    first = np.concatenate([np.zeros(arc.size), first])
    none = np.zeros(first.size)
    turned = _reverse((none, none, none), none, first, radius)
    cusps = np.stack(_reverse(turned, straight, last, radius), axis=-1)
    return cusps, straight + radius * (np.abs(first) + np.abs(last))


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


def _ways(
    cusps: _Place,
    start: _Place,
    goal: _Place,
    room: Room,
    machine: WheelLoader,
    depth_of: _DepthOf,
) -> Way:
    """The shortest way by way of each cusp, and what it touches."""
    radius = machine.turning_radius
    shared = room.yard.origin[0]
    x0, y0, heading0 = (leaf[None] for leaf in cusps)
    x1, y1, heading1 = (jnp.stack(pair)[:, None] for pair in zip(start, goal, strict=True))
    both = materialize(_shortest((x0, y0, heading0), (x1, y1, heading1), radius), shared)
    touching = jnp.zeros_like(cusps[0])
    for looks in _looks(both, radius, shared):
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


def _depth_near(place: _Placed, goal: _Place, room: Room, machine: WheelLoader) -> Array:
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


def _depth(place: _Placed, goal: _Place, room: Room, machine: WheelLoader) -> Array:
    """`_depth_near`, but smooth in the place and the goal."""
    x, y, c, s = (leaf[None] for leaf in place)
    ahead, at_truck = (
        jnp.asarray(row, x.dtype).reshape(-1, *[1] * (x.ndim - 1))
        for row in zip(*_discs(machine), strict=True)
    )
    depth = depth_at(room.field, x + ahead * c, y + ahead * s)
    truck = x + at_truck * c, y + at_truck * s
    depth += _depth_in_truck(*truck, goal, room.yard.reach, machine)
    return depth.sum(axis=0)


def _shortest(start: _Place, end: _Place, radius: float) -> Curve:
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


def _looks(curve: Curve, radius: float, shared: Array) -> Iterator[_Looks]:
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
    columns = max(round(machine.bucket_width / _LANE_STEP), 1) + 1
    along = jnp.asarray(first + (last - first) * (np.arange(rows) + 0.5) / rows, dtype)
    # From edge to edge, and a little further.
    left = (machine.bucket_width + _SOIL_RAMP) * np.linspace(-0.5, 0.5, columns)
    x, y = to_world(pose, *jnp.meshgrid(along, jnp.asarray(left, dtype), indexing="ij"))
    over = sample(pile.height - pile.floor, pile, x, y) - (CLEARED - _SOIL_RAMP)
    soil = jnp.clip(over / _SOIL_RAMP, 0.0, 1.0)
    goal = receiver.x, receiver.y, receiver.heading
    truck = jnp.clip(1.0 - _truck_distance(x, y, goal, machine) / _TRUCK_RAMP, 0.0, 1.0)
    most = jnp.maximum(jnp.maximum(soil, truck), is_standing(yard, x, y)).max(axis=1)
    return most.sum() * (last - first) / rows


def unseen_along(way: Way, yard: Yard, radius: float) -> Float[Array, ""]:
    """Length of one way over ground that the scan did not see [m]."""
    total = jnp.zeros((), way.length.dtype)
    for curve in (way.out, way.up):
        for x, y, _, _, weight in _looks(curve, radius, yard.origin[0]):
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
