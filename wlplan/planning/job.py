"""What every planner works on: a job, decisions for N loadings, and what they come to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, UInt8

from wlplan.actions import squash
from wlplan.checks import check_pile, check_world
from wlplan.errors import InputError
from wlplan.planning.driving import Way, room_of
from wlplan.planning.loading import Loading, Transport
from wlplan.planning.objective import Objective, objective_of
from wlplan.planning.placement import beside
from wlplan.planning.poses import Toe, pose_at, toe_of
from wlplan.planning.rollout import load_by_load
from wlplan.planning.search import Cusps
from wlplan.planning.transport import transport
from wlplan.planning.way import cusps_to, unseen_along
from wlplan.planning.yard import Yard, packed_soil, yard_of
from wlplan.site.frame import LOCAL
from wlplan.site.site import Site
from wlplan.terrain.characteristics import characteristics
from wlplan.terrain.heightmap import sample_local
from wlplan.terrain.toe import ToeContour, toe_contour
from wlplan.types import (
    Action,
    Characteristics,
    LoadingPlan,
    Performance,
    Pile,
    Pose,
    Rollout,
    SolveReport,
    World,
)
from wlplan.worlds.capabilities import as_pytree, is_differentiable
from wlplan.xla import ParallelMap


@no_type_check
class Job(struct.PyTreeNode):
    """What is asked for: a pile to load from at a site, for an objective, as a world sees it."""

    world: World
    pile: Pile
    site: Site  # with its receiver
    objective: Objective = struct.field(pytree_node=False)
    yard: Yard  # room to drive around the pile
    toe: Toe | None = None  # to dig along; None where plans with poses of their own are played


def make_job(
    world: World,
    pile: Pile,
    *,
    site: Site | None = None,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = "efficiency",
    contour: ToeContour | None = None,
) -> Job:
    """A job without a toe, once everything that users get wrong was looked at.

    Args:
        world: World to plan or play in.
        pile: The pile before the first loading.
        site: Machine, soil and receiver; default: the WA320 in gravel. Without a receiver it has
            one beside the pile.
        objective: A name, an `Objective`, named terms, or a function of a loading.
        contour: Toe of the pile where it is known already.

    Raises:
        InputError: If one of them cannot be used; one line that says what to do.
    """
    check_world(world)
    check_pile(pile)
    placed = beside(Site() if site is None else site, pile, contour)
    return Job(
        world=as_pytree(world),
        pile=pile,
        # Nothing that is computed depends on the frame: what is compiled serves all of them. What
        # is closed to traffic is part of the yard.
        site=placed.replace(frame=LOCAL, keep_out=None),
        objective=objective_of(objective),
        yard=yard_of(pile, placed.machine, placed.keep_out),
    )


def with_toe(job: Job, contour: ToeContour | None = None) -> Job:
    """The job with a toe to dig along.

    Args:
        job: Any job.
        contour: Toe of its pile where it is known already; by default it is traced.

    Raises:
        InputError: If there is nothing to dig, or a bucket can start nowhere.
    """
    if contour is None:
        contour = toe_contour(job.pile, machine=job.site.machine)
    return job.replace(toe=toe_of(contour, job.site.machine, job.pile.height.dtype))


@no_type_check
class Decisions(struct.PyTreeNode):
    """What a planner chooses of loadings; unbounded, so that any value is a plan."""

    position: Float[Array, "*n"]  # along the toe contour, in parts of its length
    offset: Float[Array, "*n"]  # heading offset before squashing
    action: Float[Array, "*n 4"]  # action parameters before squashing


@no_type_check
class PlanResult(struct.PyTreeNode):
    """A played plan: what it yields and costs in the world it was played in."""

    plan: LoadingPlan  # leaves (N,)
    rollout: Rollout
    transport: Transport  # leaves (N,)
    terms: dict[str, Float[Array, " n"]]  # of the objective, by name, without their weights
    costs: Float[Array, " n"]  # of the loadings
    cost: Float[Array, ""]  # their sum
    faces: Characteristics | None = None  # dug, leaves (N,); None: nobody asked for them
    ways: Ways | None = None  # leaves (N, ...); None: nobody asked for them
    solves: SolveReport | None = None  # leaves (N,); None: the world does not say
    refereed: PlanResult | None = None  # the same plan played by the referee, if there was one


def decide(job: Job, pile: Pile, one: Decisions | LoadingPlan) -> tuple[Pose, Action]:
    """Pose and action of one loading on the pile as it is."""
    if isinstance(one, LoadingPlan):
        return one.pose, one.action
    assert job.toe is not None
    return pose_at(job.toe, pile, one.position, one.offset), squash(one.action)


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
    cost: Array
    face: Characteristics
    ways: Ways


def assess(
    job: Job,
    pile: Pile,
    pose: Pose,
    action: Action,
    performance: Performance,
    *,
    cusps: Cusps | None = None,
    thorough: bool = True,
) -> Assessed:
    """Transport, terms and cost of one loading.

    Args:
        job: Site and objective.
        pile: The pile before the loading.
        pose: Dig location and heading.
        action: Parameters of the bucket-filling controller.
        performance: What the loading yields.
        cusps: Of the best ways to the receiver where they are known, see `way_to`.
        thorough: Whether the best way is wanted, or a good one.
    """
    room = room_of(job.yard, pile)
    carried, way = transport(
        pile, pose, performance.mass, job.site, room, cusps=cusps, thorough=thorough
    )
    loading = Loading(pile, pose, action, performance, carried, job.site)
    terms = job.objective.values(loading)
    ways = Ways(
        way, unseen_along(way, job.yard, job.site.machine.turning_radius), packed_soil(pile)
    )
    face = characteristics(sample_local(pile, pose))
    plan = LoadingPlan(pose, action)
    return Assessed(plan, performance, carried, terms, job.objective.cost(terms), face, ways)


def assemble(loadings: Assessed, pile: Pile, solves: SolveReport | None = None) -> PlanResult:
    """Loadings in order, leaves with leading axis N, and the pile after the last as a result."""
    return PlanResult(
        plan=loadings.plan,
        rollout=Rollout(performance=loadings.performance, pile=pile),
        transport=loadings.transport,
        terms=loadings.terms,
        costs=loadings.cost,
        cost=loadings.cost.sum(),
        faces=loadings.face,
        ways=loadings.ways,
        solves=solves,
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
        job: World, pile, site and objective; for decisions the toe too.
        candidate: Decisions, each taken on the pile that the ones before left, or fixed poses.
        cusps: Of the best ways to the receiver where they are known, see `cusps_of_plans`.
        report: Whether to look at how the world's solvers ended, where it says so.
    """
    solve = getattr(job.world, "solve", None) if report else None
    play: Callable[..., Any] = job.world if solve is None else solve

    def load(pile: Pile, inputs: Any) -> tuple[Pile, tuple[Assessed, SolveReport | None]]:
        one, known = inputs
        pose, action = decide(job, pile, one)
        after, performance, *solved = play(pile, pose, action)
        assessed = assess(job, pile, pose, action, performance, cusps=known)
        return after, (assessed, solved[0] if solved else None)

    after, (loadings, solves) = load_by_load(load, job.pile, (candidate, cusps))
    return assemble(loadings, after, solves)


