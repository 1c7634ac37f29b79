"""The search of a cusp: fans from both ends, and shifts of the best.

A fan of cusps is tried: reverse straight and then along an arc, or around two arcs, from the end of
the loading and likewise from the receiver. The best are shifted, by less and less.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from wlplan.planning import dubins
from wlplan.planning.driving import Place, Room, rough_depth, ways_by
from wlplan.planning.dubins import WORDS, curve_between
from wlplan.site.machine import WheelLoader

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
DETOUR = 100.0
"""Metres of way that one metre in the middle of an obstacle is worth: no way around is longer, also
where a corner is only grazed."""


class Cusps(NamedTuple):
    """Cusps of ways, the best first, in the frame of one of the ends, so that they move with it."""

    local: Float[Array, "k 3"]  # x, y, heading
    at_start: Bool[Array, " k"]  # or else at the receiver


def placed(cusps: Cusps, start: Place, goal: Place) -> Place:
    """Cusps in the frame of the pile."""
    x, y, heading = (jnp.where(cusps.at_start, a, b) for a, b in zip(start, goal, strict=True))
    c, s = jnp.cos(heading), jnp.sin(heading)
    ahead, left, turn = cusps.local.T
    return x + c * ahead - s * left, y + s * ahead + c * left, heading + turn


@functools.cache
def searcher(
    machine: WheelLoader, thorough: bool, one_by_one: bool
) -> Callable[[Place, Place, Room], Cusps]:
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
    rounds = _spread(len(scales) * size).reshape(-1, size, 3)
    rounds *= np.array([(far, far, turn) for far, turn in scales])[:, None]

    def search(start: Place, goal: Place, room: Room) -> Cusps:
        dtype = start[0].dtype
        shifts = jnp.asarray(rounds, dtype)
        fans, known = fans_of(radius, dtype)
        # Those with the shortest ways come first: once one that is clear is shorter than all that
        # are left, they need no look.
        length = known + open_lengths(fans, start, goal, radius)
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
            ways = ways_by(placed(tried, start, goal), start, goal, room, machine, rough_depth)
            costs = jnp.concatenate([state.costs, ways.length + DETOUR * ways.touching])
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
    def constant(start: Place, goal: Place, room: Room) -> Cusps:
        return search(start, goal, room)

    @constant.defjvp
    def _(primals: tuple[Place, Place, Room], _: Any) -> tuple[Cusps, Cusps]:
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


def fans_of(radius: float, dtype: Any) -> tuple[Cusps, Array]:
    """The cusps of both fans, and the lengths of the ways back to the ends they belong to [m]."""
    fan, lengths = _fan(radius)
    at_start = jnp.asarray(np.arange(2 * len(fan)) < len(fan))
    cusps = Cusps(jnp.asarray(np.tile(fan, (2, 1)), dtype), at_start)
    return cusps, jnp.asarray(np.tile(lengths, 2), dtype)


def open_lengths(fans: Cusps, start: Place, goal: Place, radius: float) -> Array:
    """Lengths of the shortest curves from the cusps of fans to the other ends [m]."""
    ends = (jnp.where(fans.at_start, b, a)[None] for a, b in zip(start, goal, strict=True))
    x1, y1, heading1 = ends
    x0, y0, heading0 = (leaf[None] for leaf in placed(fans, start, goal))
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


_Reached = tuple[np.ndarray, np.ndarray, np.ndarray]


def _reverse(place: _Reached, straight: np.ndarray, turn: np.ndarray, radius: float) -> _Reached:
    """Where one is after reversing straight [m] and then along an arc that turns the heading."""
    x, y, heading = place
    x, y = x - straight * np.cos(heading), y - straight * np.sin(heading)
    chord, middle = 2.0 * radius * np.sin(np.abs(0.5 * turn)), heading + 0.5 * turn
    return x - chord * np.cos(middle), y - chord * np.sin(middle), heading + turn


def _spread(count: int) -> Float[np.ndarray, "count 3"]:
    """Places spread evenly in a cube from -1 to 1."""
    # Scipy has the sequence of Halton too, and takes a second of the first plan to import.
    numbers = np.arange(1, count + 1)
    return 2.0 * np.stack([_mirrored(numbers, base) for base in (2, 3, 5)], axis=-1) - 1.0


def _mirrored(numbers: Int[np.ndarray, " n"], base: int) -> Float[np.ndarray, " n"]:
    """Numbers with their digits mirrored at the point (van der Corput)."""
    found, worth = np.zeros(len(numbers)), 1.0
    while numbers.any():
        worth /= base
        found += worth * (numbers % base)
        numbers = numbers // base
    return found
