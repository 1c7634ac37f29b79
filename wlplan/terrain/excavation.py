"""Removing a load from the pile along the bucket's strip, mass exact.

The paper removes the predicted volume "along a strip as wide as the bucket, starting at x and
stretching along t" (section 4.6) and does not say how it is spread. Here the cut follows a bucket:
level on the floor to some penetration, then rising at a fixed angle; the penetration is solved for
so that the volume is met. The edges of the strip are soft over one cell, so the result is
differentiable in the pose and in the volume.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from wlplan.terrain.heightmap import cell_centres, take, to_local
from wlplan.types import Pile, Pose

PENETRATION = "penetration"
"""Name of the result that takes long to find and a number to keep, for `jax.checkpoint`."""

# How steeply the cut rises behind the penetration. Estimate: buckets leave the floor and curl up
# about so; the automaton evens out the rest.
_RISE = math.tan(math.radians(45.0))
# The strip ends here [m]: the largest penetration, 3.2 m (paper, section 5.2), and the rise of a
# bucket that breaks out.
STRIP_LENGTH = 4.5
# Bisection down to 4 micrometres: further off, a thin layer may have no edge to find the rate at.
_BISECTIONS, _NEWTON_STEPS = 20, 1


class Strip(NamedTuple):
    """The strip in front of a dig pose, on the cells of a pile."""

    weight: Float[Array, "nx ny"]  # part of each cell inside the strip [1]
    above: Float[Array, "nx ny"]  # soil above the floor, none in unseen cells [m]
    along: Float[Array, "nx ny"]  # position along the heading [m]


def strip_of(pile: Pile, pose: Pose, *, width: float) -> Strip:
    """The strip as wide as the bucket that starts at a dig pose.

    Args:
        pile: The pile, or a window of it.
        pose: Dig location and heading.
        width: Width of the bucket [m].
    """
    cell = pile.cell_size
    along, left = to_local(pose, *cell_centres(pile))
    weight = (
        jnp.clip((width / 2 - jnp.abs(left)) / cell + 0.5, 0.0, 1.0)
        * jnp.clip(along / cell + 0.5, 0.0, 1.0)
        * jnp.clip((STRIP_LENGTH - along) / cell + 0.5, 0.0, 1.0)
    )
    above = jnp.maximum(pile.height - pile.floor, 0.0)
    if pile.valid is not None:
        above = jnp.where(pile.valid, above, 0.0)
    return Strip(weight, above, along)


class Excavation(NamedTuple):
    """A pile that a volume was taken out of, and how that ended."""

    pile: Pile  # not relaxed
    volume: Float[Array, ""]  # what was asked for, or all that the strip holds [m^3]
    missing: Float[Array, ""]  # what of it could not be found; rounding if it converged [m^3]


def excavate(pile: Pile, pose: Pose, volume: Float[Array, ""], *, width: float) -> Excavation:
    """Takes a volume out of the strip in front of a dig pose.

    Args:
        pile: The pile, or a window of it.
        pose: Dig location and heading.
        volume: Volume to take [m^3].
        width: Width of the bucket [m].

    Returns:
        The pile afterwards (not relaxed), the volume that was taken, `volume` or less if the
        strip does not hold that much, and how well the solution meets it.
    """
    cell_area = pile.cell_size**2
    strip = strip_of(pile, pose, width=width)
    wanted = jnp.minimum(volume / cell_area, (strip.weight * strip.above).sum())

    def cut(penetration: Array, strip: Strip) -> Array:
        rise = _RISE * jnp.maximum(strip.along - penetration, 0.0)
        return strip.weight * jnp.maximum(strip.above - rise, 0.0)

    frozen = lax.stop_gradient(strip)
    goal = lax.stop_gradient(wanted)

    def bisect(_: Array, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        short = cut(middle, frozen).sum() < goal
        return jnp.where(short, middle, low), jnp.where(short, high, middle)

    # The soft end of the strip reaches half a cell further; there, all that is held can be cut.
    deepest = jnp.full_like(goal, STRIP_LENGTH + pile.cell_size)
    shallowest = -jnp.maximum(frozen.above.max() / _RISE, pile.cell_size)
    low, high = lax.fori_loop(0, _BISECTIONS, bisect, (shallowest, deepest))

    def newton(penetration: Array, strip: Strip, wanted: Array) -> Array:
        _, rate = jax.jvp(
            lambda p: cut(p, frozen).sum(),
            (lax.stop_gradient(penetration),),
            (jnp.ones_like(goal),),
        )
        missing = wanted - cut(penetration, strip).sum()
        step = jnp.where(rate > 0.0, missing / jnp.where(rate > 0.0, rate, 1.0), 0.0)
        return jnp.clip(penetration + step, shallowest, deepest)

    # Converge on constants, then one differentiable step from there: the implicit gradient.
    penetration = lax.fori_loop(
        0, _NEWTON_STEPS, lambda _, p: newton(p, frozen, goal), (low + high) / 2
    )
    penetration = checkpoint_name(penetration, PENETRATION)
    penetration = newton(penetration, strip, wanted)
    # What rounding leaves over is met by scaling the cut.
    removed = take(cut(penetration, strip), strip.weight * strip.above, wanted)
    missing = lax.stop_gradient(wanted - removed.sum()) * cell_area
    return Excavation(pile.replace(height=pile.height - removed), wanted * cell_area, missing)
