"""Where XLA needs help: arrays that are materialized, or come from numpy; the cores it may use."""

from __future__ import annotations

import os

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.types import PyTree


def materialize_if(values: PyTree, wanted: Bool[Array, ""], *, otherwise: float = 0.0) -> PyTree:
    """Have XLA store arrays instead of computing them anew in each operation that uses them.

    On a CPU XLA fuses an array into all its uses, and computes it for each element of a larger
    array that it is part of. A branch stops that. On other devices, where a branch costs more than
    it saves, the values are returned unchanged, whether wanted or not.

    Args:
        values: Pytree of arrays of any shapes.
        wanted: Whether the values are needed; must not be known at compile time.
        otherwise: What the arrays are filled with, on a CPU, if they are not wanted.
    """
    if jax.default_backend() != "cpu":
        return values

    def unwanted(values: PyTree) -> PyTree:
        return jax.tree.map(lambda leaf: jnp.full_like(leaf, otherwise), values)

    return lax.cond(wanted, lambda values: values, unwanted, values)


def materialize(values: PyTree, source: Float[Array, ""]) -> PyTree:
    """`materialize_if` for arrays that are always needed.

    Args:
        values: Pytree of arrays of any shapes.
        source: A number that the values are computed from, for instance one of the heights: XLA
            cannot know it at compile time. If it is NaN the values become NaN too. It must be
            shared by all members of a batch: a branch that differs among them is no branch.
    """
    return materialize_if(values, source == source, otherwise=float("nan"))


def on_device(values: Array | np.ndarray | np.generic) -> Array:
    """An array of numpy's as one of JAX's; `jnp.asarray` would compile for each shape."""
    array: Array = jax.device_put(values)
    return array


def floats(values: np.ndarray) -> Array:
    """float32, or float64 under `jax_enable_x64`, without a warning from the conversion."""
    return on_device(values.astype(jax.dtypes.canonicalize_dtype(float)))


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
