"""What the first load of a plan does to the totals of 1, 2, ... N loads, and what of it is later.

The loads after the first stay where they are. What they yield changes with the pile that the first
leaves, and only a derivative through the whole rollout knows that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from wlplan.errors import InputError
from wlplan.planning.job import Job, Standing, beginning
from wlplan.planning.playing import assess, counting
from wlplan.planning.rollout import load_by_load
from wlplan.planning.search import Cusps
from wlplan.studies.variables import COMPONENTS, moved
from wlplan.types import LoadingPlan
from wlplan.worlds.capabilities import with_derivatives

TOTALS = ("mass", "time", "work", "cost")
"""What is summed over the loads [tonne, s, kJ, 1]."""


@no_type_check
class Horizon(struct.PyTreeNode):
    """Totals over the first loads of a plan, H numbers of them, per step of the first load.

    Steps and components are those of `wlplan.studies.variables`.
    """

    loads: Int[Array, " h"]
    total: Float[Array, "h 4"]  # see `TOTALS`
    gradient: Float[Array, "h 4 7"]
    difference: Float[Array, "h 4 7"]  # half of that between a step forward and one back


def horizon(
    job: Job,
    plan: LoadingPlan,
    loads: Sequence[int],
    *,
    step: float = 1.0,
    narrow: float | None = None,
    cusps: Cusps | None = None,
) -> Horizon:
    """Derivatives of totals with respect to pose and action of the first load.

    Pure. One number of loads takes as long as its loads.

    Args:
        job: World, pile, site and objective.
        plan: N loadings, leaves (N,).
        loads: Numbers of loads to sum over, at most N.
        step: Half width of the differences, in steps.
        narrow: Half width of differences that stand for the gradient, in float64: for worlds
            without a derivative, and where 14 rollouts cost less. None: by reverse mode.
        cusps: Of the best ways to the receiver, leaves (N, ...), see
            `wlplan.planning.playing.cusps_of_plans`; None: ways are looked for each time.

    Raises:
        InputError: If a number of loads is not one of the plan's.
    """
    count = len(plan.pose.x)
    for number in loads:
        if not 1 <= number <= count:
            raise InputError(f"there are no {number} loads in a plan of {count}.")
    found: Horizon = _horizon(job, plan, jnp.asarray(loads), jnp.asarray(step), narrow, cusps)
    return found


@jax.jit
def _horizon(
    job: Job, plan: LoadingPlan, loads: Array, step: Array, narrow: Array | None, cusps: Any
) -> Horizon:
    here = jnp.zeros(len(COMPONENTS), plan.pose.x.dtype)

    def sums(steps: Array) -> Array:
        return jnp.cumsum(_yields(job, plan, cusps, steps, loads.max()), axis=0)[loads - 1]

    def differences(width: Array) -> Array:
        away = width * jnp.eye(len(COMPONENTS), dtype=here.dtype)
        # One after the other: avalanches side by side wait for the longest.
        ahead, behind = jnp.split(lax.map(sums, jnp.concatenate([away, -away])), 2)
        return jnp.moveaxis((ahead - behind) / (2.0 * width), 0, -1)

    slow = job.replace(world=with_derivatives(job.world))

    def by_reverse_mode(count: Array) -> Array:
        def total(steps: Array) -> Array:
            return _yields(slow, plan, cusps, steps, count).sum(axis=0)

        jacobian: Array = jax.jacrev(total)(here)
        return jacobian

    gradient = lax.map(by_reverse_mode, loads) if narrow is None else differences(narrow)
    return Horizon(loads, sums(here), gradient, differences(step))


def _yields(
    job: Job, plan: LoadingPlan, cusps: Any, steps: Float[Array, "7"], count: Int[Array, ""]
) -> Float[Array, "n 4"]:
    """`TOTALS` of each load, the first moved by some steps; loads after `count` are not made."""
    counted = counting(job)

    def load(standing: Standing, inputs: Any) -> tuple[Standing, Array]:
        number, one, known = inputs
        pose, action = moved(one.pose, one.action, jnp.where(number == 0, steps, 0.0))
        one = one.replace(pose=pose, action=action)

        def played(standing: Standing) -> tuple[Standing, Array]:
            after, performance = job.world(standing.pile, one.pose, one.action)
            assessed, done = assess(
                counted, standing, one, performance, cusps=known, thorough=False
            )
            numbers = (performance.mass, performance.time, performance.work, assessed.cost)
            return Standing(after, done), jnp.stack(numbers)

        # A branch, not a mask: neither forward nor backward is anything computed beyond.
        outcome: tuple[Standing, Array] = lax.cond(
            number < count, played, lambda same: (same, jnp.zeros(4, steps.dtype)), standing
        )
        return outcome

    inputs = (jnp.arange(len(plan.pose.x)), plan, cusps)
    table: Array = load_by_load(load, beginning(job), inputs)[1]
    return table
