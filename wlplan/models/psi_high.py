"""ψ_high: what one loading yields and costs, from the local heightmap. Paper, section 4.4.

The network sees the map through one of two encoders. The paper's is convolutional. Ours takes the
principal components of the maps and the four characteristics: smooth in every height, and with as
little detail as a few thousand cycles can teach.
"""

from __future__ import annotations

from typing import ClassVar, no_type_check

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.models.architecture import ENCODERS
from wlplan.models.components import PrincipalComponents, normalised_view
from wlplan.models.grid import check_performance_map
from wlplan.models.layers import (
    StandardisedMlp,
    activation_named,
    max_pool,
    patches,
    resize,
)
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import OUTPUTS, PerformanceModel
from wlplan.types import LocalHeightmap

# Paper, section 4.4: the map is brought to 32 × 32 cells; three convolutions of ten filters, each
# with a 2 × 2 pooling; a code of 32 numbers.
_CELLS, _FILTERS, _STAGES, _CODE = 32, 10, 3, 32


class ConvolutionalEncoder(nnx.Module):
    """The paper's encoder: three convolutions with batch normalisation and pooling, one linear."""

    def __init__(self, *, activation: str, rngs: nnx.Rngs):
        activation_named(activation)
        channels = (1, *[_FILTERS] * (_STAGES - 1))
        self.filters = nnx.List(nnx.Linear(9 * n, _FILTERS, rngs=rngs) for n in channels)
        self.norms = nnx.List(nnx.BatchNorm(_FILTERS, axis=0, rngs=rngs) for _ in channels)
        self.output = nnx.Linear(_FILTERS * (_CELLS >> _STAGES) ** 2, _CODE, rngs=rngs)
        self.activation = activation

    def __call__(
        self, maps: Float[Array, "*batch 36 36"], *, training: bool
    ) -> Float[Array, "*batch k"]:
        """The code of normalised maps; in training the norms follow the batch."""
        batch = maps.shape[:-2]
        # The batch goes last, see `patches`.
        x = jnp.moveaxis(resize(maps, _CELLS).reshape(-1, _CELLS, _CELLS), 0, -1)[None]
        for filters, norm in zip(self.filters, self.norms, strict=True):
            near = patches(x)
            flat = near.reshape(len(near), -1)
            assert filters.bias is not None
            # Not `filters(flat.T).T`: the copies that XLA makes for it take as long as all else.
            x = filters.kernel[...].T @ flat + filters.bias[...][:, None]
            x = norm(x, use_running_average=not training).reshape(_FILTERS, *near.shape[1:])
            x = max_pool(activation_named(self.activation)(x))
        return self.output(x.reshape(-1, x.shape[-1]).T).reshape(*batch, _CODE)


class PsiHigh(nnx.Module):
    """ψ_high: an encoder of the map, then a multilayer perceptron. Paper, section 4.4.

    Args:
        hidden: Units of each hidden layer behind the encoder.
        encoder: "convolutional" (the paper's) or "principal" (ours); the latter also sees the four
            characteristics.
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
        hidden: tuple[int, ...] = (2048, 2048),
        *,
        encoder: str = "convolutional",
        activation: str = "swish",
        dropout: float = 0.1,
        scattered: bool = False,
        rngs: nnx.Rngs,
    ):
        if encoder not in ENCODERS:
            raise InputError(f"Unknown encoder {encoder!r}: choose one of {', '.join(ENCODERS)}.")
        self.encoder_name = encoder
        convolutional = encoder == "convolutional"
        self.encoder = (
            ConvolutionalEncoder(activation=activation, rngs=rngs)
            if convolutional
            else PrincipalComponents()
        )
        inputs = _CODE + 4 if convolutional else PrincipalComponents.size
        self.head = StandardisedMlp(
            inputs,
            OUTPUTS,
            hidden,
            activation=activation,
            dropout=dropout,
            scattered=scattered,
            rngs=rngs,
        )

    def __call__(
        self,
        maps: Float[Array, "*batch 36 36"],
        inputs: Float[Array, "*batch 8"],
        *,
        rngs: nnx.Rngs | None = None,
    ) -> Float[Array, "*batch 3"]:
        """Normalised outputs for normalised maps, characteristics and action.

        `rngs` switches dropout on and lets the norms follow the batch.
        """
        return self.head(self.features(maps, inputs, training=rngs is not None), rngs=rngs)

    def features(
        self,
        maps: Float[Array, "*batch 36 36"],
        inputs: Float[Array, "*batch 8"],
        *,
        training: bool = False,
    ) -> Float[Array, "*batch k"]:
        """What the encoder passes on: a code, and what else is known."""
        if isinstance(self.encoder, ConvolutionalEncoder):
            code = self.encoder(maps, training=training)
            return jnp.concatenate([code, inputs[..., 4:]], axis=-1)
        return self.encoder.features(maps, inputs)

    def fit_scales(
        self,
        maps: Float[Array, "n 36 36"],
        inputs: Float[Array, "n 8"],
        outputs: Float[Array, "n 3"],
    ) -> None:
        """Takes the scales of the multilayer perceptron from normalised training data.

        The paper's encoder learns the scale of its own code, so there only the outputs are scaled.
        """
        self.head.scale_out.fit(outputs)
        if isinstance(self.encoder, PrincipalComponents):
            self.encoder.fit(maps)
            self.encoder.fit_scale(self.head.scale_in, maps, inputs)


@no_type_check
class HighPerformanceModel(PerformanceModel, eq=False):
    """A trained ψ_high; its view are the heights [m], 36 × 36. Running norms are leaves too."""

    view_variable: ClassVar[str] = "h36"

    maps: Normaliser  # height of a local heightmap [m]

    def view(self, local: LocalHeightmap) -> Float[Array, "36 36"]:
        """The heights of a local heightmap of 36 × 36 cells [m].

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """
        check_performance_map(local)
        return local.height

    def head_and_features(
        self, view: Float[Array, "36 36"], action: Float[Array, "4"]
    ) -> tuple[StandardisedMlp, Float[Array, " k"]]:
        """The perceptron behind the encoder, and what the encoder passes on to it."""
        network = nnx.merge(self.graph, self.params)
        seen = normalised_view(view, action, self.maps, self.inputs)
        return network.head, network.features(*seen)
