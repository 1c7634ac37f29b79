"""Trees in double precision, in which finite differences can be compared with gradients."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def in_float64(tree: Any) -> Any:
    """The same values in float64; to be called where JAX allows them."""

    def widen(leaf: Any) -> Any:
        is_float = jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
        return jnp.asarray(np.asarray(leaf), jnp.float64) if is_float else leaf

    return jax.tree.map(widen, tree)
