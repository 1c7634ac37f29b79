"""The pile after each load of a plan."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from wlplan.planning.playing import played_at
from wlplan.types import LoadingPlan, Pile, World
from wlplan.worlds.capabilities import as_pytree


def heights_after(world: World, pile: Pile, plan: LoadingPlan) -> Float[np.ndarray, "n nx ny"]:
    """Heights as each load leaves them [m].

    Args:
        world: In which the loads are made.
        pile: Before the first load.
        plan: N loads with their poses; a load that goes to no truck (-1) is not made.
    """
    step, found = as_pytree(world), []
    for n in range(len(plan.pose.x)):
        pile = played_at(step, pile, jax.tree.map(lambda leaf, n=n: np.asarray(leaf)[n], plan)).pile
        found.append(np.asarray(pile.height))
    return np.stack(found)
