"""Long-horizon prediction: Algorithm 1 of the paper as one scan."""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax import lax

from wlplan.checks import check_pile, check_plan, check_world
from wlplan.terrain.excavation import PENETRATION
from wlplan.types import LoadingPlan, Performance, Pile, PyTree, Rollout, World
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
    def load(pile: Pile, loading: LoadingPlan) -> tuple[Pile, Performance]:
        return world(pile, loading.pose, loading.action)

    after, performance = load_by_load(load, pile, plan)
    return Rollout(performance=performance, pile=after)


def load_by_load(
    load: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], state: PyTree, inputs: PyTree
) -> tuple[PyTree, PyTree]:
    """Plays loadings one after the other; reverse mode recomputes each.

    Args:
        load: `load(state, inputs_n) -> (state_after, record)` of one loading.
        state: Before the first: the pile, and what else there is to carry along.
        inputs: What loadings are given, leaves with leading axis N.

    Returns:
        The state after the last loading, and the records, leaves with leading axis N.
    """
    policy = jax.checkpoint_policies.save_only_these_names(PENETRATION)
    return lax.scan(jax.checkpoint(load, policy=policy), state, inputs)
