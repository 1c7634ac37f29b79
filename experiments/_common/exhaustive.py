"""The shortest clear way of one cusp by looking at all of them, to hold `wlplan.planning.way` to.

Nothing here is shared with it but the formula of a single Dubins curve. What the loader must not
touch is grown by its outline, once for each heading, so that it is a look into a table whether the
loader can stand at a place.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.planning.dubins import WORDS, Curve, arc, curve_between, length_of
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import truck_outline

CELL = 0.2
"""Of the tables [m]."""

_HEADINGS = 120
# Places looked at on a curve, whatever its length.
_LOOKS = 128
# Cusps whose curves are looked at together.
_BATCH = 4096
# The raster of cusps: its distance [m], headings, and how far around the two ends it reaches [m].
_RASTER, _TURNS, _AROUND = 0.6, 40, 16.0
# Straight [m] and around an arc [rad] from either end: the cusps of the shortest ways.
_STRAIGHT, _ARC = np.arange(0.0, 16.1, 0.4), np.radians(np.arange(-150.0, 150.1, 3.0))
# Around an arc, straight and around another arc.
_FIRST = np.radians(np.arange(-120.0, 120.1, 15.0))
_MIDDLE = np.arange(0.0, 10.1, 1.0)
_LAST = np.radians(np.arange(-120.0, 120.1, 12.0))
# The best cusps are shifted at random by less and less [m, rad].
_BEST, _SHIFTS, _SCALES = 64, 64, ((0.4, 0.15), (0.15, 0.05), (0.05, 0.02))

Place = tuple[float, float, float]
"""X [m], y [m] and heading [rad]."""


class Table(NamedTuple):
    """Where the middle of the loader cannot be."""

    blocked: Bool[Array, "headings n m"]
    corner: Float[Array, "2"]  # middle of cell [0, 0] [m]


def table(
    cells: Float[np.ndarray, "k 2"], goal: Place, machine: WheelLoader, margin: float, side: float
) -> Table:
    """The table of a scene.

    Args:
        cells: Places that must not be touched [m].
        goal: Where the loader dumps: its truck must not be touched either.
        machine: Whose outline it is.
        margin: By how much the outline is larger, on all sides [m].
        side: Of the square around the origin that is looked at [m]; around it all is free.
    """
    count = math.ceil(side / CELL) + 1
    corner = -0.5 * CELL * (count - 1)
    near, far, half = truck_outline(machine)
    spread = np.meshgrid(
        np.arange(near, far + 0.05, 0.1), np.arange(-half, half + 0.05, 0.1), indexing="ij"
    )
    ahead, left = (axis.ravel() for axis in spread)
    c, s = math.cos(goal[2]), math.sin(goal[2])
    truck = np.stack([goal[0] + ahead * c - left * s, goal[1] + ahead * s + left * c], axis=-1)
    blocked = np.zeros((2, count, count), np.float32)
    for layer, places in enumerate((cells, truck)):
        index = np.rint((places - corner) / CELL).astype(int)
        index = index[((index >= 0) & (index < count)).all(axis=1)]
        blocked[layer, index[:, 0], index[:, 1]] = 1.0
    front = 0.5 * machine.length
    outlines = np.stack(
        [
            _outlines(count, -front, end, 0.5 * machine.bucket_width, margin)
            for end in (front, front - machine.overhang)
        ]
    )
    return Table(_grown(jnp.asarray(blocked), jnp.asarray(outlines)), jnp.full(2, corner))


@functools.cache
def _outlines(
    count: int, rear: float, front: float, side: float, margin: float
) -> Float[np.ndarray, "headings size size"]:
    """Cells of the outline around the middle of a square, mirrored, at each heading."""
    size = count + 2 * math.ceil((max(-rear, front) + side + margin) / CELL)
    axis = CELL * (np.arange(size) - size // 2)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    layers = []
    for turn in 2.0 * math.pi * np.arange(_HEADINGS) / _HEADINGS:
        c, s = math.cos(turn), math.sin(turn)
        ahead, left = -(c * x + s * y), s * x - c * y
        layers.append(
            (ahead > rear - margin) & (ahead < front + margin) & (abs(left) < side + margin)
        )
    return np.fft.ifftshift(np.array(layers, np.float32), axes=(1, 2))


@jax.jit
def _grown(
    blocked: Float[Array, "2 n n"], outlines: Float[Array, "2 headings size size"]
) -> Bool[Array, "headings n n"]:
    """Cells where an outline touches what is blocked."""
    count, size = blocked.shape[-1], outlines.shape[-1]
    signal = jnp.fft.rfft2(blocked, (size, size))

    def one(shape: Float[Array, "2 size size"]) -> Bool[Array, "n n"]:
        touched = jnp.fft.irfft2(signal * jnp.fft.rfft2(shape), (size, size))
        return (touched[:, :count, :count] > 0.5).any(axis=0)

    grown: Array = lax.map(one, outlines.transpose(1, 0, 2, 3))
    return grown


def shortest(start: Place, goal: Place, where: Table, radius: float, bound: float) -> float:
    """Length of the shortest clear way of one cusp that is found [m]; infinite if there is none.

    Args:
        start: Where the loading ended.
        goal: Where the loader dumps.
        where: Table of the scene.
        radius: Of the arcs [m].
        bound: Longer ways are not looked at [m].
    """
    ends = tuple(jnp.asarray(end, jnp.float32) for end in (start, goal))
    cusps = np.concatenate([_raster(start, goal), _fans(start, radius), _fans(goal, radius)])
    best, lengths = _look(cusps, ends, where, radius, bound)
    random = np.random.default_rng(1)
    for scale, turn in _SCALES:
        if not np.isfinite(lengths).any():
            break
        rows = np.argsort(lengths)[:_BEST]
        around = best[rows, None] + random.uniform(-1.0, 1.0, (len(rows), _SHIFTS, 3)) * np.array(
            [scale, scale, turn]
        )
        tried = np.concatenate([best[rows], around.reshape(-1, 3)])
        best, lengths = _look(tried, ends, where, radius, bound)
    return float(lengths.min(initial=np.inf))


def _look(
    cusps: Float[np.ndarray, "k 3"],
    ends: tuple[Array, ...],
    where: Table,
    radius: float,
    bound: float,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Cusps that can be on a way short enough, and the lengths of their shortest clear ways [m]."""
    kept = []
    for part in _batches(cusps):
        least = np.asarray(_least(jnp.asarray(part), *ends, radius))
        kept.append(part[least <= bound])
    cusps = np.concatenate(kept)
    if not len(cusps):
        return cusps, np.zeros(0)
    lengths = [np.asarray(_clear(jnp.asarray(p), *ends, where, radius)) for p in _batches(cusps)]
    found = np.concatenate(lengths)[: len(cusps)].astype(float)
    return cusps, np.where(found <= bound, found, np.inf)


