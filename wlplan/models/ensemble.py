"""Ensembles of performance predictors: their mean, and how far it may be off.

The spread among the members alone tells what the data leave open, and is several times too small:
it knows nothing of what the inputs do not tell about a loading. So each member has a second layer
of outputs for the variance of its own error (Nix and Weigend 1994), and the variance of the
ensemble is the mean of theirs and the variance among them (Lakshminarayanan et al. 2017). One
factor for each output, fitted to cycles that the training did not see, is left to correct.
"""

from __future__ import annotations

from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from wlplan.models.performance import PerformanceModel
from wlplan.models.performance_high import HighPerformanceModel
from wlplan.types import LocalHeightmap, Performance

PERCENT_90 = 1.6449
"""Standard deviations on either side that hold 90 % of a normal distribution."""


@no_type_check
class Ensemble(struct.PyTreeNode):
    """Trained ψ_low or ψ_high that differ in the seed alone. A pytree: all weights are leaves."""

    members: PerformanceModel | HighPerformanceModel  # weights with a leading axis
    factor: Float[Array, "3"]  # of the standard deviation of mass, time and work [1]

    @property
    def size(self) -> int:
        """Number of members."""
        return len(jax.tree.leaves(self.members.params)[0])

    def __call__(
        self, view: Float[Array, "4"] | LocalHeightmap, action: Float[Array, "4"]
    ) -> Performance:
        """Mean of the performance that the members predict.

        Args:
            view: What the members look at: the characteristics, or the local heightmap.
            action: Parameters of the bucket-filling controller.
        """
        members: Any = self.members
        each = jax.vmap(lambda params: members.replace(params=params)(view, action))(members.params)
        return jax.tree.map(lambda values: values.mean(axis=0), each)

    def with_deviation(
        self, view: Float[Array, "4"] | LocalHeightmap, action: Float[Array, "4"]
    ) -> tuple[Performance, Performance]:
        """Mean performance, and the standard deviation of its error [tonne, s, kJ].

        An interval of `PERCENT_90` deviations on either side holds nine in ten simulated cycles
        of the kind that the members were trained on. Differentiable, as the mean is.

        Args:
            view: As for a call.
            action: As for a call.
        """
        members: Any = self.members
        each, own = jax.vmap(
            lambda params: members.replace(params=params).with_variance(view, action)
        )(members.params)

        def deviation(values: Array, variances: Array, factor: Array) -> Array:
            return factor * jnp.sqrt(variances.mean(axis=0) + values.var(axis=0, ddof=1))

        return (
            jax.tree.map(lambda values: values.mean(axis=0), each),
            jax.tree.map(deviation, each, own, Performance(*self.factor)),
        )


def members_of(model: Any) -> Any:
    """The members of an ensemble; any other model itself."""
    return model.members if isinstance(model, Ensemble) else model
