"""Loads that failed, though nothing of it was foreseen, made with actions that worked at others.

A stall hangs on things that a model does not see, such as a floor that falls away under the pile:
there it foresees nothing, and no caution helps. Who plays the plan sees it. Plans as a whole give
little choice, since each has a load or two that fails; so loads are mended one by one.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool

from wlplan.parallel import ParallelMap
from wlplan.planning.job import Decisions, Job, Standing, beginning
from wlplan.planning.playing import (
    LoadMade,
    LoadOfPlan,
    PlanResult,
    assemble_loads,
    loads_of,
    make_load,
)
from wlplan.types import Action, LoadingPlan, Performance
from wlplan.xla import on_device

# A load has failed if its filling takes so many times as long as foreseen, or brings so little of
# the mass. A stall takes more than twice as long. The cost is no measure of that: it has the way in
# it, which is another on the pile as it is.
_SLOW, _LIGHT = 1.5, 0.75
# Actions that are tried at most.
_TRIED = 8


def mended(
    referee: Job, plan: Decisions | LoadingPlan, foreseen: PlanResult, played: PlanResult
) -> PlanResult | None:
    """The plan with other actions for the loads that fail, as the referee plays it.

    It is played once more. Where a load fails, actions of the loads that went well are tried on
    the pile as it is by then, and the cheapest load is made.

    Args:
        referee: The job in the world that plays.
        plan: What was played, leaves [N].
        foreseen: The plan in the world that planned.
        played: The plan in the referee.

    Returns:
        The plan with its new actions in the referee; None if nothing failed, nothing went well, or
        it is not cheaper than what was played.
    """
    made = np.ones(len(played.costs), bool) if plan.truck is None else np.asarray(plan.truck) >= 0
    hoped = foreseen.rollout.performance
    failed = made & _failed(hoped, played.rollout.performance)
    well = np.flatnonzero(made & ~failed)
    if not failed.any() or not len(well):
        return None
    well = well[np.argsort(np.asarray(played.costs)[well])][:_TRIED]
    actions = _row(plan.action, well)
    standing, loads = beginning(referee), []
    for number, load in enumerate(loads_of(plan)):
        one = make_load(referee, standing, load)
        if made[number] and _failed(_row(hoped, number), one.assessed.performance):
            one = _cheapest(one, _with_actions((referee, standing, load), actions))
        loads.append(one)
        standing = one.standing
    better = assemble_loads(referee, loads)
    return better if float(better.cost) < float(played.cost) else None


def _failed(hoped: Performance, found: Performance) -> Bool[np.ndarray, "*n"]:
    slow = np.asarray(found.time) > _SLOW * np.asarray(hoped.time)
    light = np.asarray(found.mass) < _LIGHT * np.asarray(hoped.mass)
    return np.asarray(slow | light)


def _cheapest(own: LoadMade, tried: LoadMade) -> LoadMade:
    """The cheapest of a load and others in its place, leaves [k]."""
    costs = np.array([own.assessed.cost, *tried.assessed.cost])
    best = int(np.nan_to_num(costs, nan=np.inf).argmin())
    return own if best == 0 else _row(tried, best - 1)


def _row(tree: Any, row: Any) -> Any:
    return jax.tree.map(lambda leaf: on_device(np.asarray(leaf)[row]), tree)


def _with_action(shared: tuple[Job, Standing, LoadOfPlan], action: Action | Array) -> LoadMade:
    referee, standing, load = shared
    return make_load(referee, standing, load._replace(one=load.one.replace(action=action)))


_with_actions = ParallelMap(_with_action, on_core=_with_action)
