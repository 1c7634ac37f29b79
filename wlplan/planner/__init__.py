"""Planners: where to dig, at which heading, with which action, for the next N loadings."""

from __future__ import annotations

from typing import Any

import jax

from wlplan.errors import InputError
from wlplan.objective import Objective, objective_named
from wlplan.pile import ToeContour, toe_contour
from wlplan.planner.gradient import GradientSettings, gradient
from wlplan.planner.job import Job, Outcome, play_decisions, play_plan
from wlplan.planner.search import Progress, SearchSettings, greedy, nominal
from wlplan.planner.toe import toe_of
from wlplan.transport import Receiver, default_receiver
from wlplan.types import LoadingPlan, Pile, World

__all__ = [
    "PLANNERS",
    "GradientSettings",
    "PlanResult",
    "Progress",
    "SearchSettings",
    "plan_loads",
    "play",
]

PlanResult = Outcome
"""A plan and what it yields and costs in the world it was played in."""

_PLANNERS = {"gradient": gradient, "greedy": greedy, "nominal": nominal}
PLANNERS = tuple(_PLANNERS)
"""Names of the planners."""


def plan_loads(
    world: World,
    pile: Pile,
    *,
    loads: int = 15,
    objective: str | Objective = "efficiency",
    planner: str = "gradient",
    receiver: Receiver | None = None,
    seed: int = 0,
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
        progress: Called as the planner advances.
        settings: Of the planner; default: its own.
        contour: The toe to dig along; default: that of the pile.

    Returns:
        The plan, its rollout in `world`, the transport, and the cost.

    Raises:
        InputError: If there is nothing to dig, no load is asked for, or a name is unknown.
    """
    if planner not in _PLANNERS:
        raise InputError(f"unknown planner {planner!r}; choose one of {', '.join(PLANNERS)}")
    if loads < 1:
        raise InputError(f"{loads} loads were asked for; ask for at least 1")
    job = _job(world, pile, objective, receiver, contour)
    options: dict[str, Any] = {} if settings is None else {"settings": settings}
    decisions = _PLANNERS[planner](job, loads, seed=seed, progress=progress, **options)
    return jax.jit(play_decisions)(job, decisions)


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
    return jax.jit(play_plan)(_job(world, pile, objective, receiver, None, toe=False), plan)


def _job(
    world: World,
    pile: Pile,
    objective: str | Objective,
    receiver: Receiver | None,
    contour: ToeContour | None,
    *,
    toe: bool = True,
) -> Job:
    return Job(
        world=_as_pytree(world),
        pile=pile,
        toe=toe_of(contour or toe_contour(pile), pile.height.dtype) if toe else None,
        receiver=default_receiver(pile) if receiver is None else receiver,
        objective=objective_named(objective),
    )


def _as_pytree(world: World) -> World:
    """A world that can be passed to a jitted function: plain functions become a static leaf."""
    leaves = jax.tree.leaves(world)
    return jax.tree_util.Partial(world) if any(callable(leaf) for leaf in leaves) else world