def cost_of_next(
    job: Job, pile: Pile, decisions: Decisions, cusps: Cusps | None = None
) -> Float[Array, ""]:
    """Cost of a single loading on a given pile; what becomes of the pile is not computed.

    Args:
        job: World, site, objective and toe.
        pile: The pile before the loading.
        decisions: Of the loading.
        cusps: Of the best ways to the receiver where they are known, see `cusps_of_next`.
    """
    pose, action = decide(job, pile, decisions)
    _, performance = job.world(pile, pose, action)
    return assess(job, pile, pose, action, performance, cusps=cusps, thorough=False).cost


def cusps_of_next(job: Job, pile: Pile, position: Array, offset: Array) -> Cusps:
    """Cusps of good ways from where a loading would be, whatever the action."""
    assert job.toe is not None
    pose = pose_at(job.toe, pile, position, offset)
    room, receiver = room_of(job.yard, pile), job.site.placed_receiver
    return cusps_to(pose, receiver, room, job.site.machine, thorough=False)


def contour_length(job: Job) -> Float[Array, ""]:
    """Length of the toe contour [m]."""
    assert job.toe is not None
    steps = job.toe.points[1:] - job.toe.points[:-1]
    return jnp.sqrt((steps**2).sum(axis=1)).sum()


def stacked(decisions: Sequence[Decisions]) -> Decisions:
    """Several decisions as one, with a new leading axis."""
    together: Decisions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *decisions)
    return together


