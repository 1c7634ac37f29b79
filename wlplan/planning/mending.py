"""Loads that failed, though nothing of it was foreseen, made with actions that worked at others.

A stall hangs on things that a model does not see, such as a floor that falls away under the pile:
there it foresees nothing, and no caution helps. Who plays the plan sees it. Plans as a whole give
little choice, since each has a load or two that fails; so loads are mended one by one.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from wlplan.planning.job import Decisions, Job
from wlplan.planning.playing import PlanResult, outcomes
from wlplan.types import LoadingPlan

# A load has failed if its filling takes so many times as long as foreseen, or brings so little of
# the mass. A stall takes more than twice as long. The cost is no measure of that: it has the way in
# it, which is another on the pile as it is.
_SLOW, _LIGHT = 1.5, 0.75
# Actions that are tried at most.
_TRIED = 8


def mended(
    referee: Job, plan: Decisions | LoadingPlan, foreseen: PlanResult, played: PlanResult
) -> PlanResult | None:
    """The plan with other actions for the loads that failed, as the referee plays it.

    Actions of the loads that went well are tried at all that did not, each in a play of the whole
    plan; of each load the one that was cheapest there goes into one more plan.

    Args:
        referee: The job in the world that plays.
        plan: What was played, leaves [N].
        foreseen: The plan in the world that planned.
        played: The plan in the referee.

    Returns:
        The cheapest of these plans in the referee; None if none is cheaper than what was played.
    """
    costs = np.asarray(played.costs)
    own = np.arange(len(costs))
    made = np.ones(len(own), bool) if plan.truck is None else np.asarray(plan.truck) >= 0
    hoped, found = (one.rollout.performance for one in (foreseen, played))
    slow = np.asarray(found.time) > _SLOW * np.asarray(hoped.time)
    failed = made & (slow | (np.asarray(found.mass) < _LIGHT * np.asarray(hoped.mass)))
    well = np.flatnonzero(made & ~failed)
    if not failed.any() or not len(well):
        return None
    well = well[np.argsort(costs[well])][:_TRIED]
    # Whose action each load has, in every plan that is tried.
    rows = np.where(failed, well[:, None], own)
    tried = _play(referee, plan, rows)
    at_load = np.concatenate([costs[None], np.asarray(tried.costs)])
    cheapest = np.nan_to_num(at_load, nan=np.inf).argmin(axis=0)
    last = np.where(failed, np.concatenate([own[None], rows])[cheapest, own], own)
    both = jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves), tried, _play(referee, plan, last[None])
    )
    totals = np.nan_to_num(np.asarray(both.cost), nan=np.inf)
    best = int(totals.argmin())
    if not totals[best] < float(played.cost):
        return None
    one: PlanResult = jax.tree.map(lambda leaf: leaf[best], both)
    return one


def _play(referee: Job, plan: Decisions | LoadingPlan, rows: Int[np.ndarray, "k n"]) -> PlanResult:
    """Plays the plan with actions of other loads of it."""

    def with_actions(of: Int[np.ndarray, " n"]) -> Any:
        return plan.replace(action=jax.tree.map(lambda leaf: leaf[of], plan.action))

    plans = [with_actions(of) for of in rows]
    found: PlanResult = outcomes(referee, jax.tree.map(lambda *leaves: jnp.stack(leaves), *plans))
    return found
