"""What every planner optimises: decisions for N loadings, and what they cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.planning.objective import Objective, loading_cost
from wlplan.planning.poses import Toe, pose_at
from wlplan.planning.rollout import closed_loop
from wlplan.planning.transport import Receiver, transport
from wlplan.types import Action, LoadingPlan, Pile, Pose, Rollout, World, action_from
from wlplan.xla import ParallelMap


@no_type_check
class Job(struct.PyTreeNode):
    """A pile to load from, and for what."""

    world: World
    pile: Pile
    receiver: Receiver
    objective: Objective = struct.field(pytree_node=False)


@no_type_check
class ToeJob(Job):
    """A job whose loadings are decided along the toe of the pile."""

    toe: Toe = struct.field(kw_only=True)


@no_type_check
class Decisions(struct.PyTreeNode):
    """What a planner chooses of loadings; unbounded, so that any value is a plan."""

    position: Float[Array, "*n"]  # along the toe contour, in parts of its length
    offset: Float[Array, "*n"]  # heading offset before squashing
    action: Float[Array, "*n 4"]  # action parameters before squashing


@no_type_check
class Outcome(struct.PyTreeNode):
    """A played plan."""

    plan: LoadingPlan  # leaves (N,)
    rollout: Rollout
    transport_time: Float[Array, " n"]  # [s]
    transport_work: Float[Array, " n"]  # [kJ]
    costs: Float[Array, " n"]  # of the loadings
    cost: Float[Array, ""]  # their sum
    refereed: Outcome | None = None  # the same plan played by the referee, if there was one


_LOW = np.asarray(ACTION_LOW)
_RANGE = np.asarray(ACTION_HIGH) - _LOW


def squash(raw: Float[Array, "4"]) -> Action:
    """Action inside its box."""
    low, span = jnp.asarray(_LOW, raw.dtype), jnp.asarray(_RANGE, raw.dtype)
    return action_from(low + jax.nn.sigmoid(raw) * span)


def unsquash(part: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Inverse of `squash` for parts of the box; its edges are moved in by a hundredth."""
    part = np.clip(part, 0.01, 0.99)
    return np.log(part / (1.0 - part))


def decide(job: ToeJob, pile: Pile, decisions: Decisions) -> tuple[Pose, Action]:
    """Pose and action of one loading on the pile as it is."""
    return pose_at(job.toe, pile, decisions.position, decisions.offset), squash(decisions.action)


def judged(
    receiver: Receiver, objective: Objective, plan: LoadingPlan, outcome: Rollout
) -> Outcome:
    """A plan that was played, with its transport and its cost."""
    time, work = jax.vmap(lambda pose, mass: transport(pose, receiver, mass))(
        plan.pose, outcome.performance.mass
    )
    costs = loading_cost(objective, outcome.performance, time, work)
    return Outcome(
        plan=plan,
        rollout=outcome,
        transport_time=time,
        transport_work=work,
        costs=costs,
        cost=costs.sum(),
    )


def play_decisions(job: ToeJob, decisions: Decisions) -> Outcome:
    """Plays decisions, leaves with leading axis N, each on the pile that the ones before left."""
    outcome, plan = closed_loop(
        job.world, job.pile, decisions, lambda pile, d: decide(job, pile, d)
    )
    return judged(job.receiver, job.objective, plan, outcome)


def play_plan(job: Job, plan: LoadingPlan) -> Outcome:
    """Plays a plan with its poses as they are."""
    outcome, plan = closed_loop(
        job.world, job.pile, plan, lambda _, loading: (loading.pose, loading.action)
    )
    return judged(job.receiver, job.objective, plan, outcome)


def cost_of_one(job: ToeJob, pile: Pile, decisions: Decisions) -> Float[Array, ""]:
    """Cost of a single loading on a given pile; what becomes of the pile is not computed."""
    pose, action = decide(job, pile, decisions)
    _, performance = job.world(pile, pose, action)
    time, work = transport(pose, job.receiver, performance.mass)
    return loading_cost(job.objective, performance, time, work)


def contour_length(job: ToeJob) -> Float[Array, ""]:
    """Length of the toe contour [m]."""
    steps = job.toe.points[1:] - job.toe.points[:-1]
    return jnp.sqrt((steps**2).sum(axis=1)).sum()


def stacked(decisions: Sequence[Decisions]) -> Decisions:
    """Several decisions as one, with a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *decisions)


outcomes = ParallelMap(play_decisions)
"""`outcomes(job, plans)` plays several plans; leaves [K, N]."""

played = ParallelMap(play_plan)
"""`played(job, plans)` plays several fixed plans; leaves [K, N]."""


def _cost_and_gradient(job: ToeJob, plan: Decisions) -> tuple[Float[Array, ""], Decisions]:
    return jax.value_and_grad(lambda decisions: play_decisions(job, decisions).cost)(plan)


costs_and_gradients = ParallelMap(_cost_and_gradient)
"""`costs_and_gradients(job, plans)`: cost of several plans, leaves [K, N], and its gradient."""
