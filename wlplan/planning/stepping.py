"""The next load alone: what planners do that go load by load."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from wlplan.planning.amounts import Outlook
from wlplan.planning.driving import room_of
from wlplan.planning.job import Decisions, Job, Standing, decided, judged
from wlplan.planning.playing import Assessed, assess
from wlplan.planning.poses import pose_at
from wlplan.planning.search import Cusps
from wlplan.planning.way import cusps_to
from wlplan.types import Pile


def next_load(
    job: Job, standing: Standing, decisions: Decisions, cusps: Cusps | None = None
) -> Assessed:
    """A single loading that no truck leaves after; what becomes of the pile is not computed.

    Args:
        job: World, site, objective and toe.
        standing: Before the loading.
        decisions: Of the loading.
        cusps: Of the best ways to the receiver where they are known, see `cusps_of_next`.
    """
    one = decided(job, standing, decisions)
    _, performance = job.world(standing.pile, one.pose, one.action)
    stays = jnp.zeros((), bool)
    return assess(job, standing, one, performance, leaves=stays, cusps=cusps, thorough=False)[0]


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


def score_of(
    job: Job, standing: Standing, cost: Array, mass: Array, outlook: Outlook
) -> Float[Array, ""]:
    """The same of a loading whose cost and mass [tonne] are known."""
    after = job.amount.step(standing.done, mass, jnp.zeros((), bool)).done
    return cost + job.amount.to_go(after, outlook)


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
    """Makes a loading, in the world of the referee if there is one.

    The truck leaves when no further load would make it better.

    Args:
        job: World, amount and toe.
        standing: Before the loading.
        decisions: Of the loading.
        outlook: As of `score_of_next`.
        score: What `score_of_next` has of it.
    """
    one = decided(job, standing, decisions)
    after, performance = judged(job).world(standing.pile, one.pose, one.action)
    amount, mass = job.amount, performance.mass
    stays = amount.step(standing.done, mass, jnp.zeros((), bool)).done
    step = amount.step(standing.done, mass, amount.should_leave(stays, outlook))
    cost = score - amount.to_go(stays, outlook) + step.cost
    return Advanced(Standing(after, step.done), standing.done.trucks, cost)


def cusps_of_next(job: Job, pile: Pile, position: Array, offset: Array) -> Cusps:
    """Cusps of good ways from where a loading would be, whatever the action."""
    assert job.toe is not None
    pose = pose_at(job.toe, pile, position, offset)
    room, receiver = room_of(job.yard, pile), job.site.placed_receiver
    return cusps_to(pose, receiver, room, job.site.machine, thorough=False)
