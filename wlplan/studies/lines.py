"""A function and its derivative along a line. Paper, appendix C."""

from __future__ import annotations

from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from wlplan.studies.variables import Function, as_function, jacobians_at, values_at


@no_type_check
class Line(struct.PyTreeNode):
    """What a function does along a line, at P places."""

    place: Float[Array, " p"]
    value: Float[Array, "p ..."]
    derivative: Float[Array, "p ..."]  # by reverse mode, with respect to the place


def line(
    function: Function,
    at: Float[Array | np.ndarray, "*d"],
    along: Float[Array | np.ndarray, "*d"],
    places: Float[Array | np.ndarray, " p"],
) -> Line:
    """Values and derivatives of `function(at + place * along)`.

    Pure, and compiled once for each kind of function. Reverse mode takes place after place.

    Args:
        function: Of an array to an array.
        at: Where place 0 is.
        along: Where to, in one unit of the place: a direction, or the other end of the line less
            this one.
        places: Where to look.
    """
    found: Line = _line(as_function(function), *map(jnp.asarray, (at, along, places)))
    return found


@jax.jit
def _line(function: Function, at: Array, along: Array, places: Array) -> Line:
    points = jax.vmap(lambda place: at + place * along)(places)
    jacobian = jacobians_at(function, points)
    derivative = jnp.tensordot(jacobian, along, axes=along.ndim)
    return Line(places, values_at(function, points), derivative)
