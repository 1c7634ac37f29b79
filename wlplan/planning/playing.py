"""What plans come to: loads played one after the other, and what each counts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt8

from wlplan.parallel import Ahead, ParallelMap
from wlplan.planning.amounts import MISFIT_COST, Done, Loads
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
from wlplan.traced import Traced, traced
from wlplan.types import (
    Characteristics,
    LoadingPlan,
    Performance,
    Pile,
    Rollout,
    SolveReport,
    World,
)
from wlplan.worlds.capabilities import FORESIGHT, can
from wlplan.xla import on_device


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


@traced(static_argnames=("thorough",))
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

    It is traced once for all programs that it is a part of: so give it no more of a job than it
    needs, see `counting`.

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


class Known(NamedTuple):
    """What a world says of a loading beside its performance; None where it says nothing."""

    solves: SolveReport | None = None
    stall_probability: Array | None = None  # [1]
    deviation: Performance | None = None  # of the error, standard [tonne, s, kJ]


_NOTHING = Known()


def assemble(job: Job, loadings: Assessed, last: Standing, known: Known = _NOTHING) -> PlanResult:
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
        **known._asdict(),
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

    def load(standing: Standing, inputs: Any) -> tuple[Standing, Any]:
        one, leaves, known = inputs
        one = decided(job, standing, one)
        played = _played(job.world, standing.pile, one, report=report)
        assessed, done = assess(
            counted, standing, one, played.performance, leaves=leaves, cusps=known
        )
        return Standing(played.pile, done), (assessed, played.known)

    counted = counting(job)
    leaves = None if candidate.truck is None else leaves_after(candidate.truck)
    last, (loadings, known) = load_by_load(load, beginning(job), (candidate, leaves, cusps))
    return assemble(job, loadings, last, known)


class Played(NamedTuple):
    """What a world makes of a loading."""

    pile: Pile  # after it
    performance: Performance
    known: Known


def _played(world: Any, pile: Pile, one: LoadingPlan, *, report: bool) -> Played:
    where = pile, one.pose, one.action
    solve = getattr(world, "solve", None) if report else None
    after, performance, *solved = (solve or world)(*where)
    if one.truck is not None:
        after = after.replace(height=jnp.where(one.truck >= 0, after.height, pile.height))
    foreseen = {
        name: getattr(world, name)(*where) for name in FORESIGHT if report and can(world, name)
    }
    known = Known(
        solves=solved[0] if solved else None,
        stall_probability=foreseen.get("stall_probability"),
        deviation=foreseen.get("uncertainty"),
    )
    return Played(after, performance, known)


@traced()
def played_at(world: Any, pile: Pile, one: LoadingPlan) -> Played:
    """A loading at its pose; one that goes to no truck (-1) is not made."""
    return _played(world, pile, one, report=True)


_decided = Traced(decided)


def play_one(
    job: Job, standing: Standing, one: Decisions | LoadingPlan
) -> tuple[LoadingPlan, Played]:
    """One loading outside of any trace: where it is dug, and what the world makes of it.

    What is compiled for it serves every objective, site and number of loads.

    Args:
        job: World and amount; for decisions the toe too.
        standing: Before the loading.
        one: As of `decided`.
    """
    _ahead.wait()
    bare = _without(job, "world", "pile", "site", "objective", "yard", "referee")
    dug = _decided(bare, standing, one)
    return dug, played_at(job.world, standing.pile, dug)


def counting(job: Job) -> Job:
    """What of a job counts a loading that was played; the same for all worlds, if it can be."""
    unused = ("pile", "toe", "referee", *(() if job.objective.asks_world else ("world",)))
    return _without(job, *unused)


def _without(job: Job, *names: str) -> Job:
    """A part of a job, for functions that need no more: what is compiled serves other jobs too."""
    part: Job = job.replace(**dict.fromkeys(names))
    return part


class LoadOfPlan(NamedTuple):
    """A load as a plan has it, without leading axes."""

    one: Decisions | LoadingPlan
    leaves: Bool[Array, ""] | None  # whether the truck leaves after it; None: no trucks


class LoadMade(NamedTuple):
    """A load that was played, and where it leaves the job."""

    assessed: Assessed
    known: Known
    standing: Standing  # after it


def loads_of(candidate: Decisions | LoadingPlan) -> list[LoadOfPlan]:
    """The loads of a plan, leaves [N], one by one."""
    leaves = None if candidate.truck is None else leaves_after(jnp.asarray(candidate.truck))
    tree: Any
    columns, tree = jax.tree.flatten(LoadOfPlan(candidate, leaves))
    # By numpy, as below: each number of loads would be compiled for.
    columns = [np.asarray(column) for column in columns]
    return [tree.unflatten(row) for row in zip(*columns, strict=True)]


def make_load(job: Job, standing: Standing, load: LoadOfPlan) -> LoadMade:
    """Plays a load outside of any trace, and counts it.

    It compiles the world and what counts a load for themselves: half of what a whole plan takes,
    and the same for each number of loads.
    """
    dug, played = play_one(job, standing, load.one)
    made, done = assess(counting(job), standing, dug, played.performance, leaves=load.leaves)
    return LoadMade(made, played.known, Standing(played.pile, done))


def assemble_loads(job: Job, loads: Sequence[LoadMade]) -> PlanResult:
    """Loads that were played in order, as a result."""
    assessed, known = jax.tree.map(
        lambda *leaves: on_device(np.stack(leaves)), *(load[:2] for load in loads)
    )
    return assemble(job, assessed, loads[-1].standing, known)


def play_by_load(job: Job, candidate: Decisions | LoadingPlan) -> PlanResult:
    """`play_candidate` outside of any trace, one load after the other."""
    standing, made = beginning(job), []
    for load in loads_of(candidate):
        made.append(make_load(job, standing, load))
        standing = made[-1].standing
    return assemble_loads(job, made)


def cost_as_played(
    job: Job,
    truck: Int[Array | np.ndarray, " n"] | None,
    loads: Sequence[tuple[Standing, LoadingPlan, Performance]],
    last: Standing,
) -> float:
    """What `play_by_load` would say that a plan costs whose loads were played already.

    Args:
        job: The job in the world that played.
        truck: That each row of the plan goes to; None: as the amount has it.
        loads: Of each load that is made what stood before it, where it was dug, and what it
            yielded.
        last: After them.
    """
    counted, cost = counting(job), 0.0
    leaves = None if truck is None else np.asarray(leaves_after(jnp.asarray(truck)))
    # One by one: together they would be many piles.
    for n, (before, dug, performance) in enumerate(loads):
        dug = dug.replace(truck=None if truck is None else np.asarray(truck)[n])
        last_one = None if leaves is None else leaves[n]
        cost += float(assess(counted, before, dug, performance, leaves=last_one)[0].cost)
    return cost + float(job.amount.rest(last.done))


def leaves_after(truck: Int[Array, " n"]) -> Bool[Array, " n"]:
    """Whether the truck of each load leaves after it."""
    following = jnp.append(truck[1:], jnp.full_like(truck[:1], -1))
    return (truck >= 0) & (following != truck)


_ahead = Ahead()


def compile_ahead(job: Job, worlds: Sequence[World]) -> None:
    """Has compiled what plays loads of a job, by decisions along its toe, in worlds; in a thread.

    A first plan needs it last: until then there is other work for one core.
    """
    number = np.zeros((1,), job.pile.height.dtype)
    truck = None if isinstance(job.amount, Loads) else np.zeros((1,), np.int32)
    one: Any = Decisions(number, number, np.zeros((1, 4), number.dtype), truck)  # type: ignore[arg-type]

    def play() -> None:
        for world in worlds:
            # An engine outside of XLA has nothing to compile: it would play, for minutes.
            if not hasattr(world, "play_load"):
                play_by_load(job.replace(world=world, referee=None), one)

    if jax.default_backend() == "cpu":
        _ahead.run(play)


outcomes = ParallelMap(play_candidate, on_core=play_by_load)
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
