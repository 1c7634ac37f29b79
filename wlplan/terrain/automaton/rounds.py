"""One round of relaxation: coarse to fine, with sweeps at every spacing."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from wlplan.terrain.automaton.flow import below, slide
from wlplan.terrain.automaton.neighbours import links_of


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How `settle` works: rounds of `sweeps[k]` sweeps at spacing 2^k, coarse to fine.

    The defaults are the quickest that were found for bucket loads, see docs/automaton.md.
    """

    sweeps: tuple[int, ...] = (6, 8, 12)
    # Part of the velocity that is kept from sweep to sweep.
    momentum: float = 0.95
    # How much steeper than the angle of repose the result may be [rad].
    tolerance: float = math.radians(1.0)
    # It gives up after this many rounds. Bucket loads take about four; 67 were seen on a slope
    # longer than the window.
    most_rounds: int = 100

    @property
    def block(self) -> int:
        """Cells that a side of the grid must be a multiple of."""
        return int(2 ** (len(self.sweeps) - 1))


DEFAULT_SCHEDULE = Schedule()


class Terrain(NamedTuple):
    """What limits the flow: the floor [m] (None: level 0) and the cells that take part (None: all).

    A cell whose floor is itself steeper than the angle of repose (a kerb, a wall) must not take
    part; among the others nothing then slides below the floor.
    """

    ground: Array | None
    active: Array | None


def _coarsen(field: Array) -> Array:
    # Strided slices: XLA's reduction over the same cells takes five times as long on a CPU.
    rows = field[::2] + field[1::2]
    return 0.25 * (rows[:, ::2] + rows[:, 1::2])


def _refine(field: Array) -> Array:
    """Bilinear interpolation to half the spacing, cell-centred; keeps the volume exactly."""
    for axis in (0, 1):
        widths = [(1, 1) if k == axis else (0, 0) for k in (0, 1)]
        around = jnp.pad(field, widths, mode="edge")
        n = field.shape[axis]
        low = 0.75 * field + 0.25 * lax.slice_in_dim(around, 0, n, axis=axis)
        high = 0.75 * field + 0.25 * lax.slice_in_dim(around, 2, n + 2, axis=axis)
        shape = list(field.shape)
        shape[axis] *= 2
        field = jnp.stack([low, high], axis=axis + 1).reshape(shape)
    return field


def _taps(field: Array, axis: int) -> tuple[Array, Array, Array, Array]:
    """The four cells along an axis that `_refine` shares a coarse cell out to, in order."""
    around = jnp.pad(field, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
    n = field.shape[axis]
    a, b, c, d = (lax.slice_in_dim(around, k, k + n - 1, 2, axis) for k in range(4))
    return a, b, c, d


def _repeat(field: Array) -> Array:
    """Each cell as two by two of half the spacing."""
    return jnp.repeat(jnp.repeat(field, 2, 0), 2, 1)


def _hand_down(change: Array, active: Array | None) -> Array:
    """A change of the coarser grid, shared out among the cells that take part.

    What `_refine` would give to one that takes no part goes to the coarse cell's own. All that a
    coarse cell reaches then touches it and exchanges soil with it, so nothing passes a wall.
    """
    if active is None:
        return _refine(change)
    given = active.astype(change.dtype)
    for axis in (0, 1):
        a, b, c, d = _taps(given, axis)
        given = 0.125 * (a + d) + 0.375 * (b + c)
    return jnp.where(active, _refine(change) + _repeat((1.0 - given) * change), 0.0)


def _hand_down_above(floor: Array, height: Array, change: Array, active: Array | None) -> Array:
    """`_hand_down`, but no cell gives more than lies on its floor.

    In each of its own cells a coarse cell can take the same share of what lies there, which is
    enough. It takes as much of its loss in the smooth way as the others leave it in all cells.
    """
    lies = jnp.maximum(height - floor, 0.0)
    if active is not None:
        lies = jnp.where(active, lies, 0.0)
    loss, on_average = jnp.maximum(-change, 0.0), _coarsen(lies)
    # The inner where keeps the gradients of both quotients finite.
    some = on_average > 0.0
    share = jnp.where(some, loss / jnp.where(some, on_average, 1.0), 0.0)
    left = lies * jnp.maximum(1.0 - _repeat(share), 0.0)
    wanted = _hand_down(loss, active)
    short = wanted > left
    smooth = jnp.where(short, left / jnp.where(short, wanted, 1.0), 1.0)
    for axis in (0, 1):
        smooth = functools.reduce(jnp.minimum, _taps(smooth, axis))
    own = 1.0 - smooth
    return _hand_down(change + own * loss, active) - lies * _repeat(own * share)


def _add_change(height: Array, change: Array, floor: Array, active: Array | None) -> Array:
    """Adds a change of the coarser grid, without digging below the floor."""
    after = height + _hand_down(change, active)

    # Seldom needed, so reverse mode keeps nothing of it.
    @jax.checkpoint
    def above(height: Array, change: Array) -> Array:
        return height + _hand_down_above(floor, height, change, active)

    too_low = below(after, jnp.minimum(floor, height))
    result: Array = lax.cond(too_low, lambda: above(height, change), lambda: after)
    return result


def one_round(
    height: Array, terrain: Terrain, drop: float, schedule: Schedule, level: int = 0
) -> Array:
    """A surface after one round: coarser levels first, then the sweeps of this one.

    Args:
        height: Surface; its sides are multiples of the schedule's block [m].
        terrain: What limits the flow.
        drop: Largest stable height difference between two cells that share a side [m].
        schedule: Sweeps of every level, and momentum.
        level: The spacing is 2^level of that of the pile.
    """
    ground, active = terrain
    floor = jnp.zeros_like(height) if ground is None else ground
    if level + 1 < len(schedule.sweeps):
        coarse = _coarsen(height)
        coarse_terrain = Terrain(
            None if ground is None else _coarsen(ground),
            # A coarse cell takes part when all of its cells do.
            None if active is None else _coarsen(active.astype(height.dtype)) == 1.0,
        )
        relaxed = one_round(coarse, coarse_terrain, 2.0 * drop, schedule, level + 1)
        height = _add_change(height, relaxed - coarse, floor, active)
    links = None if active is None else links_of(active)
    return slide(height, floor, links, drop, schedule.momentum, schedule.sweeps[level])
