"""Cycles of a data set simulated again, from the local maps that it holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wlplan.dataset import Dataset
from wlplan.types import Action, action_from

# Cycles computed side by side.
_BATCH = 64


def initial_surfaces(data: Dataset) -> Float[np.ndarray, "n 52 52"]:
    """Surfaces over the floor in the local frames of the dig poses [m].

    The maps of a data set are over the surface 1 m before the dig location. The floor of the piles
    is level, and the lowest point of a map is taken to lie on it.
    """
    surfaces: np.ndarray = data.h52 - data.h52.min(axis=(1, 2), keepdims=True)
    return surfaces


def resimulate(
    function: Callable[[jax.Array, jax.Array, Action], Any],
    surface: Float[np.ndarray, "n 52 52"],
    action: Float[np.ndarray, "n 4"],
) -> Any:
    """`function(surface, floor, action)` of every cycle, batch by batch, as numpy arrays.

    Args:
        function: `dig`, `trace`, or what is made of them.
        surface: Surfaces in the local frames over a level floor at 0 [m].
        action: Parameters of the bucket-filling controller.
    """

    @jax.jit
    @jax.vmap
    def batch(height: jax.Array, vector: jax.Array) -> Any:
        return function(height, jnp.zeros_like(height), action_from(vector))

    parts = []
    for first in range(0, len(surface), _BATCH):
        # The last batch is filled up, so that nothing is compiled twice.
        which = np.minimum(np.arange(first, first + _BATCH), len(surface) - 1)
        part = batch(
            jnp.asarray(surface[which], jnp.float32), jnp.asarray(action[which], jnp.float32)
        )
        count = min(_BATCH, len(surface) - first)
        parts.append(jax.tree.map(lambda leaf, count=count: np.asarray(leaf)[:count], part))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
