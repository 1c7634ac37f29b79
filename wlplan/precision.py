"""The precision of arrays that enter JAX."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def floats(values: np.ndarray) -> Array:
    """float32, or float64 under `jax_enable_x64`, without a warning from the conversion."""
    return jnp.asarray(values.astype(jnp.zeros(()).dtype))
