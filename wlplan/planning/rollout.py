"""Long-horizon prediction: Algorithm 1 of the paper as one scan."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
from jax import lax

from wlplan.checks import check_pile, check_plan, check_world
from wlplan.terrain.excavation import PENETRATION
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose, PyTree, Rollout, World
from wlplan.worlds.capabilities import as_pytree


def rollout(world: World, pile: Pile, plan: LoadingPlan) -> Rollout:
    """Plays a plan in a world.

    Pure: it passes `jit`, `vmap` over plans and piles, `grad` and float64. Called as it is, it is
    compiled once for each shape of its arguments. Reverse mode recomputes each loading, so its
    memory does not grow with what a loading does inside.

    Args:
        world: A model or a simulator.
        pile: The pile before the first loading.
        plan: N loadings in order.

    Returns:
        The performance of each loading and the pile after the last.

    Raises:
        InputError: If the world is a name, a height or a pose is not finite, a heading is beyond
            one turn, or an action is outside its box; not under a trace, where values are unknown.
    """
    check_world(world)
    check_pile(pile)
    check_plan(plan)
    outcome: Rollout = _rollout(as_pytree(world), pile, plan)
    return outcome


@jax.jit
def _rollout(world: World, pile: Pile, plan: LoadingPlan) -> Rollout:
    def decide(_: Pile, loading: LoadingPlan) -> tuple[Pose, Action]:
        return loading.pose, loading.action

    def performance_of(_: Pile, __: Pose, ___: Action, performance: Performance) -> Performance:
        return performance

    after, performance = closed_loop(world, pile, plan, decide, performance_of)
    return Rollout(performance=performance, pile=after)


def closed_loop(
    play: Callable[..., tuple[PyTree, ...]],
    pile: Pile,
    inputs: PyTree,
    decide: Callable[[Pile, PyTree], tuple[Pose, Action]],
    record: Callable[..., PyTree],
) -> tuple[Pile, PyTree]:
    """Plays loadings that are decided on the pile as it is by then.

    Args:
        play: A world, or its `solve`: `play(pile, pose, action) -> (pile_after, *outcome)`.
        pile: The pile before the first loading.
        inputs: What `decide` is given, leaves with leading axis N.
        decide: `decide(pile, inputs_n) -> (pose, action)` of one loading.
        record: `record(pile_before, pose, action, *outcome)`: what is kept of a loading.

    Returns:
        The pile after the last loading, and the records, leaves with leading axis N.
    """

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(PENETRATION))
    def load(pile: Pile, inputs_n: PyTree) -> tuple[Pile, PyTree]:
        pose, action = decide(pile, inputs_n)
        after, *outcome = play(pile, pose, action)
        return after, record(pile, pose, action, *outcome)

    return lax.scan(load, pile, inputs)