outcomes = ParallelMap(play_candidate)
"""`outcomes(job, candidates)` plays several plans; leaves [K, N]."""


def _cusps_of_plan(job: Job, candidate: Decisions | LoadingPlan) -> Cusps:
    def load(pile: Pile, one: Decisions | LoadingPlan) -> tuple[Pile, Cusps]:
        pose, action = decide(job, pile, one)
        room, receiver = room_of(job.yard, pile), job.site.placed_receiver
        return job.world(pile, pose, action)[0], cusps_to(pose, receiver, room, job.site.machine)

    found: Cusps = load_by_load(load, job.pile, candidate)[1]
    return found


cusps_of_plans = ParallelMap(_cusps_of_plan)
"""`cusps_of_plans(job, candidates)`: cusps of the best ways to the receiver; leaves [K, N, ...]."""


def _cost_and_gradient(
    job: Job, candidate: tuple[Decisions | LoadingPlan, Cusps]
) -> tuple[Float[Array, ""], Any]:
    plan, cusps = candidate

    def cost(plan: Decisions | LoadingPlan) -> Array:
        return play_candidate(job, plan, cusps=cusps, report=False).cost

    return jax.value_and_grad(cost)(plan)


costs_and_gradients = ParallelMap(_cost_and_gradient)
"""`costs_and_gradients(job, (candidates, cusps))`: cost of several plans, leaves [K, N], and
gradient. The ways keep their cusps, which move with the poses: so a descent is smooth, and fast."""


def check_has_gradient(job: Job, remedy: str) -> None:
    """Refuses a job in a world without a derivative, before JAX does.

    Args:
        job: Any job.
        remedy: What to do about it, in words that follow a colon.

    Raises:
        InputError: If the world says that it has none, or says nothing and has none.
    """
    said = is_differentiable(job.world)
    if said is None:
        said = _passes_reverse_mode(job)
    if not said:
        raise InputError(f"this world has no derivative: {remedy}.")


def can_refine(job: Job, steps: int) -> bool:
    """Whether a planner that may refine by gradient, in so many steps, is to do so.

    Args:
        job: Any job.
        steps: Steps that it would make; 0 for none.

    Raises:
        InputError: If the world does not say whether it has a derivative, and has none.
    """
    if steps == 0 or is_differentiable(job.world) is False:
        return False
    check_has_gradient(job, "declare that with wlplan.world(function, differentiable=False)")
    return True


def _passes_reverse_mode(job: Job) -> bool:
    """Whether a function that does not say so has a derivative, found by tracing it."""
    number = jnp.zeros((), job.pile.height.dtype)
    pose, action = Pose(number, number, number), Action(number, number, number, number)

    def mass(pose: Pose, action: Action) -> Array:
        return job.world(job.pile, pose, action)[1].mass

    # What is wrong with the function itself is for its author to see, as it is.
    jax.eval_shape(mass, pose, action)
    try:
        jax.eval_shape(jax.grad(mass, argnums=(0, 1)), pose, action)
    except Exception:
        return False
    return True
