"""The floor under a pile, and the volume between it and the surface: JAX functions."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.types import Pile


def ground_height(pile: Pile) -> Float[Array, "*batch nx ny"]:
    """Floor under the pile [m], world frame; level 0 where the pile carries no ground map."""
    return jnp.zeros_like(pile.height) if pile.ground is None else pile.ground


def volume(pile: Pile) -> Float[Array, "*batch"]:
    """Volume between the surface and the ground [m^3].

    Signed and linear in the height, so its gradient is one cell area everywhere and a volume
    ledger closes. Works under `jit`, `vmap` and in float64.
    """
    return jnp.sum(pile.height - ground_height(pile), axis=(-2, -1)) * pile.cell_size**2
