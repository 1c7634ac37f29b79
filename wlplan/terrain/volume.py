"""The volume between a surface and its floor."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.types import Pile


def volume(pile: Pile) -> Float[Array, "*batch"]:
    """Volume between the surface and the floor [m^3].

    Signed and linear in the height, so its gradient is one cell area everywhere and a volume
    ledger closes. Works under `jit`, `vmap` and in float64.
    """
    return jnp.sum(pile.height - pile.floor, axis=(-2, -1)) * pile.cell_size**2
