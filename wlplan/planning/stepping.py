"""The next load alone: what planners do that go load by load."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from wlplan.planning.amounts import Amount, Outlook
from wlplan.planning.job import Decisions, Job, Standing, decided
from wlplan.planning.playing import Assessed, assess, counting
from wlplan.planning.search import Cusps
from wlplan.types import LoadingPlan, Performance, Pile
from wlplan.worlds.capabilities import foresee


def next_load(
    job: Job, standing: Standing, decisions: Decisions, cusps: Cusps | None = None
) -> Assessed:
    """A single loading that no truck leaves after; what becomes of the pile is not computed.

    Args:
        job: World, site, objective and toe.
        standing: Before the loading.
        decisions: Of the loading.
        cusps: Of the best ways to the receiver where they are known, see `good_ways`.
    """
    one = decided(job, standing, decisions)
    performance = foresee(job.world, standing.pile, one.pose, one.action)
    return _stays(job, standing, one, performance, cusps)


def score_of_next(
    job: Job,
    standing: Standing,
    decisions: Decisions,
    outlook: Outlook,
    cusps: Cusps | None = None,
) -> Float[Array, ""]:
    """Cost of a single loading and of what it leaves to do: what makes next loads comparable.

    Args:
        job: World, site, objective, amount and toe.
        standing: Before the loading.
        decisions: Of the loading.
        outlook: What the loads after it will be like.
        cusps: As of `next_load`.
    """
    loading = next_load(job, standing, decisions, cusps)
    return score_of(job, standing, loading.cost, loading.performance.mass, outlook)


def score_of_played(
    job: Job,
    standing: Standing,
    played: tuple[LoadingPlan, Performance],
    outlook: Outlook,
    cusps: Cusps,
) -> Float[Array, ""]:
    """The same of a loading that was played."""
    loading = _stays(job, standing, *played, cusps)
    return score_of(job, standing, loading.cost, loading.performance.mass, outlook)


def _stays(
    job: Job, standing: Standing, one: LoadingPlan, performance: Performance, cusps: Cusps | None
) -> Assessed:
    """What a loading counts that no truck leaves after."""
    leaves = jnp.zeros((), bool)
    assessed: Assessed = assess(
        counting(job), standing, one, performance, leaves=leaves, cusps=cusps, thorough=False
    )[0]
    return assessed


def score_of(
    job: Job, standing: Standing, cost: Array, mass: Array, outlook: Outlook
) -> Float[Array, ""]:
    """The same of a loading whose cost and mass [tonne] are known."""
    after = job.amount.step(standing.done, mass, jnp.zeros((), bool)).done
    return cost + job.amount.shortfall(mass) + job.amount.to_go(after, outlook)


class Advanced(NamedTuple):
    """A loading that was made."""

    standing: Standing  # after it
    truck: Int[Array, ""]  # that it went to
    cost: Float[Array, ""]  # of it, what the truck that leaves is off by included; no wait


def advance(
    job: Job,
    standing: Standing,
    decisions: Decisions,
    outlook: Outlook,
    score: Float[Array, ""] | float,
) -> Advanced:
    """Makes a loading.

    Args:
        job: World, amount and toe.
        standing: Before the loading.
        decisions: Of the loading.
        outlook: As of `score_of_next`.
        score: What `score_of_next` has of it.
    """
    one = decided(job, standing, decisions)
    after, performance = job.world(standing.pile, one.pose, one.action)
    return made(job.amount, standing, (after, performance.mass), outlook, score)


def made(
    amount: Amount,
    standing: Standing,
    played: tuple[Pile, Float[Array, ""]],
    outlook: Outlook,
    score: Float[Array, ""] | float,
) -> Advanced:
    """`advance` for a loading that was played: the pile after it, and its mass [tonne].

    The truck leaves when no further load would make it better.
    """
    after, mass = played
    stays = amount.step(standing.done, mass, jnp.zeros((), bool)).done
    step = amount.step(standing.done, mass, amount.should_leave(stays, outlook))
    cost = score - amount.to_go(stays, outlook) + step.cost
    return Advanced(Standing(after, step.done), standing.done.trucks, cost)
