"""How steep a surface is, and which of its cells can slide."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from wlplan.terrain.automaton.neighbours import BITS, NEIGHBOURS, links_of, neighbour, rim
from wlplan.types import Pile


def rises(height: Array, active: Array | None) -> Iterator[Array]:
    """Height differences to half of the neighbours over their distance in cells."""
    around, links = rim(height), None if active is None else links_of(active)
    for (i, j), bit in tuple(zip(NEIGHBOURS, BITS, strict=True))[4:]:
        rise = jnp.abs(height - neighbour(around, i, j)) / math.hypot(i, j)
        # The mirrored border repeats a straight difference at a diagonal distance: no maximum.
        yield rise if links is None else jnp.where(links & bit != 0, rise, 0.0)


def steeper_than(limit: float, height: Array, active: Array | None) -> Bool[Array, ""]:
    """Whether some height difference over its distance in cells is more than a limit [m]."""
    steep = functools.reduce(jnp.logical_or, (r > limit for r in rises(height, active)))
    # XLA's sums are many times faster on a CPU than its `any` and `max`.
    return jnp.where(steep, 1.0, 0.0).sum() > 0.0


def steepest_slope(pile: Pile, active: Bool[Array, "nx ny"] | None = None) -> Float[Array, ""]:
    """Steepest slope between any two neighbouring cells of a pile [rad].

    Args:
        pile: One pile.
        active: Cells that count; by default all that were seen.
    """
    which = pile.valid if active is None else active
    steepest = functools.reduce(jnp.maximum, rises(pile.height, which)).max()
    return jnp.arctan(steepest / pile.cell_size)


def movable(pile: Pile, repose_angle: float) -> Bool[Array, "nx ny"] | None:
    """Cells that were seen and whose floor is not too steep for soil to lie on; None: all."""
    if pile.ground is None:
        return pile.valid
    drop = pile.cell_size * math.tan(repose_angle)
    around = rim(pile.ground)
    active = jnp.ones(pile.height.shape, bool) if pile.valid is None else pile.valid
    for i, j in NEIGHBOURS:
        step = jnp.abs(pile.ground - neighbour(around, i, j))
        active = active & (step <= drop * math.hypot(i, j))
    return active
