"""Derivatives of functions of a loading, per step of a planner."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.studies import COMPONENTS
from wlplan.worlds.capabilities import with_derivatives


@jax.jit
def differences(function: Any) -> Float[Array, "k 7"]:
    """Central differences over one step of each component either way."""
    away = jnp.eye(len(COMPONENTS))
    ahead, behind = jnp.split(jax.vmap(function)(jnp.concatenate([away, -away])), 2)
    return (0.5 * (ahead - behind)).T


@jax.jit
def jacobian(function: Any) -> Float[Array, "k 7"]:
    """Derivatives by reverse mode."""
    exact: Array = jax.jacrev(with_derivatives(function))(jnp.zeros(len(COMPONENTS)))
    return exact
