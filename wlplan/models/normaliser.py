"""Scaling of inputs and outputs to the range of the training data."""

from __future__ import annotations

from typing import no_type_check

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float


@no_type_check
class Normaliser(struct.PyTreeNode):
    """Maps the range of the training data to [0, 1], component by component. Paper, section 6.4."""

    low: Float[Array, " k"]
    span: Float[Array, " k"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n k"]) -> Normaliser:
        """The normaliser of a table; a component that never changes is only shifted."""
        low = values.min(axis=0)
        span = values.max(axis=0) - low
        return cls(jnp.asarray(low), jnp.asarray(np.where(span > 0.0, span, np.ones_like(span))))

    def normalise(self, values: Float[Array, " k"]) -> Float[Array, " k"]:
        """One vector in units of the range; outside it the units go on linearly."""
        return (values - self.low) / self.span

    def denormalise(self, values: Float[Array, " k"]) -> Float[Array, " k"]:
        """The inverse of `normalise`."""
        return self.low + values * self.span
