"""What the performance predictors share: their signature and what holds their outputs. Paper, 4.4.

Every ψ is called alike, `ψ(local, action) -> performance`: what a loading yields and costs. The
local heightmap has 36 × 36 cells; the action is `wlplan.types.action_vector` of one.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct
from jaxtyping import Array, Float

from wlplan.models.layers import StandardisedMlp
from wlplan.models.normaliser import Normaliser
from wlplan.types import Characteristics, LocalHeightmap, Performance

INPUTS = 8
"""What is known besides the map: the four characteristics, then the four parameters of the action.
"""
OUTPUTS = 3
"""Outputs: mass, time and work."""

# Least output, and width of the bend above it, in units of the range of the training data.
_LEAST, _BEND = 0.001, 0.01


@no_type_check
class PerformanceModel(struct.PyTreeNode, abc.ABC, eq=False):
    """A trained performance predictor ψ. A pytree: weights and normalisers are leaves.

    It looks at a local heightmap by its `view`: an array, which data sets store. Whoever has the
    view already calls `of_view`.

    The weights are float32; with float64 inputs the arithmetic is in float64.

    Attributes:
        view_variable: Name of the variable of a data set that holds the views.
    """

    view_variable: ClassVar[str]

    params: nnx.State[Any, Any]
    inputs: Normaliser  # characteristics [rad, rad, 1/m, 1/m], then action
    outputs: Normaliser  # mass [tonne], time [s], work [kJ]
    graph: nnx.GraphDef[Any] = struct.field(pytree_node=False)

    def __call__(self, local: LocalHeightmap, action: Float[Array, "4"]) -> Performance:
        """Performance of one loading; deterministic and differentiable.

        Inputs are held near the range of the training data, see `wlplan.models.layers.soft_clamp`,
        outputs to what is possible, see `bounded_performance`.

        Args:
            local: Local heightmap of 36 × 36 cells.
            action: Parameters of the bucket-filling controller.

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """
        return self.of_view(self.view(local), action)

    @property
    def faces_seen(self) -> tuple[Characteristics, Characteristics]:
        """The least and the largest characteristics of the training data."""
        count = len(dataclasses.fields(Characteristics))
        first, span = np.asarray(self.inputs.low), np.asarray(self.inputs.span)
        ends = first, first + span
        low, high = (Characteristics(*(float(value) for value in end[:count])) for end in ends)
        return low, high

    @abc.abstractmethod
    def view(self, local: LocalHeightmap) -> Array:
        """What the model looks at of a local heightmap.

        Args:
            local: Local heightmap of 36 × 36 cells.

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """

    def of_view(self, view: Array, action: Float[Array, "4"]) -> Performance:
        """The performance from the view of the local heightmap.

        Args:
            view: See `view`.
            action: Parameters of the bucket-filling controller.
        """
        head, features = self.head_and_features(view, action)
        return bounded_performance(head(features), self.outputs)

    def of_view_with_variance(
        self, view: Array, action: Float[Array, "4"]
    ) -> tuple[Performance, Performance]:
        """The performance, and the variance of its error [tonne², s², kJ²].

        Args:
            view: See `view`.
            action: Parameters of the bucket-filling controller.

        Raises:
            InputError: If the network was not trained to predict it, see `StandardisedMlp`.
        """
        head, features = self.head_and_features(view, action)
        normalised, variances = head.outputs_and_variances(features)
        deviation = self.outputs.span * head.of_spreads(jnp.sqrt(variances))
        return bounded_performance(normalised, self.outputs), Performance(*(deviation**2))

    @abc.abstractmethod
    def head_and_features(
        self, view: Array, action: Float[Array, "4"]
    ) -> tuple[StandardisedMlp, Float[Array, " k"]]:
        """The perceptron that ends in the normalised performance, and its inputs.

        Args:
            view: See `view`.
            action: Parameters of the bucket-filling controller.
        """


def bounded_performance(normalised: Float[Array, "3"], outputs: Normaliser) -> Performance:
    """Mass, time and work that a network means, held to what is possible.

    They are positive: within the range of the training data they are the network's, towards zero
    they bend, over a hundredth of the range, to a thousandth of it. So ratios such as work a tonne
    stay finite, and so do their gradients. The mass bends likewise below the largest load of the
    data.

    Args:
        normalised: Outputs of the network.
        outputs: Range of mass [tonne], time [s] and work [kJ] in the training data.
    """
    predicted = outputs.denormalise(normalised)
    least, bend = _LEAST * outputs.span, _BEND * outputs.span
    # A bucket has a capacity: no load is promised above the largest that was ever seen.
    most = outputs.low + outputs.span
    capped = most - bend * jax.nn.softplus((most - predicted) / bend)
    bounded = jnp.stack([capped[0], predicted[1], predicted[2]])
    positive = least + bend * jax.nn.softplus((bounded - least) / bend)
    return Performance(mass=positive[0], time=positive[1], work=positive[2])
