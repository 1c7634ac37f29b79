"""Derivatives of functions of a loading, per step of a planner, and how well they agree."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments._common.cycles import Cycles
from wlplan.constants import CELL_SIZE
from wlplan.studies import COMPONENTS, Differenced, LoadingYield
from wlplan.types import Pile, Pose, World, action_from

# The way ahead is apart: poses lie on the toe, so a planner does not move there by itself.
PARTS = {
    "action": slice(3, 7),
    "aside and turn": slice(1, 3),
    "ahead": slice(0, 1),
    "all": slice(0, 7),
}
# Half width of differences that stand for a derivative, in steps.
NARROW = 1e-5
# Resamplings of the cycles for an interval, and their seed.
_RESAMPLED, _SEED = 1000, 7


def yield_of(world: World, cycles: Cycles, number: int) -> LoadingYield:
    """Mass, time and work around a cycle."""
    height, origin, vector = (jnp.asarray(part[number]) for part in cycles)
    pile = Pile(height, CELL_SIZE, origin)
    return LoadingYield(world, pile, Pose(*vector[:3]), action_from(vector[3:]))


@jax.jit
def differences(function: Any) -> Float[Array, "k 7"]:
    """Central differences over one step of each component either way."""
    return _differenced(function, 1.0)


@jax.jit
def derivatives(function: Any) -> Float[Array, "k 7"]:
    """Derivatives by narrow central differences.

    In float64. `experiments.simulator_gradients` has them beside reverse mode.
    """
    return _differenced(function, NARROW)


def _differenced(function: Any, width: float) -> Array:
    here = jnp.zeros(len(COMPONENTS))
    slopes: Array = Differenced(function, width).jacobian(here)
    return slopes


def cosines(
    gradients: Float[np.ndarray, "n k"], differences: Float[np.ndarray, "n k"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Cosines between gradients and differences, and how many times as long the gradients are.

    A gradient that is zero points nowhere: its cosine counts as 0. Cycles without differences, in
    which nothing is to be found, are left out.
    """
    sizes = np.linalg.norm(gradients, axis=1), np.linalg.norm(differences, axis=1)
    some = sizes[1] > 0.0
    products = (gradients * differences).sum(axis=1)[some]
    of_angles = products / np.maximum((sizes[0] * sizes[1])[some], 1e-300)
    return of_angles, sizes[0][some] / sizes[1][some]


def agreement(
    gradients: Float[np.ndarray, "n k"], differences: Float[np.ndarray, "n k"]
) -> dict[str, Any]:
    """Mean cosine with its interval of 90 %, and the share above 0, see `cosines`."""
    found, _ = cosines(gradients, differences)
    random = np.random.default_rng(_SEED)
    means = random.choice(found, (_RESAMPLED, len(found))).mean(axis=1)
    return {
        "cycles": len(found),
        "mean": float(found.mean().round(4)),
        "interval": np.percentile(means, [5.0, 95.0]).round(4).tolist(),
        "median": float(np.median(found).round(4)),
        "positive": float((found > 0.0).mean().round(4)),
    }
