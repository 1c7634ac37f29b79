"""The pile after each load of a plan."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from wlplan.types import LoadingPlan, Pile, World
from wlplan.worlds.capabilities import as_pytree


def heights_after(world: World, pile: Pile, plan: LoadingPlan) -> Float[np.ndarray, "n nx ny"]:
    """Heights as each load leaves them [m].

    Args:
        world: In which the loads are made.
        pile: Before the first load.
        plan: N loads with their poses; a load that goes to no truck (-1) is not made.
    """
    step, truck = as_pytree(world), plan.truck
    found = []
    for n in range(len(plan.pose.x)):
        if truck is None or int(truck[n]) >= 0:
            pose, action = jax.tree.map(lambda leaf, n=n: leaf[n], (plan.pose, plan.action))
            pile = _height_after(step, pile, pose, action)
        found.append(np.asarray(pile.height))
    return np.stack(found)


@jax.jit
def _height_after(world: World, pile: Pile, pose: object, action: object) -> Pile:
    after: Pile = world(pile, pose, action)[0]  # type: ignore[arg-type]
    return after
