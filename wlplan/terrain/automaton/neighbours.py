"""The eight neighbours of every cell of a grid, and which of them exchange soil."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, UInt8

# Bit k of a cell's links stands for neighbour k.
NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))
BITS = tuple(np.uint8(1 << k) for k in range(len(NEIGHBOURS)))


def rim(field: Array) -> Array:
    """The field with its border mirrored, one cell all around."""
    return jnp.pad(field, 1, mode="edge")


def neighbour(rimmed: Array, i: int, j: int) -> Array:
    """The value of the neighbour at offset (i, j) of every cell inside the rim."""
    n, m = rimmed.shape
    return lax.slice(rimmed, (1 + i, 1 + j), (n - 1 + i, m - 1 + j))


def links_of(active: Array) -> UInt8[Array, "nx ny"]:
    """Which neighbours each cell can exchange soil with, as bits: both have to take part."""
    around = rim(active)
    packed = jnp.zeros(active.shape, jnp.uint8)
    for (i, j), bit in zip(NEIGHBOURS, BITS, strict=True):
        packed = packed | jnp.where(active & neighbour(around, i, j), bit, np.uint8(0))
    return packed
