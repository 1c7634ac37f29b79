"""Planning the next loads, and playing plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from wlplan.checks import check_plan
from wlplan.constants import DEFAULT_LOADS, KG_PER_TONNE
from wlplan.errors import InputError
from wlplan.planning import planners
from wlplan.planning.amounts import Amount, Loads, Made, Tonnes, Trucks, typical_load
from wlplan.planning.job import (
    Decisions,
    Job,
    Standing,
    beginning,
    check_knows_enough,
    make_job,
    with_toe,
)
from wlplan.planning.load_search import price_of
from wlplan.planning.mending import mended
from wlplan.planning.objective import Objective
from wlplan.planning.playing import (
    OF_LOADS,
    PlanResult,
    assemble,
    assess,
    compile_ahead,
    counting,
    joined,
    leaves_after,
    outcomes,
)
from wlplan.planning.proposals import NothingWorthIt, Planner, Progress, Proposals
from wlplan.planning.spots import at_receiver
from wlplan.planning.truck_search import TRUCKS, best_place
from wlplan.planning.watch import Watch
from wlplan.site.receiver import Receiver, receiver_count
from wlplan.site.site import Site
from wlplan.terrain.toe import ToeContour
from wlplan.terrain.toes import toes_of
from wlplan.types import LoadingPlan, Pile, World
from wlplan.worlds.capabilities import as_pytree, is_differentiable

# A plan that is its own limit may be above it by rounding.
_ROUNDING = 1e-6


def plan_loads(
    world: World,
    pile: Pile,
    *,
    loads: int | None = None,
    amount: Amount | None = None,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] | None = None,
    planner: str | Planner = "iterated_greedy",
    site: Site | None = None,
    truck: str | None = None,
    seed: int = 0,
    referee: World | None = None,
    mend: bool = True,
    progress: Progress | None = None,
    budget: int | None = None,
    stop: Callable[[], bool] | None = None,
    contour: ToeContour | None = None,
) -> PlanResult:
    """Plans the next loadings from a pile.

    Ctrl-C, `stop` and a budget end the search: the best plan so far is the result, which says so.

    Args:
        world: World to plan in.
        pile: The pile as it is, relaxed or as scanned.
        loads: Number of loadings; default 15, if there is no amount either.
        amount: How much is to be loaded: `Loads`, `Tonnes`, `Trucks` or `Empty`.
        objective: A name, an `Objective`, a mapping of named terms, or a function of a loading.
            Default: "efficiency" for a number of loads, "delivery" for other amounts.
        planner: A name of `wlplan.planners.NAMES`, or a planner with settings of its own.
        site: Machine, soil and receiver; default: the WA320 in gravel, and a receiver beside the
            pile, see `wlplan.planning.placement`.
        truck: "auto": the planner chooses where it stands, see `wlplan.planning.truck_search`;
            "each": for each truck of `Trucks` anew. The result says where. None: at the receiver of
            the site.
        seed: Of everything random.
        referee: World that plays the planner's candidates, each dig at the toe of the pile as the
            referee has it by then, and picks the cheapest; the poses of the result are the ones
            it dug at. A candidate that costs more in `world` than the planner's limit, for the
            gradient planner the greedy plan, is out. Planners of ours that go load by load plan
            each load on the pile as the referee has it. None: `world` picks, with its own poses.
        mend: Whether loads that fail in the referee, though nothing of it was foreseen, are tried
            there with the actions of others, see `wlplan.planning.mending`; the limit does not
            hold for that.
        progress: Called as the planner advances.
        budget: Most that a search may spend, in loadings, see `wlplan.planning.watch.EFFORTS`.
        stop: Asked now and then; once it returns True the search ends, as by Ctrl-C, which only
            the main thread of a process hears of.
        contour: The toe to dig along; default: that of the pile.

    Returns:
        The plan, its rollout in `world`, the transport, the terms and the cost, and in `refereed`
        how the referee saw it.

    Raises:
        InputError: If there is nothing to dig, no load is asked for, a name is unknown, "each"
            is asked for without trucks, there is no room in the area for trucks, the planner needs
            a gradient that the world does not have, or no plan has a finite cost.
        KeyboardInterrupt: If there was no plan yet.
    """
    if amount is None:
        amount = Loads(DEFAULT_LOADS if loads is None else loads)
    elif loads is not None:
        raise InputError("both loads and an amount are given: give one of them.")
    if objective is None:
        objective = amount.objective
    site = Site() if site is None else site
    amount = amount.of(pile, site.soil)
    job = make_job(world, pile, site=site, objective=objective, amount=amount, contour=contour)
    check_knows_enough(job)
    checked = None
    if referee is not None:
        checked = make_job(referee, pile, site=job.site, contour=contour).world
    chosen = planner_of(planner, job.world)
    watch, made = Watch(progress, budget, stop), Made()
    parts: list[PlanResult] = []
    typical = typical_load(job.site)
    if truck not in (None, *TRUCKS):
        raise InputError(f"the truck is {truck!r}: give {' or '.join(map(repr, TRUCKS))}, or none.")
    each = truck == "each"
    if each and not isinstance(amount, Trucks):
        raise InputError(
            "a place for each truck goes with an amount of trucks: give how many and their "
            "payload, or leave one place to the planner."
        )
    next_part = amount.next_truck if each and isinstance(amount, Trucks) else amount.part
    receivers: list[Receiver] = []
    # Heaps that nothing is worth it of, the largest first.
    past = 0
    while not watch.stopped and (part := next_part(made, typical)) is not None:
        of_part, rows = job.replace(amount=part[0]), part[1]
        proposals = None
        try:
            with watch.ending():
                of_part = with_toe(of_part, _next_heap(of_part, past) if parts else contour)
                if not parts:
                    judge = () if checked is None else (checked,)
                    compile_ahead(of_part, (*judge, job.world))
                if each or (truck == "auto" and not parts):
                    place = best_place(of_part, site, rows, seed=seed, watch=watch)
                    job, of_part = at_receiver(job, place), at_receiver(of_part, place)
                if isinstance(part[0], Tonnes):
                    # Until loads were planned, by those that could be made.
                    price = _price(parts) if parts else price_of(of_part, seed, watch)
                    of_part = of_part.replace(amount=part[0].replace(price=price))
                watch.best = None
                asked = of_part
                if getattr(chosen, "plays_in_referee", False):
                    asked = of_part.replace(referee=checked)
                proposals = chosen.propose(asked, rows, seed=seed + len(parts), progress=watch)
        except (InputError, NothingWorthIt) as error:
            # Of what was planned already, nothing is lost.
            if not parts:
                raise
            if isinstance(error, InputError) or not part[0].least_load():
                break
            past += 1
            continue
        if proposals is None and watch.best is not None:
            watch("best so far", 0, 1, None)
            proposals = Proposals(watch.best.plan)
        if proposals is None:
            break
        result = choose(of_part, proposals, referee=checked, mend=mend)
        if not len(result.costs):
            break
        past = 0
        parts.append(result)
        receivers.append(of_part.site.placed_receiver)
        # What is planned next is planned on the pile as the referee has it by then, and for what is
        # left to do there.
        played = result.refereed or result
        made = _made_with(made, played)
        job = job.replace(pile=played.rollout.pile)
    if not parts and watch.stopped == "interrupted":
        raise KeyboardInterrupt
    if not parts:
        raise InputError(f"a budget of {budget} loadings is too small for a first plan.")
    receiver = receivers[0]
    if each:
        receiver = jax.tree.map(lambda *leaves: jnp.stack(leaves), *receivers)
    return joined(parts).replace(receiver=receiver, spent=watch.spent, stopped=watch.stopped)


def _next_heap(job: Job, past: int) -> ToeContour | None:
    """The toe of the largest heap but those that were given up; None: that of the largest of all.

    Raises:
        InputError: If no further one is left.
    """
    least = float(job.amount.least_load())
    if not least:
        return None
    smallest = least * KG_PER_TONNE / job.site.soil.density
    heaps = toes_of(job.pile, machine=job.site.machine, smallest=smallest)
    if past >= len(heaps):
        raise InputError("Nothing to dig: no heap is left that is worth it.")
    return heaps[past].contour


def _price(parts: Sequence[PlanResult]) -> float:
    """What a tonne has cost so far."""
    cost = sum(float(part.costs.sum()) for part in parts)
    return cost / sum(float(part.rollout.performance.mass.sum()) for part in parts)


def _made_with(made: Made, result: PlanResult) -> Made:
    truck = result.plan.truck
    trucks = 0 if truck is None else int(np.max(np.asarray(truck), initial=-1)) + 1
    mass = float(result.rollout.performance.mass.sum())
    return Made(made.loads + len(result.costs), made.mass + mass, made.trucks + trucks)


def planner_of(planner: str | Planner, world: World) -> Planner:
    """The planner that is meant by a name, with the settings that suit a world; or itself.

    Raises:
        InputError: If the name is unknown, or the value is no planner.
    """
    if isinstance(planner, str):
        if planner not in planners.NAMES:
            raise InputError(
                f"unknown planner {planner!r}: choose one of {', '.join(planners.NAMES)}."
            )
        kind: Callable[[], Planner] = getattr(planners, planners.class_name(planner))
        by_trial: Callable[[], Planner] = getattr(kind, "by_trial", kind)
        return by_trial() if is_differentiable(world) is False else kind()
    return planners.checked(planner)


def choose(
    job: Job, proposals: Proposals, *, referee: World | None = None, mend: bool = True
) -> PlanResult:
    """The cheapest of a planner's candidates that costs no more than its limit.

    Args:
        job: What was planned for, in the world that planned.
        proposals: What the planner handed over.
        referee: Who picks; None: the job's own world.
        mend: Whether loads that fail in the referee are mended, see `plan_loads`.

    Raises:
        InputError: If no plan has a finite cost.
    """
    rows = _rows(proposals)
    if referee is None:
        seen = judged = outcomes(job, rows)
    else:
        if rows.truck is None and not isinstance(job.amount, Loads):
            # The referee is to fill the trucks that were planned for.
            rows = rows.replace(truck=outcomes(job, rows).plan.truck)
        refereed = job.replace(world=as_pytree(referee))
        judged = outcomes(refereed, rows)
        # The toe is where the referee's pile begins, so the poses are the ones it was played with.
        seen = outcomes(job, judged.plan)
    costs = np.asarray(seen.cost)
    allowed = np.isfinite(np.asarray(judged.cost))
    if proposals.limit is not None and np.isfinite(costs[-1]):
        allowed &= costs <= costs[-1] * (1.0 + _ROUNDING)
    if not allowed.any():
        raise InputError(
            "no plan has a finite cost: check the pile for spikes, and the terms of the objective."
        )
    winner = int(np.argmin(np.where(allowed, np.asarray(judged.cost), np.inf)))
    best = _member(seen, winner)
    if referee is None:
        return _made(job, best)
    played = _member(judged, winner)
    better = mended(refereed, _member(rows, winner), best, played) if mend else None
    if better is not None:
        again = _member(outcomes(job, jax.tree.map(lambda leaf: leaf[None], better.plan)), 0)
        if np.isfinite(float(again.cost)):
            best, played = again, better
    return _made(job, best).replace(refereed=_made(job, played))


def _made(job: Job, result: PlanResult) -> PlanResult:
    """A result without the rows of its plan that are not made."""
    truck = result.plan.truck
    if truck is None:
        return result
    rows = np.flatnonzero(np.asarray(truck) >= 0)
    of_loads = {
        name: jax.tree.map(lambda leaf: leaf[rows], getattr(result, name))
        for name in ("plan", *OF_LOADS)
    }
    performance = jax.tree.map(lambda leaf: leaf[rows], result.rollout.performance)
    made = result.replace(rollout=result.rollout.replace(performance=performance), **of_loads)
    if isinstance(job.amount, Trucks):
        return made
    return made.replace(plan=made.plan.replace(truck=None))


def _rows(proposals: Proposals) -> Decisions | LoadingPlan:
    """All that may be picked, leaves [K, N]: the candidates, and the limit as the last."""
    candidates: Decisions | LoadingPlan
    candidates, limit = proposals
    # The first leaf of either kind is one number a loading.
    if jnp.ndim(jax.tree.leaves(candidates)[0]) == 1:
        candidates = jax.tree.map(lambda leaf: leaf[None], candidates)
    if limit is None:
        return candidates
    rows: Decisions | LoadingPlan = jax.tree.map(
        lambda all_, one: jnp.concatenate([all_, one[None]]), candidates, limit
    )
    return rows


def play(
    world: World,
    pile: Pile,
    plan: LoadingPlan,
    *,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = "efficiency",
    amount: Amount | None = None,
    site: Site | None = None,
    note: Callable[[str], None] = lambda text: None,
    record: Callable[[int, Any], None] = lambda number, record: None,
) -> PlanResult:
    """Plays a fixed plan in a world, for instance one planned in a model in the simulator.

    Args:
        world: World to play in.
        pile: The pile before the first loading.
        plan: Poses and actions, and the trucks that the loads go to where there are some.
        objective: As for `plan_loads`.
        amount: What the plan was to load, for trucks that wait and loads that do not fit them.
        site: Machine, soil and receiver, as for `plan_loads`; of the receiver leaves (K,) where
            each truck of the plan has a place of its own.
        note: Called with what is worth knowing, by worlds that play load by load.
        record: `record(number, record)`, called after each loading, counted from 1, by worlds
            that play load by load, with what they record of it.

    Raises:
        InputError: If the world is a name, the plan makes no sense, a height is not finite, or
            there are fewer places than trucks.
    """
    check_plan(plan)
    given = Loads(len(plan.pose.x)) if amount is None else amount
    job = make_job(world, pile, site=site, objective=objective, amount=given)
    places = receiver_count(job.site.placed_receiver)
    trucks = 0 if plan.truck is None else int(np.max(np.asarray(plan.truck), initial=-1)) + 1
    if places and not 0 < trucks <= places:
        raise InputError(
            f"the site has places for {places} trucks, but the plan is for {trucks}: give one "
            f"place for all of them, or as many."
        )
    if hasattr(job.world, "play_load"):
        return _play_load_by_load(job, plan, note, record)
    dtype = pile.height.dtype
    pose, action = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, dtype)[None], (plan.pose, plan.action)
    )
    truck = None if plan.truck is None else jnp.asarray(plan.truck)[None]
    return _made(job, _member(outcomes(job, LoadingPlan(pose, action, truck)), 0))


def _play_load_by_load(
    job: Job,
    plan: LoadingPlan,
    note: Callable[[str], None],
    record: Callable[[int, Any], None],
) -> PlanResult:
    for text in getattr(job.world, "notes", list)():
        note(text)
    standing, loadings, play_one = beginning(job), [], cast(Any, job.world).play_load
    leaves = None if plan.truck is None else leaves_after(jnp.asarray(plan.truck))
    for n in range(len(plan.pose.x)):
        one, last = jax.tree.map(lambda leaf, n=n: leaf[n], (plan, leaves))
        after, performance, what = play_one(standing.pile, one.pose, one.action, note)
        loading, done = assess(counting(job), standing, one, performance, leaves=last)
        loadings.append(loading)
        standing = Standing(after, done)
        record(n + 1, what)
    return assemble(job, jax.tree.map(lambda *leaves: jnp.stack(leaves), *loadings), standing)


def _member(batch: Any, k: int) -> Any:
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[k]), batch)