def _batches(cusps: Float[np.ndarray, "k 3"]) -> list[Float[np.ndarray, "batch 3"]]:
    rows = np.minimum(np.arange(-(-len(cusps) // _BATCH) * _BATCH), len(cusps) - 1)
    return [cusps[part].astype(np.float32) for part in rows.reshape(-1, _BATCH)]


def _curves(cusps: Array, end: Array, radius: float) -> tuple[Curve, Array]:
    """The curve of each word from each cusp, and its length, infinite where there is none."""
    x, y, heading = (leaf[:, None] for leaf in cusps.T)
    words = jnp.asarray(WORDS, cusps.dtype)[None]
    curves, exists = curve_between((x, y, heading), tuple(end), words, radius)
    return curves, jnp.where(exists, length_of(curves, radius), jnp.inf)


@functools.partial(jax.jit, static_argnames="radius")
def _least(cusps: Array, start: Array, goal: Array, radius: float) -> Array:
    """Length of the shortest way by each cusp [m], clear or not."""
    lengths = [_curves(cusps, end, radius)[1].min(axis=1) for end in (start, goal)]
    return lengths[0] + lengths[1]


@functools.partial(jax.jit, static_argnames="radius")
def _clear(cusps: Array, start: Array, goal: Array, where: Table, radius: float) -> Array:
    """Length of the shortest clear way by each cusp [m]."""
    total = jnp.zeros(len(cusps), cusps.dtype)
    for end in (start, goal):
        curves, lengths = _curves(cusps, end, radius)
        part = jnp.arange(_LOOKS, dtype=cusps.dtype) / (_LOOKS - 1)

        def touches(number: Array, curves: Curve = curves, part: Array = part) -> Array:
            curve = jax.tree.map(
                lambda leaf: jnp.broadcast_to(leaf, (len(cusps), len(WORDS)))[:, number, None],
                curves,
            )
            at = part[None] * length_of(curve, radius)
            turn = jnp.abs(curve.first) * radius
            place = arc(
                curve.x,
                curve.y,
                curve.heading,
                jnp.sign(curve.first) * jnp.minimum(at, turn) / radius,
                radius,
            )
            line = jnp.clip(at - turn, 0.0, curve.straight)
            x, y = place[0] + line * jnp.cos(place[2]), place[1] + line * jnp.sin(place[2])
            rest = jnp.maximum(at - turn - curve.straight, 0.0) / radius
            x, y, heading = arc(x, y, place[2], jnp.sign(curve.last) * rest, radius)
            return _stands_in(x, y, heading, where).any(axis=1)

        hit = lax.map(touches, jnp.arange(len(WORDS))).T
        total = total + jnp.where(hit, jnp.inf, lengths).min(axis=1)
    return total


def _stands_in(x: Array, y: Array, heading: Array, where: Table) -> Array:
    count = where.blocked.shape[-1]
    turn = jnp.rint(heading * (_HEADINGS / (2.0 * math.pi))).astype(jnp.int32) % _HEADINGS
    i = jnp.rint((x - where.corner[0]) / CELL).astype(jnp.int32)
    j = jnp.rint((y - where.corner[1]) / CELL).astype(jnp.int32)
    inside = (i >= 0) & (j >= 0) & (i < count) & (j < count)
    flat = (turn * count + jnp.clip(i, 0, count - 1)) * count + jnp.clip(j, 0, count - 1)
    return inside & where.blocked.reshape(-1)[flat]


def can_stand(place: Place, where: Table) -> bool:
    """Whether the loader can be at a place."""
    x, y, heading = (jnp.asarray(value, jnp.float32) for value in place)
    return not bool(_stands_in(x, y, heading, where))


def _raster(start: Place, goal: Place) -> Float[np.ndarray, "k 3"]:
    """Cusps at even distances around both ends."""
    ends = np.array([start[:2], goal[:2]])
    low, high = ends.min(axis=0) - _AROUND, ends.max(axis=0) + _AROUND
    axes = [np.arange(a, b, _RASTER) for a, b in zip(low, high, strict=True)]
    turns = 2.0 * math.pi * np.arange(_TURNS) / _TURNS
    return np.stack([a.ravel() for a in np.meshgrid(*axes, turns, indexing="ij")], axis=-1)


def _fans(end: Place, radius: float) -> Float[np.ndarray, "k 3"]:
    """Cusps by arcs and straight lines in reverse from an end."""
    single = np.meshgrid([0.0], _STRAIGHT, _ARC, indexing="ij")
    double = np.meshgrid(_FIRST, _MIDDLE, _LAST, indexing="ij")
    first, straight, last = (
        np.concatenate([a.ravel(), b.ravel()]) for a, b in zip(single, double, strict=True)
    )
    place = tuple(np.full(first.shape, value) for value in end)
    x, y, heading = _back(place, first, radius)
    x, y = x - straight * np.cos(heading), y - straight * np.sin(heading)
    return np.stack(_back((x, y, heading), last, radius), axis=-1)


def _back(
    place: tuple[np.ndarray, ...], turn: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reverse along an arc that turns the heading."""
    x, y, heading = place
    chord, middle = 2.0 * radius * np.sin(np.abs(0.5 * turn)), heading + 0.5 * turn
    return x - chord * np.cos(middle), y - chord * np.sin(middle), heading + turn
