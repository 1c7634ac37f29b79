"""Gradient descent by Adam that remembers the best it has visited: the one loop of all planners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wlplan.types import PyTree

Evaluate = Callable[[PyTree], tuple[Float[Array, " k"], PyTree]]
"""`evaluate(variables) -> (costs, gradients)` of K rows side by side, leaves [K, ...]."""


def least(costs: Any) -> float:
    """The least of some costs that are numbers; infinite if none is."""
    return float(np.fmin.reduce(np.asarray(costs), initial=np.inf))


class Descent(NamedTuple):
    """Rows on their way down, leaves [K, ...]."""

    variables: PyTree
    optimiser: Any  # state of the optimiser
    best: PyTree  # the cheapest variables of each row so far
    best_costs: Float[Array, " k"]  # infinite before the first step, or where none was finite


def begin(start: PyTree, optimiser: optax.GradientTransformation) -> Descent:
    """Rows before their first step.

    Args:
        start: Variables of K rows, leaves [K, ...].
        optimiser: Of all rows together; Adam treats every number by itself.
    """
    first = jax.tree.leaves(start)[0]
    costs = jnp.full(len(first), jnp.inf, first.dtype)
    return Descent(start, optimiser.init(start), start, costs)


def step(
    descent: Descent,
    costs: Float[Array, " k"],
    gradients: PyTree,
    optimiser: optax.GradientTransformation,
) -> Descent:
    """Remembers what is better than before, and goes on one step. A cost of NaN is no better.

    Args:
        descent: Rows as they are.
        costs: Of their variables.
        gradients: Likewise.
        optimiser: As of `begin`.
    """
    better = costs < descent.best_costs

    def pick(new: Array, old: Array) -> Array:
        return jnp.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

    best = jax.tree.map(pick, descent.variables, descent.best)
    updates, state = optimiser.update(gradients, descent.optimiser, descent.variables)
    return Descent(
        optax.apply_updates(descent.variables, updates),
        state,
        best,
        jnp.where(better, costs, descent.best_costs),
    )


def descend(
    evaluate: Evaluate, start: PyTree, optimiser: optax.GradientTransformation, steps: int
) -> tuple[PyTree, Float[Array, " k"]]:
    """The cheapest of `steps` visits of each row, and its cost; may be traced."""

    def one(descent: Descent, _: None) -> tuple[Descent, None]:
        return step(descent, *evaluate(descent.variables), optimiser), None

    last, _ = jax.lax.scan(one, begin(start, optimiser), None, length=steps)
    return last.best, last.best_costs


def descend_stepwise(
    evaluate: Evaluate,
    descent: Descent,
    advance: Callable[[Descent, Float[Array, " k"], PyTree], Descent],
    steps: int,
    visit: Callable[[int, Float[Array, " k"], Descent], None],
) -> Descent:
    """The same outside of any trace, for rows that are shared out among cores.

    Args:
        evaluate: Costs and gradients of the rows.
        descent: Rows before their first step.
        advance: `step` with an optimiser, compiled.
        steps: Visits of each row.
        visit: `visit(number, costs, descent)` at each of them, before the step.
    """
    for number in range(steps):
        costs, gradients = evaluate(descent.variables)
        visit(number, costs, descent)
        descent = advance(descent, costs, gradients)
    return descent
