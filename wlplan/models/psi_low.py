"""ψ_low: what one loading yields and costs, from four numbers about the pile. Paper, section 4.4.

`PsiLow` is the network in units of the training data's range; `LowPerformanceModel` is a trained
one, ready to be called inside other functions.
"""

from __future__ import annotations

from typing import ClassVar, no_type_check

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from wlplan.models.grid import check_performance_map
from wlplan.models.layers import StandardisedMlp, soft_clamp
from wlplan.models.performance import INPUTS, OUTPUTS, PerformanceModel
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.types import LocalHeightmap


class PsiLow(StandardisedMlp):
    """ψ_low: a multilayer perceptron over characteristics and action. Paper, section 4.4.

    Normalised inputs of length 8, normalised outputs of length 3.

    Args:
        hidden: Units of each hidden layer.
        activation: Name of the activation function, one of
            `wlplan.models.architecture.ACTIVATIONS`.
        dropout: Part of the hidden units that is dropped in training.
        scattered: Whether it also predicts the variance of its errors, as members of an ensemble
            do.
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
        scattered: bool = False,
        rngs: nnx.Rngs,
    ):
        super().__init__(
            INPUTS,
            OUTPUTS,
            hidden,
            activation=activation,
            dropout=dropout,
            scattered=scattered,
            rngs=rngs,
        )


@no_type_check
class LowPerformanceModel(PerformanceModel, eq=False):
    """A trained ψ_low; its view are the four characteristics [rad, rad, 1/m, 1/m]."""

    view_variable: ClassVar[str] = "characteristics"

    def view(self, local: LocalHeightmap) -> Float[Array, "4"]:
        """The four characteristics of a local heightmap of 36 × 36 cells.

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """
        check_performance_map(local)
        return as_vector(characteristics(local))

    def head_and_features(
        self, view: Float[Array, "4"], action: Float[Array, "4"]
    ) -> tuple[PsiLow, Float[Array, "8"]]:
        """The network, and normalised characteristics and action."""
        raw = jnp.concatenate([jnp.asarray(view), jnp.asarray(action)])
        return nnx.merge(self.graph, self.params), soft_clamp(self.inputs.normalise(raw))
