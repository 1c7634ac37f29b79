"""Shortest ways forward for something that cannot turn on the spot: arc, straight line, arc.

L. E. Dubins, On curves of minimal length with a constraint on average curvature, 1957. Of his six
words the four with a straight line in the middle are here; the two of three arcs are for ends
closer than four radii, where a loader reverses further instead.
"""

from __future__ import annotations

import math
from typing import Any, no_type_check

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

WORDS = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
"""Which way the first and the last arc of each word turn: 1 left, -1 right."""

# An arc this much less than nothing is none, and not a full circle [rad]: rounding.
_NOTHING = 1e-4

# Circles whose centres are this part of their radius apart count as the same: rounding.
_SAME = 1e-3


@no_type_check
class Curve(struct.PyTreeNode):
    """An arc, a straight line and an arc, driven forward; leaves of any one shape."""

    x: Float[Array, "*n"]  # where it begins [m]
    y: Float[Array, "*n"]
    heading: Float[Array, "*n"]  # [rad]
    first: Float[Array, "*n"]  # turn of the first arc [rad], left positive
    straight: Float[Array, "*n"]  # [m]
    last: Float[Array, "*n"]  # turn of the last arc [rad], left positive


def curve_between(
    start: tuple[Array, Array, Array],
    end: tuple[Array, Array, Array],
    word: Float[Array, "*n 2"],
    radius: float,
) -> tuple[Curve, Array]:
    """The curve of a word, and whether there is one.

    Args:
        start: x [m], y [m] and heading [rad], of any shapes that broadcast.
        end: Likewise.
        word: A row of `WORDS` for each.
        radius: Of the arcs [m].

    Returns:
        The curve, and whether the word reaches the end; if not, the curve means nothing, but is
        finite, as are its derivatives.
    """
    (x0, y0, a0), (x1, y1, a1) = start, end
    s0, s1 = word[..., 0], word[..., 1]
    # From centre to centre of the two circles.
    dx = (x1 - radius * s1 * jnp.sin(a1)) - (x0 - radius * s0 * jnp.sin(a0))
    dy = (y1 + radius * s1 * jnp.cos(a1)) - (y0 + radius * s0 * jnp.cos(a0))
    squared = dx**2 + dy**2
    # Where the arcs turn opposite ways, the line crosses between the circles.
    crossing = 0.5 * (s0 - s1)
    left = squared - (2.0 * radius * crossing) ** 2
    # Circles that touch leave no line between them, but for rounding.
    exists = left >= -_SAME * radius**2
    # Two arcs of the same circle are one: the line between them has no direction.
    meets = squared < (_SAME * radius) ** 2
    straight = jnp.sqrt(jnp.where(left > 1e-12, left, 1e-12))
    # From the line between the centres to the one that is driven, as a product of complex numbers:
    # an arc tangent is what takes most of the time.
    turn = 2.0 * radius * crossing
    cosine = jnp.where(meets, jnp.cos(a0), dx * straight - dy * turn)
    sine = jnp.where(meets, jnp.sin(a0), dy * straight + dx * turn)
    line = jnp.arctan2(sine, cosine)
    first, last = s0 * _positive(s0 * (line - a0)), s1 * _positive(s1 * (a1 - line))
    return Curve(*jnp.broadcast_arrays(x0, y0, a0, first, straight, last)), exists


def _positive(angle: Array) -> Array:
    """An angle in [0, 2 pi), but for rounding."""
    turns = jnp.floor((angle + _NOTHING) / (2.0 * math.pi))
    return angle - 2.0 * math.pi * turns


def length_of(curve: Curve, radius: float) -> Array:
    """Length of curves [m]."""
    length: Array = radius * (jnp.abs(curve.first) + jnp.abs(curve.last)) + curve.straight
    return length


def arc(
    x: Array, y: Array, heading: Array, turn: Array, radius: float
) -> tuple[Array, Array, Array]:
    """The end of an arc driven forward: x [m], y [m] and heading [rad].

    Args:
        x: Where it begins [m].
        y: Likewise.
        heading: There [rad].
        turn: How far the heading turns [rad], left positive.
        radius: Of the arc [m].
    """
    # The chord, by the half angle: exact and smooth where the turn is small.
    half = 0.5 * turn
    chord = 2.0 * radius * jnp.sin(jnp.abs(half))
    middle = heading + half
    return x + chord * jnp.cos(middle), y + chord * jnp.sin(middle), heading + turn


def along(
    curve: Curve, distance: Float[np.ndarray, " n"], radius: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """X [m], y [m] and heading [rad] at distances from the start of one curve, by numpy.

    Args:
        curve: Leaves are numbers.
        distance: From its start [m].
        radius: Of its arcs [m].
    """

    def arc(x: Any, y: Any, heading: Any, turn: np.ndarray) -> tuple[Any, Any, Any]:
        chord, middle = 2.0 * radius * np.sin(np.abs(0.5 * turn)), heading + 0.5 * turn
        return x + chord * np.cos(middle), y + chord * np.sin(middle), heading + turn

    turn, line = abs(curve.first), curve.heading + curve.first
    on_first = np.sign(curve.first) * np.clip(distance / radius, 0.0, turn)
    on_line = np.clip(distance - radius * turn, 0.0, curve.straight)
    on_last = np.maximum(distance - radius * turn - curve.straight, 0.0) / radius
    x, y, heading = arc(curve.x, curve.y, curve.heading, on_first)
    x, y = x + on_line * np.cos(line), y + on_line * np.sin(line)
    return arc(x, y, heading, np.sign(curve.last) * on_last)
