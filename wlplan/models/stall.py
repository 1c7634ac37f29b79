"""How likely a loading stalls: its filling is ended by the limit of time, and by nothing before.

A cycle that stalls takes more than twice as long and often comes back half full. Whether one does
hangs on a push more or less, so a number for its time is between two that happen; this predictor
says how likely the worse of them is. It looks at what ψ_high with principal components looks at,
and knows nothing of any ψ.
"""

from __future__ import annotations

from typing import Any, ClassVar, no_type_check

import jax
from flax import nnx, struct
from jaxtyping import Array, Float

from wlplan.models.components import PrincipalComponents, normalised_view
from wlplan.models.grid import check_performance_map
from wlplan.models.layers import StandardisedMlp
from wlplan.models.normaliser import Normaliser
from wlplan.types import LocalHeightmap


class StallNetwork(nnx.Module):
    """Principal components of the map, then a multilayer perceptron to one number, the log odds.

    Args:
        hidden: Units of each hidden layer.
        activation: Name of the activation function, one of
            `wlplan.models.architecture.ACTIVATIONS`.
        dropout: Part of the hidden units that is dropped in training.
        rngs: Random streams of the initial weights.

    Raises:
        InputError: If the architecture makes no sense.
    """

    def __init__(
        self,
        hidden: tuple[int, ...] = (128, 128, 128),
        *,
        activation: str = "swish",
        dropout: float = 0.0,
        rngs: nnx.Rngs,
    ):
        self.encoder = PrincipalComponents()
        self.head = StandardisedMlp(
            self.encoder.size, 1, hidden, activation=activation, dropout=dropout, rngs=rngs
        )

    def __call__(
        self,
        maps: Float[Array, "*batch 36 36"],
        inputs: Float[Array, "*batch 8"],
        *,
        rngs: nnx.Rngs | None = None,
    ) -> Float[Array, "*batch"]:
        """Log odds of a stall for normalised maps, characteristics and action.

        `rngs` switches dropout on.
        """
        return self.head(self.encoder.features(maps, inputs), rngs=rngs)[..., 0]

    def fit_scales(self, maps: Float[Array, "n 36 36"], inputs: Float[Array, "n 8"]) -> None:
        """Takes the components and the scales of the perceptron from normalised training data."""
        self.encoder.fit(maps)
        self.encoder.fit_scale(self.head.scale_in, maps, inputs)


@no_type_check
class StallModel(struct.PyTreeNode, eq=False):
    """A trained predictor of stalls. A pytree: weights and normalisers are leaves.

    The weights are float32; with float64 inputs the arithmetic is in float64.

    Attributes:
        view_variable: Name of the variable of a data set that holds what it looks at.
    """

    view_variable: ClassVar[str] = "h36"

    params: nnx.State[Any, Any]
    maps: Normaliser  # height of a local heightmap [m]
    inputs: Normaliser  # characteristics [rad, rad, 1/m, 1/m], then action
    graph: nnx.GraphDef[Any] = struct.field(pytree_node=False)

    def __call__(self, local: LocalHeightmap, action: Float[Array, "4"]) -> Float[Array, ""]:
        """Probability that a loading stalls; deterministic and differentiable.

        Inputs are held near the range of the training data, see `wlplan.models.layers.soft_clamp`.

        Args:
            local: Local heightmap of 36 × 36 cells.
            action: Parameters of the bucket-filling controller.

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """
        check_performance_map(local)
        return self.of_view(local.height, action)

    def of_view(self, view: Float[Array, "36 36"], action: Float[Array, "4"]) -> Float[Array, ""]:
        """The same from the heights of the local heightmap [m]."""
        return jax.nn.sigmoid(self.log_odds(view, action))

    def log_odds(self, view: Float[Array, "36 36"], action: Float[Array, "4"]) -> Float[Array, ""]:
        """Logarithm of the probability over that of no stall."""
        seen = normalised_view(view, action, self.maps, self.inputs)
        odds: Array = nnx.merge(self.graph, self.params)(*seen)
        return odds

    def calibrated(self, slope: float, shift: float) -> StallModel:
        """The model whose log odds are a line over these: slope and shift of Platt's scaling."""
        network = nnx.merge(self.graph, self.params, copy=True)
        scale = network.head.scale_out
        scale.mean[...] = shift + slope * scale.mean[...]
        scale.spread[...] = slope * scale.spread[...]
        return self.replace(params=nnx.state(network))
