"""The toe to dig along under a trace: what `toe_contour` and `toe_of` do, for `jit` and `vmap`.

Positions along it begin somewhere else than on the host, and it has at most a fixed length; else it
is the same toe, which `tests/test_next_loads.py` checks.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from wlplan.planning.poses import Toe
from wlplan.site.machine import WheelLoader
from wlplan.terrain.heightmap import sample
from wlplan.terrain.outline_traced import outline_of_largest
from wlplan.terrain.standing import standing
from wlplan.terrain.toe import CONTOUR_SPACING, LANE_STEP, TOE_RISE
from wlplan.types import Pile

# Most points of a toe: 205 m, beyond which they are further apart.
_POINTS = 2048
# Slack for what float32 rounds, in cells.
_ROUNDING = 1e-3
# Smallest pile that is worth a bucket, by the length of its outline [m].
_SHORTEST = 3.0


def traced_toe(pile: Pile, machine: WheelLoader) -> tuple[Toe, Bool[Array, ""]]:
    """The accessible part of the toe of the largest pile, and whether there is any.

    Args:
        pile: The pile as it is; any leaf may be traced.
        machine: What digs.
    """
    cell, dtype = pile.cell_size, pile.height.dtype
    above = pile.height - pile.floor
    line = outline_of_largest(above, rise=TOE_RISE)
    x, y = (jnp.asarray(pile.origin[k], dtype) + cell * line.points[:, k] for k in (0, 1))
    steps = jnp.hypot(x[1:] - x[:-1], y[1:] - y[:-1])
    # Points that are repeated at the end lie at the end.
    marks = jnp.concatenate([jnp.zeros((1,), dtype), jnp.cumsum(steps)])
    length = cell * line.length
    count = jnp.clip(jnp.round(length / CONTOUR_SPACING), 8, _POINTS).astype(jnp.int32)
    index = jnp.arange(_POINTS)
    step = length / jnp.where(line.closed, count, count - 1)

    def along(distance: Float[Array, " n"]) -> Complex[Array, " n"]:
        inside = jnp.where(line.closed, distance % length, jnp.clip(distance, 0.0, length))
        return jnp.interp(inside, marks, x) + 1j * jnp.interp(inside, marks, y)

    at = jnp.minimum(index, count - 1) * step
    half = 0.5 * jnp.minimum(machine.bucket_width, 0.5 * length)
    chord = along(at + half) - along(at - half)
    # The pile is on the left.
    into = 1j * chord / jnp.maximum(jnp.abs(chord), 1e-9)
    place = along(at)
    accessible = (index < count) & _accessible(pile, above, place, into, machine)
    exists = line.exists & accessible.any() & (length > _SHORTEST)
    rows = _reachable(accessible, count, line.closed)
    place, into = place[rows.order], into[rows.order]
    toe = Toe(
        points=jnp.stack([place.real, place.imag], axis=-1),
        direction=jnp.stack([into.real, into.imag], axis=-1),
        count=jnp.maximum(rows.number, 1).astype(jnp.int32),
        closed=line.closed & (rows.number == count),
        width=machine.bucket_width,
    )
    return toe, exists


def _accessible(
    pile: Pile,
    above: Float[Array, "nx ny"],
    place: Complex[Array, " n"],
    into: Complex[Array, " n"],
    machine: WheelLoader,
) -> Bool[Array, " n"]:
    """Where a bucket can start, as `toe_contour` has it."""
    cell, (nx, ny) = pile.cell_size, pile.height.shape

    def cells(points: Complex[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        return (points.real - pile.origin[0]) / cell, (points.imag - pile.origin[1]) / cell

    def sampled(field: Array, points: Array) -> Array:
        return sample(field.astype(above.dtype), pile, points.real, points.imag)

    free = sampled(above, place + machine.bucket_depth * into) > TOE_RISE
    for side in (-0.5j, 0.5j):
        i, j = cells(place + side * machine.bucket_width * into)
        free &= (i >= -_ROUNDING) & (i <= nx - 1 + _ROUNDING)
        free &= (j >= -_ROUNDING) & (j <= ny - 1 + _ROUNDING)
    if pile.valid is not None:
        free &= sampled(jnp.asarray(pile.valid), place) > 1.0 - _ROUNDING
    if pile.ground is None:
        return free
    stands = standing(pile.ground, cell)
    rear = machine.approach_distance + 0.5 * machine.length
    steps = np.arange(-rear, 0.5 * machine.bucket_depth, LANE_STEP)
    across = machine.bucket_width * (np.arange(0.0, 1.01, 0.125) - 0.5)
    grid = jnp.asarray((steps[:, None] + 1j * across).ravel(), place.dtype)
    i, j = (
        jnp.round(v).astype(jnp.int32) for v in cells(place[:, None] + into[:, None] * grid[None])
    )
    inside = (i >= 0) & (j >= 0) & (i < nx) & (j < ny)
    flags = jnp.asarray(stands)[jnp.clip(i, 0, nx - 1), jnp.clip(j, 0, ny - 1)]
    return free & ~(inside & flags).any(axis=1)


class _Rows(NamedTuple):
    """Rows of a contour that are kept, in order; the last one is repeated to the fixed size."""

    order: Int[Array, " n"]
    number: Int[Array, ""]


def _reachable(accessible: Bool[Array, " n"], count: Array, closed: Array) -> _Rows:
    """The accessible rows; of a closed line with gaps from behind the longest gap on."""
    size = len(accessible)
    (rows,) = jnp.nonzero(accessible, size=size, fill_value=size)
    number = accessible.sum()
    own = jnp.arange(size)
    following = jnp.where(own + 1 < number, rows[(own + 1) % size], rows[0] + count)
    gaps = jnp.where(own < number, following - rows, -1)
    turned = closed & (number < count)
    first = jnp.where(turned, (gaps.argmax() + 1) % jnp.maximum(number, 1), 0)
    wrapped = (jnp.minimum(own, number - 1) + first) % jnp.maximum(number, 1)
    return _Rows(jnp.clip(rows[wrapped], 0, size - 1), number)
