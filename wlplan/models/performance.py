"""Performance predictors: what one loading yields and costs. Paper, section 4.4.

`PsiLow` is the network in units of the training data's range; `PerformanceModel` is a trained one,
ready to be called inside other functions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import nnx, struct
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.models.normaliser import Normaliser
from wlplan.types import Performance

INPUTS = 8
"""Inputs of ψ_low: the four characteristics, then the four parameters of the action."""
OUTPUTS = 3
"""Outputs: mass, time and work."""

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "swish": nnx.swish,
    "leaky_relu": nnx.leaky_relu,
}
"""Activation functions of the paper's grid search."""

# How far outside the range of the training data an input can get, in units of that range. Our
# choice: enough for a slope or an action at the very edge of the data, not for another regime.
_MARGIN = 0.25
# Least output, and width of the bend above it, in units of the range of the training data.
_LEAST, _BEND = 0.001, 0.01


class PsiLow(nnx.Module):
    """ψ_low: a multilayer perceptron over characteristics and action. Paper, section 4.4.

    Args:
        hidden: Units of each hidden layer.
        activation: Name of the activation function, one of `ACTIVATIONS`.
        dropout: Part of the hidden units that is dropped in training.
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
        rngs: nnx.Rngs,
    ):
        if activation not in ACTIVATIONS:
            raise InputError(
                f"Unknown activation {activation!r}: choose one of {', '.join(ACTIVATIONS)}."
            )
        if not hidden or min(hidden) < 1:
            raise InputError(f"The hidden layers are {hidden}: give at least one, of 1 unit up.")
        if not 0.0 <= dropout < 1.0:
            raise InputError(f"The dropout rate is {dropout:g}: it has to be in [0, 1).")
        widths = (INPUTS, *hidden)
        self.hidden = nnx.List(nnx.Linear(n, m, rngs=rngs) for n, m in itertools.pairwise(widths))
        self.output = nnx.Linear(widths[-1], OUTPUTS, rngs=rngs)
        # Without streams of its own it holds no state: the weights are all there is to save.
        self.dropout = nnx.Dropout(dropout)
        self.activation = activation

    def __call__(
        self, inputs: Float[Array, "*batch 8"], *, rngs: nnx.Rngs | None = None
    ) -> Float[Array, "*batch 3"]:
        """Normalised outputs for normalised inputs; `rngs` switches dropout on."""
        x = inputs
        for layer in self.hidden:
            x = ACTIVATIONS[self.activation](layer(x))
            x = self.dropout(x, deterministic=rngs is None, rngs=rngs)
        return self.output(x)


def soft_clamp(values: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The identity on [0, 1]; outside it bends, smoothly, towards a bound a margin away.

    A planner meets slopes and curvatures that the training data never had, and a network that goes
    on linearly can promise any mass there. Held near its data it promises what it has seen; the
    gradient fades, and stays finite however far out the input is.
    """
    inside = jnp.clip(values, 0.0, 1.0)
    return inside + _MARGIN * jnp.tanh((values - inside) / _MARGIN)


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

        Inputs are held near the range of the training data, see `soft_clamp`. The outputs are
        positive: within the range they are the network's, towards zero they bend, over a
        hundredth of the range, to a thousandth of it. So ratios such as work a tonne stay finite,
        and so do their gradients. The mass bends likewise below the largest load of the data.
        """
        raw = jnp.concatenate([jnp.asarray(characteristics), jnp.asarray(action)])
        inputs = soft_clamp(self.inputs.normalise(raw))
        network = nnx.merge(self.graph, self.params)
        predicted = self.outputs.denormalise(network(inputs))
        least, bend = _LEAST * self.outputs.span, _BEND * self.outputs.span
        # A bucket has a capacity: no load is promised above the largest that was ever seen.
        most = self.outputs.low + self.outputs.span
        capped = most - bend * jax.nn.softplus((most - predicted) / bend)
        bounded = jnp.stack([capped[0], predicted[1], predicted[2]])
        positive = least + bend * jax.nn.softplus((bounded - least) / bend)
        return Performance(mass=positive[0], time=positive[1], work=positive[2])
