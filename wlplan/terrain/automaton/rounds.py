"""One round of relaxation: coarse to fine, with sweeps at every spacing."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from wlplan.terrain.automaton.flow import slide
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


def _add_change(height: Array, change: Array, terrain: Terrain) -> Array:
    """Adds a change of zero net volume, without digging under the floor or moving unseen cells."""
    ground, active = terrain
    floor = jnp.zeros_like(height) if ground is None else ground
    loss = jnp.minimum(jnp.maximum(-change, 0.0), jnp.maximum(height - floor, 0.0))
    gain = jnp.maximum(change, 0.0)
    if active is not None:
        loss, gain = jnp.where(active, loss, 0.0), jnp.where(active, gain, 0.0)
    lost, gained = loss.sum(), gain.sum()
    # What may not be taken here is not delivered there. The inner where keeps the gradient of
    # the quotient finite when nothing moves.
    moves = (gained > 0.0) & (lost > 0.0)
    scale = jnp.where(moves, lost / jnp.where(moves, gained, 1.0), 0.0)
    return height - jnp.where(moves, loss, 0.0) + scale * gain


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
    if level + 1 < len(schedule.sweeps):
        coarse = _coarsen(height)
        coarse_terrain = Terrain(
            None if ground is None else _coarsen(ground),
            # A coarse cell takes part when all of its cells do.
            None if active is None else _coarsen(active.astype(height.dtype)) == 1.0,
        )
        relaxed = one_round(coarse, coarse_terrain, 2.0 * drop, schedule, level + 1)
        height = _add_change(height, _refine(relaxed - coarse), terrain)
    links = None if active is None else links_of(active)
    slid = slide(height, links, drop, schedule.momentum, schedule.sweeps[level])
    # A sweep stops at the floor; its momentum might not.
    return _add_change(height, slid - height, terrain) if schedule.momentum else slid
