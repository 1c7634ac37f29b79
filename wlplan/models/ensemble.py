"""Ensembles of performance predictors: their mean, and the standard deviation of its error.

The spread among the members alone shows what the data leave open, and is several times too small:
it knows nothing of what the inputs do not say about a loading. So each member has a second layer
of outputs for the variance of its own error (Nix and Weigend 1994), and the variance of the
ensemble is the mean of theirs and the variance among them (Lakshminarayanan et al. 2017). One
factor for each output, fitted to cycles that the training did not see, is left to correct.

Huber's loss leads a network between the median of what may happen and its mean: of a loading that
may stall it foretells less time than such loadings take on average, and sums over many come out
short. So a part of the deviation is added to time and work, fitted to the same cycles: where
nothing is uncertain nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

# Here it is looked for; who only prints takes it from there, without JAX.
from wlplan.constants import PERCENT_90 as PERCENT_90
from wlplan.models.performance import PerformanceModel
from wlplan.types import Characteristics, LocalHeightmap, Performance

# Members that have a spread among them.
_FEWEST = 2


@no_type_check
class Ensemble(struct.PyTreeNode, eq=False):
    """Trained ψ_low or ψ_high that differ in the seed alone. A pytree: all weights are leaves.

    What they look at is worked out once for all members, see `PerformanceModel.view`.
    """

    members: PerformanceModel  # weights with a leading axis
    factor: Float[Array, "3"]  # of the standard deviation of mass, time and work [1]
    bias: Float[Array, "3"]  # what is added to each, in such deviations before the factor [1]

    @property
    def size(self) -> int:
        """Number of members."""
        return len(jax.tree.leaves(self.members.params)[0])

    def roughly(self) -> Ensemble:
        """The first members alone: as many as a spread among them takes."""
        params = jax.tree.map(lambda leaf: leaf[:_FEWEST], self.members.params)
        return self.replace(members=self.members.replace(params=params))

    @property
    def view_variable(self) -> str:
        """Name of the variable of a data set that holds the views."""
        return self.members.view_variable

    @property
    def faces_seen(self) -> tuple[Characteristics, Characteristics]:
        """The least and the largest characteristics of the training data, shared by all members."""
        return self.members.faces_seen

    def __call__(self, local: LocalHeightmap, action: Float[Array, "4"]) -> Performance:
        """Mean of the performance that the members predict, with the bias that sums need.

        Args:
            local: Local heightmap of 36 × 36 cells.
            action: Parameters of the bucket-filling controller.

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """
        return self.of_view(self.members.view(local), action)

    def with_deviation(
        self, local: LocalHeightmap, action: Float[Array, "4"]
    ) -> tuple[Performance, Performance]:
        """Mean performance, and the standard deviation of its error [tonne, s, kJ].

        An interval of `PERCENT_90` deviations on either side holds nine in ten simulated cycles
        of the kind that the members were trained on. Differentiable, as the mean is.

        Args:
            local: As for a call.
            action: As for a call.

        Raises:
            InputError: As for a call.
        """
        return self.of_view_with_deviation(self.members.view(local), action)

    def of_view(self, view: Array, action: Float[Array, "4"]) -> Performance:
        """The same as a call, from the view of the local heightmap.

        Args:
            view: See `PerformanceModel.view`.
            action: As for a call.
        """
        return self.of_view_with_deviation(view, action)[0]

    def of_view_with_deviation(
        self, view: Array, action: Float[Array, "4"]
    ) -> tuple[Performance, Performance]:
        """The same as `with_deviation`, from the view of the local heightmap.

        Args:
            view: See `PerformanceModel.view`.
            action: As for a call.
        """
        each, own = self._by_each(lambda member: member.of_view_with_variance(view, action))
        spread = jax.tree.map(
            lambda values, variances: jnp.sqrt(variances.mean(axis=0) + values.var(axis=0, ddof=1)),
            each,
            own,
        )
        mean = jax.tree.map(
            lambda values, spread, bias: values.mean(axis=0) + bias * spread,
            each,
            spread,
            Performance(*self.bias),
        )
        deviation = jax.tree.map(lambda k, spread: k * spread, Performance(*self.factor), spread)
        return mean, deviation

    def _by_each(self, predict: Callable[[PerformanceModel], Any]) -> Any:
        """What each member makes of the same inputs, with a leading axis."""
        return jax.vmap(lambda params: predict(self.members.replace(params=params)))(
            self.members.params
        )


def members_of(model: Any) -> Any:
    """The members of an ensemble; any other model itself."""
    return model.members if isinstance(model, Ensemble) else model
