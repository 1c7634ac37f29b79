"""Actions inside their box: squashed from any number, and designs that fill the box."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.types import Action, action_from

_LOW = np.asarray(ACTION_LOW)
_RANGE = np.asarray(ACTION_HIGH) - _LOW


def squash(raw: Float[Array, "4"]) -> Action:
    """Action inside its box."""
    low, span = jnp.asarray(_LOW, raw.dtype), jnp.asarray(_RANGE, raw.dtype)
    return action_from(low + jax.nn.sigmoid(raw) * span)


def unsquash(part: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Inverse of `squash` for parts of the box; its edges are moved in by a hundredth."""
    part = np.clip(part, 0.01, 0.99)
    return np.log(part / (1.0 - part))


def latin_hypercube(
    points: int, dimensions: int, random: np.random.Generator
) -> Float[np.ndarray, "n d"]:
    """Points in the unit cube, one in each of `points` slices of equal width along every axis."""
    slices = np.stack([random.permutation(points) for _ in range(dimensions)], axis=-1)
    return (slices + random.random(slices.shape)) / points


def spread_actions(count: int, random: np.random.Generator, dtype: np.dtype) -> Float[Array, "n 4"]:
    """Actions, before squashing, that fill the box evenly."""
    # `jnp.asarray` would compile for each shape.
    actions: Array = jax.device_put(unsquash(latin_hypercube(count, 4, random)).astype(dtype))
    return actions
