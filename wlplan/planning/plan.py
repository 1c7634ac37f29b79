"""Planners: where to dig, at which heading, with which action, for the next N loadings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from wlplan.engines.dem.world import DiscreteElements
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError
from wlplan.planning.job import Decisions, Job, Outcome, ToeJob, judged, outcomes, played
from wlplan.planning.objective import Objective, objective_named
from wlplan.planning.planners.gradient import GradientSettings, gradient
from wlplan.planning.planners.search import Progress, SearchSettings, greedy, nominal
from wlplan.planning.poses import toe_of
from wlplan.planning.transport import Receiver, default_receiver
from wlplan.terrain.toe import ToeContour, toe_contour
from wlplan.types import LoadingPlan, Pile, Rollout, World

__all__ = [
    "PLANNERS",
    "GradientSettings",
    "PlanResult",
    "Progress",
    "SearchSettings",
    "judge",
    "plan_loads",
    "play",
]

PlanResult = Outcome
"""A plan and what it yields and costs in the world it was played in."""

_PLANNERS: dict[str, Callable[..., Decisions]] = {
    "gradient": gradient,
    "greedy": greedy,
    "nominal": nominal,
}
PLANNERS = tuple(_PLANNERS)
"""Names of the planners."""


WITHOUT_GRADIENT = SearchSettings(poses_per_metre=1.0, actions=16, refine_steps=0)
"""How the baselines search in the simulator: by trial alone."""


def plan_loads(
    world: World,
    pile: Pile,
    *,
    loads: int = 15,
    objective: str | Objective = "efficiency",
    planner: str = "gradient",
    receiver: Receiver | None = None,
    seed: int = 0,
    referee: World | None = None,
    progress: Progress | None = None,
    settings: GradientSettings | SearchSettings | None = None,
    contour: ToeContour | None = None,
) -> PlanResult:
    """Plans the next loadings from a pile.

    Args:
        world: World to plan in; differentiable for the gradient planner.
        pile: The pile as it is, relaxed or as scanned.
        loads: Number of loadings.
        objective: Name or weights.
        planner: One of `PLANNERS`.
        receiver: Where the loads go; default: the follow-up's place relative to the pile.
        seed: Of everything random.
        referee: World that plays the planner's best candidates, each dig at the toe of the pile
            as the referee has it by then, and picks the cheapest; the poses of the result are the
            ones it dug at. A candidate that `world` finds dearer than the planner's last, for the
            gradient planner the greedy plan, is out. None: `world` picks, with its own poses.
        progress: Called as the planner advances.
        settings: Of the planner; default: its own, or `WITHOUT_GRADIENT` in the simulator.
        contour: The toe to dig along; default: that of the pile.

    Returns:
        The plan, its rollout in `world`, the transport, the cost, and in `refereed` how the
        referee saw it.

    Raises:
        InputError: If there is nothing to dig, no load is asked for, a name is unknown, or the
            planner needs a gradient that the world does not have.
    """
    if planner not in _PLANNERS:
        raise InputError(f"unknown planner {planner!r}; choose one of {', '.join(PLANNERS)}")
    if loads < 1:
        raise InputError(f"{loads} loads were asked for; ask for at least 1")
    job = ToeJob(
        world=_as_pytree(world),
        pile=pile,
        toe=toe_of(toe_contour(pile) if contour is None else contour, pile.height.dtype),
        receiver=default_receiver(pile) if receiver is None else receiver,
        objective=objective_named(objective),
    )
    if _has_no_gradient(world):
        if planner == "gradient":
            raise InputError(
                "this world plays without derivatives, which the gradient planner needs; "
                "plan in a model, or use the greedy or the nominal planner"
            )
        settings = WITHOUT_GRADIENT if settings is None else settings
    options: dict[str, Any] = {} if settings is None else {"settings": settings}
    candidates = _PLANNERS[planner](job, loads, seed=seed, progress=progress, **options)
    if referee is None:
        seen = outcomes(job, candidates)
        return _member(seen, int(np.nanargmin(np.asarray(seen.cost))))
    # The toe is where the referee's pile begins, so the poses are the ones it was played with.
    judged = outcomes(job.replace(world=_as_pytree(referee)), candidates)
    seen = played(Job(job.world, pile, job.receiver, job.objective), judged.plan)
    costs = np.asarray(seen.cost)
    # Rounding may put a plan that is its own limit above it.
    allowed = costs <= costs[-1] * (1.0 + 1e-6)
    winner = int(np.nanargmin(np.where(allowed, np.asarray(judged.cost), np.inf)))
    return _member(seen, winner).replace(refereed=_member(judged, winner))


def play(
    world: World,
    pile: Pile,
    plan: LoadingPlan,
    *,
    objective: str | Objective = "efficiency",
    receiver: Receiver | None = None,
) -> PlanResult:
    """Plays a fixed plan in a world, for instance one planned in a model in the simulator.

    Args:
        world: World to play in.
        pile: The pile before the first loading.
        plan: Poses and actions.
        objective: Name or weights.
        receiver: Where the loads go; default: the follow-up's place relative to the pile.
    """
    job = Job(
        world=_as_pytree(world),
        pile=pile,
        receiver=default_receiver(pile) if receiver is None else receiver,
        objective=objective_named(objective),
    )
    return _member(played(job, jax.tree.map(lambda leaf: leaf[None], plan)), 0)


def judge(
    outcome: Rollout,
    pile: Pile,
    plan: LoadingPlan,
    *,
    objective: str | Objective = "efficiency",
    receiver: Receiver | None = None,
) -> PlanResult:
    """What a plan costs that was played elsewhere, load by load.

    Args:
        outcome: What came of it.
        pile: The pile before the first loading.
        plan: Poses and actions.
        objective: Name or weights.
        receiver: Where the loads go; default: the follow-up's place relative to the pile.
    """
    return _judged(
        default_receiver(pile) if receiver is None else receiver,
        objective_named(objective),
        plan,
        outcome,
    )


_judged = jax.jit(judged, static_argnums=1)


def _has_no_gradient(world: World) -> bool:
    if isinstance(world, DiscreteElements):
        return True
    return isinstance(world, Simulator) and not world.settings.differentiable


def _member(batch: Outcome, k: int) -> Outcome:
    return jax.tree.map(lambda leaf: leaf[k], batch)


def _as_pytree(world: World) -> World:
    """A world that can be passed to a jitted function: plain functions become a static leaf."""
    leaves = jax.tree.leaves(world)
    return jax.tree_util.Partial(world) if any(callable(leaf) for leaf in leaves) else world
