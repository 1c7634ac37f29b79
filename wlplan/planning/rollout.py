"""Long-horizon prediction: Algorithm 1 of the paper as one scan."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
from jax import lax

from wlplan.terrain.excavation import PENETRATION
from wlplan.types import Action, LoadingPlan, Pile, Pose, PyTree, Rollout, World


def rollout(world: World, pile: Pile, plan: LoadingPlan) -> Rollout:
    """Plays a plan in a world.

    Pure: it passes `jit`, `vmap` over plans and piles, `grad` and float64. Reverse mode recomputes
    each loading, so its memory does not grow with what a loading does inside.

    Args:
        world: A model or a simulator.
        pile: The pile before the first loading.
        plan: N loadings in order.

    Returns:
        The performance of each loading and the pile after the last.
    """
    outcome, _ = closed_loop(world, pile, plan, lambda _, loading: (loading.pose, loading.action))
    return outcome


def closed_loop(
    world: World,
    pile: Pile,
    inputs: PyTree,
    decide: Callable[[Pile, PyTree], tuple[Pose, Action]],
) -> tuple[Rollout, LoadingPlan]:
    """Plays loadings that are decided on the pile as it is by then.

    Args:
        world: A model or a simulator.
        pile: The pile before the first loading.
        inputs: What `decide` is given, leaves with leading axis N.
        decide: `decide(pile, inputs_n) -> (pose, action)` of one loading.

    Returns:
        The outcome and the plan that led to it.
    """

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(PENETRATION))
    def load(pile: Pile, inputs_n: PyTree):
        pose, action = decide(pile, inputs_n)
        pile, performance = world(pile, pose, action)
        return pile, (performance, LoadingPlan(pose, action))

    pile, (performance, plan) = lax.scan(load, pile, inputs)
    return Rollout(performance=performance, pile=pile), plan
