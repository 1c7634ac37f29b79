"""A function over two of its variables, and the way that a descent takes there."""

from __future__ import annotations

import functools
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.planning.descent import begin, step
from wlplan.studies.variables import Function, as_function, values_at
from wlplan.worlds.capabilities import with_derivatives


@no_type_check
class Landscape(struct.PyTreeNode):
    """Values of a function on a grid of two coordinates."""

    first: Float[Array, " n"]  # coordinates along the first direction
    second: Float[Array, " m"]
    value: Float[Array, "n m ..."]


@no_type_check
class DescentPath(struct.PyTreeNode):
    """Visits of a descent, in the coordinates of a landscape."""

    place: Float[Array, "r n 2"]  # of R rows side by side
    cost: Float[Array, "r n"]
    best: Float[Array, "r 2"]  # the cheapest of them


def landscape(
    function: Function,
    at: Float[Array | np.ndarray, "*d"],
    directions: tuple[Float[Array | np.ndarray, "*d"], Float[Array | np.ndarray, "*d"]],
    first: Float[Array | np.ndarray, " n"],
    second: Float[Array | np.ndarray, " m"],
) -> Landscape:
    """Values of `function(at + u * directions[0] + v * directions[1])`, row by row.

    Pure, and compiled once for each kind of function.

    Args:
        function: Of an array to an array.
        at: Where both coordinates are 0.
        directions: What a unit of either coordinate does, for instance two of
            `wlplan.studies.direction`.
        first: Coordinates u.
        second: Coordinates v.
    """
    arrays = (jnp.asarray(part) for part in (at, *directions, first, second))
    found: Landscape = _landscape(as_function(function), *arrays)
    return found


@jax.jit
def _landscape(
    function: Function, at: Array, u: Array, v: Array, first: Array, second: Array
) -> Landscape:
    def row(a: Array) -> Array:
        return values_at(function, jax.vmap(lambda b: at + a * u + b * v)(second))

    return Landscape(first, second, jax.lax.map(row, first))


def descent_path(
    function: Function,
    at: Float[Array | np.ndarray, "*d"],
    directions: tuple[Float[Array | np.ndarray, "*d"], Float[Array | np.ndarray, "*d"]],
    starts: Float[Array | np.ndarray, "r 2"],
    *,
    iterations: int = 32,
    length: float = 0.3,
) -> DescentPath:
    """The descent of the planners, in two variables alone.

    Adam with the planners' momentum, whose steps become shorter by a cosine.

    Args:
        function: Of an array to one number, what is to become less.
        at: As of `landscape`.
        directions: As of `landscape`.
        starts: Coordinates that rows begin at.
        iterations: Visits of each row.
        length: Longest step, in units of the coordinates.

    Raises:
        InputError: If there is no visit to be made.
    """
    if iterations < 1:
        raise InputError(f"{iterations} iterations were asked for: ask for at least 1.")
    arrays = (jnp.asarray(part) for part in (at, *directions, starts))
    path: DescentPath = _descent_path(
        as_function(function), *arrays, jnp.asarray(length), iterations=iterations
    )
    return path


@functools.partial(jax.jit, static_argnames="iterations")
def _descent_path(
    function: Any,
    at: Array,
    u: Array,
    v: Array,
    starts: Array,
    length: Array,
    *,
    iterations: int,
) -> DescentPath:
    differentiable: Any = with_derivatives(function)
    evaluate = jax.value_and_grad(lambda place: differentiable(at + place[0] * u + place[1] * v))
    schedule = optax.cosine_decay_schedule(-1.0, iterations, alpha=0.05)
    optimiser = optax.chain(
        optax.scale_by_adam(b1=0.8), optax.scale_by_schedule(schedule), optax.scale(length)
    )

    def one(descent: Any, _: None) -> tuple[Any, tuple[Array, Array]]:
        costs, gradients = jax.lax.map(evaluate, descent.variables)
        return step(descent, costs, gradients, optimiser), (descent.variables, costs)

    last, (places, costs) = jax.lax.scan(one, begin(starts, optimiser), None, length=iterations)
    return DescentPath(jnp.swapaxes(places, 0, 1), costs.T, last.best)
