"""ψ_low: what one loading yields and costs, from four numbers about the pile. Paper, section 4.4.

`PsiLow` is the network in units of the training data's range; `PerformanceModel` is a trained one,
ready to be called inside other functions.
"""

from __future__ import annotations

from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import nnx, struct
from jaxtyping import Array, Float

from wlplan.models.layers import Mlp, soft_clamp
from wlplan.models.normaliser import Normaliser
from wlplan.types import Performance

INPUTS = 8
"""Inputs of ψ_low: the four characteristics, then the four parameters of the action."""
OUTPUTS = 3
"""Outputs: mass, time and work."""

# Least output, and width of the bend above it, in units of the range of the training data.
_LEAST, _BEND = 0.001, 0.01


class PsiLow(Mlp):
    """ψ_low: a multilayer perceptron over characteristics and action. Paper, section 4.4.

    Normalised inputs of length 8, normalised outputs of length 3.

    Args:
        hidden: Units of each hidden layer.
        activation: Name of the activation function, one of `wlplan.models.layers.ACTIVATIONS`.
        dropout: Part of the hidden units that is dropped in training.
        standardised: False: without the scalings of `Mlp`, as the first models were.
        scattered: Whether it also tells how far it may be off, as members of an ensemble do.
        rngs: Random streams of the initial weights.

    Raises:
        InputError: If the architecture makes no sense.
    """

    def __init__(
        self,
        hidden: tuple[int, ...] = (512, 512),
        *,
        activation: str = "swish",
        dropout: float = 0.1,
        standardised: bool = True,
        scattered: bool = False,
        rngs: nnx.Rngs,
    ):
        super().__init__(
            INPUTS,
            OUTPUTS,
            hidden,
            activation=activation,
            dropout=dropout,
            standardised=standardised,
            scattered=scattered,
            rngs=rngs,
        )


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


def performance_and_variance(
    head: Mlp, inputs: Float[Array, " k"], outputs: Normaliser
) -> tuple[Performance, Performance]:
    """The performance that a network means, and the variance of what it may be off.

    Args:
        head: The network, or its last part.
        inputs: What it is given.
        outputs: Range of mass [tonne], time [s] and work [kJ] in the training data.
    """
    normalised, variances = head.outputs_and_variances(inputs)
    off = outputs.span * head.of_spreads(jnp.sqrt(variances))
    return bounded_performance(normalised, outputs), Performance(*(off**2))


@no_type_check
class PerformanceModel(struct.PyTreeNode):
    """A trained ψ_low. A pytree: the weights and the normalisers are leaves.

    The weights are float32; with float64 inputs the arithmetic is in float64.
    """

    params: nnx.State
    inputs: Normaliser  # characteristics [rad, rad, 1/m, 1/m], then action
    outputs: Normaliser  # mass [tonne], time [s], work [kJ]
    graph: nnx.GraphDef[Any] = struct.field(pytree_node=False)

    def __call__(
        self, characteristics: Float[Array, "4"], action: Float[Array, "4"]
    ) -> Performance:
        """Performance of one loading; deterministic and differentiable.

        Inputs are held near the range of the training data, see `soft_clamp`, outputs to what is
        possible, see `bounded_performance`.
        """
        inputs = self._normalised(characteristics, action)
        return bounded_performance(nnx.merge(self.graph, self.params)(inputs), self.outputs)

    def with_variance(
        self, characteristics: Float[Array, "4"], action: Float[Array, "4"]
    ) -> tuple[Performance, Performance]:
        """The performance, and the variance of what it may be off [tonne², s², kJ²].

        Raises:
            InputError: If the network was not trained to tell, see `Mlp.outputs_and_variances`.
        """
        network = nnx.merge(self.graph, self.params)
        inputs = self._normalised(characteristics, action)
        return performance_and_variance(network, inputs, self.outputs)

    def _normalised(self, characteristics: Array, action: Array) -> Array:
        raw = jnp.concatenate([jnp.asarray(characteristics), jnp.asarray(action)])
        return soft_clamp(self.inputs.normalise(raw))
