"""Loading cycles of the data set's protocol, on piles that were dug before."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wlplan.constants import CELL_SIZE
from wlplan.dataset.episode import Episode, choose_pose
from wlplan.engines.simulator import Simulator
from wlplan.types import Pile, Pose, action_from


class Cycles(NamedTuple):
    """Cycles, one a row."""

    height: Float[np.ndarray, "n nx ny"]  # of the piles before [m]
    origin: Float[np.ndarray, "n 2"]  # of the piles [m]
    vector: Float[np.ndarray, "n 7"]  # pose [m, m, rad] and action


def random_cycles(rollouts: int, loads: int, *, seed: int) -> Cycles:
    """Random loadings in a row, in the precision that JAX has at the time.

    Args:
        rollouts: Piles.
        loads: Loadings of each.
        seed: Of piles, poses and actions.
    """
    simulator = Simulator()
    play = jax.jit(lambda pile, pose, action: simulator(pile, pose, action)[0].height)
    heights, origins, vectors = [], [], []
    for number in range(rollouts):
        episode = Episode(number, seed, loads, simulator)
        episode.reset()
        height, origin = episode.height, episode.origin
        for load in range(loads):
            pile = Pile(height, CELL_SIZE, origin)
            pose = choose_pose(pile, episode.place[load], episode.turn[load])
            if pose is None:
                break
            action = episode.action[load]
            heights.append(np.asarray(height))
            origins.append(np.asarray(origin))
            vectors.append(np.concatenate([pose, action]))
            height = play(pile, Pose(*jnp.asarray(pose)), action_from(jnp.asarray(action)))
    return Cycles(*map(np.array, (heights, origins, vectors)))
