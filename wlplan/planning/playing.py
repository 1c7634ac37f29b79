"""What plans come to: loads played one after the other, and what each counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt8

from wlplan.planning.amounts import MISFIT_COST, Done
from wlplan.planning.driving import Way, room_of
from wlplan.planning.job import Decisions, Job, Standing, beginning, decided
from wlplan.planning.loading import Loading, Transport
from wlplan.planning.rollout import load_by_load
from wlplan.planning.search import Cusps
from wlplan.planning.transport import transport
from wlplan.planning.way import cusps_to, unseen_along
from wlplan.planning.yard import packed_soil
from wlplan.site.receiver import Receiver
from wlplan.terrain.characteristics import characteristics
from wlplan.terrain.heightmap import sample_local
from wlplan.types import Characteristics, LoadingPlan, Performance, Rollout, SolveReport
from wlplan.worlds.capabilities import can
from wlplan.xla import ParallelMap


@no_type_check
class Ways(struct.PyTreeNode):
    """The ways to the receiver that a plan takes, leaves (N, ...), and the room for them."""

    way: Way
    unseen: Float[Array, "*n"]  # of it over ground that the scan did not see [m]
    soil: UInt8[Array, "*n bytes"]  # before the loading, see `packed_soil`


class Assessed(struct.PyTreeNode):
    """A loading that was played, and what it counts."""

    plan: LoadingPlan
    performance: Performance
    transport: Transport
    terms: dict[str, Array]
    misfit: Array
    cost: Array
    face: Characteristics
    ways: Ways


@no_type_check
class PlanResult(struct.PyTreeNode):
    """A played plan: what it yields and costs in the world it was played in."""

    plan: LoadingPlan  # leaves (N,); of trucks it says which one each load goes to
    rollout: Rollout
    transport: Transport  # leaves (N,)
    terms: dict[str, Float[Array, " n"]]  # of the objective, by name, without their weights
    costs: Float[Array, " n"]  # of the loadings, misfits included
    cost: Float[Array, ""]  # their sum, and that of what is missing of the amount
    # What the truck that leaves after a load has too much or too little, beyond its tolerance, and
    # what is missing of the amount [tonne].
    misfit: Float[Array, " n"] | float = 0.0
    missing: Float[Array, ""] | float = 0.0
    faces: Characteristics | None = None  # dug, leaves (N,); None: nobody asked for them
    ways: Ways | None = None  # leaves (N, ...); None: nobody asked for them
    solves: SolveReport | None = None  # leaves (N,); None: the world does not say
    # How likely each load stalls, as foreseen [1], and the standard deviation of the error of its
    # performance, leaves (N,); None: the world does not say.
    stall_probability: Float[Array, " n"] | None = None
    deviation: Performance | None = None
    refereed: PlanResult | None = None  # the same plan played by the referee, if there was one
    # Where the loader dumps, leaves (K,) if each truck has its own place; None: as the site has it.
    receiver: Receiver | None = None
    # What was evaluated to find it, in loadings, see `watch.EFFORTS`; and what ended that early:
    # "", "budget" or "interrupted".
    spent: float = struct.field(pytree_node=False, default=0.0)
    stopped: str = struct.field(pytree_node=False, default="")


OF_LOADS = (
    "transport",
    "terms",
    "misfit",
    "costs",
    "faces",
    "ways",
    "solves",
    "stall_probability",
    "deviation",
)
"""Fields of a result, beside plan and performance, whose leaves have an axis of loads."""


def assess(
    job: Job,
    standing: Standing,
    one: LoadingPlan,
    performance: Performance,
    *,
    leaves: Bool[Array, ""] | None = None,
    cusps: Cusps | None = None,
    thorough: bool = True,
) -> tuple[Assessed, Done]:
    """Transport, terms and cost of one loading, and what is done after it.

    Args:
        job: Site, objective and amount.
        standing: Before the loading.
        one: Pose and action; if it says that the load is not made, it counts nothing.
        performance: What the loading yields.
        leaves: Whether the truck leaves after it; None: as the amount has it.
        cusps: Of the best ways to the receiver where they are known, see `way_to`.
        thorough: Whether the best way is wanted, or a good one.
    """
    pile, room = standing.pile, room_of(job.yard, standing.pile)
    mass, site = performance.mass, job.site.of_truck(one.truck)
    carried, way = transport(pile, one.pose, mass, site, room, cusps=cusps, thorough=thorough)
    step = job.amount.step(standing.done, mass, leaves)
    carried = carried.replace(wait=step.wait)
    loading = Loading(pile, one.pose, one.action, performance, carried, site, job.world)
    terms = job.objective.values(loading)
    ways = Ways(
        way, unseen_along(way, job.yard, job.site.machine.turning_radius), packed_soil(pile)
    )
    face = characteristics(sample_local(pile, one.pose))
    cost, misfit, done = job.objective.cost(terms) + step.cost, step.misfit, step.done
    if one.truck is not None:
        made = one.truck >= 0
        cost, misfit = jnp.where(made, cost, 0.0), jnp.where(made, misfit, 0.0)
        done = jax.tree.map(lambda new, old: jnp.where(made, new, old), done, standing.done)
    return Assessed(one, performance, carried, terms, misfit, cost, face, ways), done


def assemble(
    job: Job,
    loadings: Assessed,
    last: Standing,
    solves: SolveReport | None = None,
    stall_probability: Array | None = None,
    deviation: Performance | None = None,
) -> PlanResult:
    """Loadings in order, leaves with leading axis N, and where the last leaves the job."""
    missing = job.amount.missing(last.done)
    return PlanResult(
        plan=loadings.plan,
        rollout=Rollout(performance=loadings.performance, pile=last.pile),
        transport=loadings.transport,
        terms=loadings.terms,
        misfit=loadings.misfit,
        costs=loadings.cost,
        cost=loadings.cost.sum() + job.amount.rest(last.done),
        missing=missing,
        faces=loadings.face,
        ways=loadings.ways,
        solves=solves,
        stall_probability=stall_probability,
        deviation=deviation,
    )


def play_candidate(
    job: Job,
    candidate: Decisions | LoadingPlan,
    *,
    cusps: Cusps | None = None,
    report: bool = True,
) -> PlanResult:
    """Plays a plan, leaves with leading axis N.

    Args:
        job: World, pile, site, objective and amount; for decisions the toe too.
        candidate: Decisions, each taken on the pile that the ones before left, or fixed poses. If
            it says nothing of trucks, loads are made until the amount is done.
        cusps: Of the best ways to the receiver where they are known, see `cusps_of_plans`.
        report: Whether to look at how the world's solvers ended and how likely loads stall, where
            it says so.
    """
    solve = getattr(job.world, "solve", None) if report else None
    play: Callable[..., Any] = job.world if solve is None else solve
    world: Any = job.world
    foreseen = [
        getattr(world, name) if report and can(world, name) else None
        for name in ("stall_probability", "uncertainty")
    ]

    def load(standing: Standing, inputs: Any) -> tuple[Standing, Any]:
        one, leaves, known = inputs
        one = decided(job, standing, one)
        after, performance, *solved = play(standing.pile, one.pose, one.action)
        if one.truck is not None:
            after = after.replace(
                height=jnp.where(one.truck >= 0, after.height, standing.pile.height)
            )
        assessed, done = assess(job, standing, one, performance, leaves=leaves, cusps=known)
        known_before = [
            None if foresees is None else foresees(standing.pile, one.pose, one.action)
            for foresees in foreseen
        ]
        return Standing(after, done), (assessed, solved[0] if solved else None, *known_before)

    leaves = None if candidate.truck is None else leaves_after(candidate.truck)
    last, found = load_by_load(load, beginning(job), (candidate, leaves, cusps))
    return assemble(job, found[0], last, *found[1:])


def leaves_after(truck: Int[Array, " n"]) -> Bool[Array, " n"]:
    """Whether the truck of each load leaves after it."""
    following = jnp.append(truck[1:], jnp.full_like(truck[:1], -1))
    return (truck >= 0) & (following != truck)


outcomes = ParallelMap(play_candidate)
"""`outcomes(job, candidates)` plays several plans; leaves [K, N]."""


def _cusps_of_plan(job: Job, candidate: Decisions | LoadingPlan) -> Cusps:
    def load(standing: Standing, one: Decisions | LoadingPlan) -> tuple[Standing, Cusps]:
        one = decided(job, standing, one.replace(truck=None))
        room, receiver = room_of(job.yard, standing.pile), job.site.placed_receiver
        after = job.world(standing.pile, one.pose, one.action)[0]
        found = cusps_to(one.pose, receiver, room, job.site.machine)
        return standing.replace(pile=after), found

    found: Cusps = load_by_load(load, beginning(job), candidate)[1]
    return found


cusps_of_plans = ParallelMap(_cusps_of_plan)
"""`cusps_of_plans(job, candidates)`: cusps of the best ways to the receiver; leaves [K, N, ...]."""


def _cost_and_gradient(
    job: Job, candidate: tuple[Decisions | LoadingPlan, Cusps]
) -> tuple[Float[Array, ""], Any]:
    plan, cusps = candidate
    truck = plan.truck

    def cost(plan: Decisions | LoadingPlan) -> Array:
        return play_candidate(job, plan.replace(truck=truck), cusps=cusps, report=False).cost

    return jax.value_and_grad(cost)(plan.replace(truck=None))


costs_and_gradients = ParallelMap(_cost_and_gradient)
"""`costs_and_gradients(job, (candidates, cusps))`: cost of several plans, leaves [K, N], and
gradient, which has no trucks. The ways keep their cusps, which move with the poses: so a descent is
smooth, and fast."""


def joined(parts: Sequence[PlanResult]) -> PlanResult:
    """Results that follow each other as one; trucks are counted on."""
    if len(parts) == 1:
        return parts[0]
    plans, first = [], 0
    for part in parts:
        plan = part.plan
        if plan.truck is not None:
            plan = plan.replace(truck=plan.truck + first)
            first += int(np.max(np.asarray(part.plan.truck), initial=-1)) + 1
        plans.append(plan)

    def together(*leaves: Any) -> Array:
        return jnp.concatenate([jnp.atleast_1d(leaf) for leaf in leaves])

    of_loads = {
        name: jax.tree.map(together, *(getattr(part, name) for part in parts)) for name in OF_LOADS
    }
    performance = jax.tree.map(together, *(part.rollout.performance for part in parts))
    seen = [part.refereed for part in parts if part.refereed is not None]
    last = parts[-1]
    return last.replace(
        plan=jax.tree.map(together, *plans),
        rollout=last.rollout.replace(performance=performance),
        # What is missing of one part is made up for in the next.
        cost=sum(part.costs.sum() for part in parts) + MISFIT_COST * last.missing,
        refereed=joined(seen) if seen else None,
        **of_loads,
    )
