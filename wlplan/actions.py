"""Random designs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def latin_hypercube(
    points: int, dimensions: int, random: np.random.Generator
) -> Float[np.ndarray, "n d"]:
    """Points in the unit cube, one in each of `points` slices of equal width along every axis."""
    slices = np.stack([random.permutation(points) for _ in range(dimensions)], axis=-1)
    return (slices + random.random(slices.shape)) / points
