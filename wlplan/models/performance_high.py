"""ψ_high: what one loading yields and costs, from the local heightmap. Paper, section 4.4.

Two encoders tell the network about the map. The paper's is convolutional. Ours takes the principal
components of the maps and the four characteristics: smooth in every height, and with as little
detail as a few thousand cycles can teach.
"""

from __future__ import annotations

from typing import Any, no_type_check

import jax.numpy as jnp
from flax import nnx, struct
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.models.layers import (
    ACTIVATIONS,
    Mlp,
    check_activation,
    max_pool,
    patches,
    principal_components,
    resize,
    soft_clamp,
)
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import INPUTS, OUTPUTS, bounded_performance, performance_and_variance
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.terrain.heightmap import PERFORMANCE_CELLS
from wlplan.types import LocalHeightmap, Performance

ENCODERS = ("convolutional", "principal")
"""What tells ψ_high about the map: the paper's encoder, and ours."""

# Paper, section 4.4: the map is brought to 32 × 32 cells; three convolutions of ten filters, each
# with a 2 × 2 pooling; a code of 32 numbers.
_CELLS, _FILTERS, _STAGES, _CODE = 32, 10, 3, 32
# Principal components that are kept. Our choice, by trial on held-out cycles.
_COMPONENTS = 24
# Least spread of a component: its root mean square over the map, in units of the range of heights.
# A component that hardly varies stays small; blown up it would only be learnt by heart.
_LEAST_SPREAD = 0.02


class PrincipalComponents(nnx.Module):
    """What maps have in common: their components of most variance, not trained.

    Of a map and its mirror image the components are either the same or opposite.
    """

    def __init__(self) -> None:
        self.basis = nnx.BatchStat(jnp.zeros((PERFORMANCE_CELLS**2, _COMPONENTS)))

    def fit(self, maps: Float[Array, "n 36 36"]) -> None:
        """Takes the components from the maps of the training data and their mirror images."""
        rows = jnp.concatenate([maps, maps[:, :, ::-1]]).reshape(-1, PERFORMANCE_CELLS**2)
        centred = rows - jnp.broadcast_to(rows.mean(axis=0), rows.shape)
        self.basis[...] = principal_components(centred, _COMPONENTS)

    def __call__(self, maps: Float[Array, "*batch 36 36"]) -> Float[Array, "*batch k"]:
        """The components of maps, each by its root mean square over the map."""
        return maps.reshape(*maps.shape[:-2], -1) @ self.basis[...] / PERFORMANCE_CELLS


class ConvolutionalEncoder(nnx.Module):
    """The paper's encoder: three convolutions with batch normalisation and pooling, one linear."""

    def __init__(self, *, activation: str, rngs: nnx.Rngs):
        check_activation(activation)
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
            x = filters(near.reshape(len(near), -1).T).T
            x = norm(x, use_running_average=not training).reshape(_FILTERS, *near.shape[1:])
            x = max_pool(ACTIVATIONS[self.activation](x))
        return self.output(x.reshape(-1, x.shape[-1]).T).reshape(*batch, _CODE)


class PsiHigh(nnx.Module):
    """ψ_high: an encoder of the map, then a multilayer perceptron. Paper, section 4.4.

    Args:
        hidden: Units of each hidden layer behind the encoder.
        encoder: "convolutional" (the paper's) or "principal" (ours); the latter also sees the four
            characteristics.
        activation: Name of the activation function, one of `wlplan.models.layers.ACTIVATIONS`.
        dropout: Part of the hidden units that is dropped in training.
        scattered: Whether it also tells how far it may be off, as members of an ensemble do.
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
        inputs = _CODE + 4 if convolutional else _COMPONENTS + INPUTS
        self.head = Mlp(
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
        return jnp.concatenate([self.encoder(maps), inputs], axis=-1)

    def fit_scales(
        self,
        maps: Float[Array, "n 36 36"],
        inputs: Float[Array, "n 8"],
        outputs: Float[Array, "n 3"],
    ) -> None:
        """Takes the scales of the multilayer perceptron from normalised training data.

        The paper's encoder learns the scale of its own code, so there only the outputs are scaled.
        """
        scale_in, scale_out = self.head.scale_in, self.head.scale_out
        if scale_in is None or scale_out is None:
            return
        scale_out.fit(outputs)
        if isinstance(self.encoder, PrincipalComponents):
            self.encoder.fit(maps)
            least = jnp.where(jnp.arange(_COMPONENTS + INPUTS) < _COMPONENTS, _LEAST_SPREAD, 1e-3)
            scale_in.fit(self.features(maps, inputs), least=least)


@no_type_check
class HighPerformanceModel(struct.PyTreeNode):
    """A trained ψ_high. A pytree: weights, running norms and normalisers are leaves.

    The weights are float32; with float64 inputs the arithmetic is in float64.
    """

    params: nnx.State
    maps: Normaliser  # height of a local heightmap [m]
    inputs: Normaliser  # characteristics [rad, rad, 1/m, 1/m], then action
    outputs: Normaliser  # mass [tonne], time [s], work [kJ]
    graph: nnx.GraphDef[Any] = struct.field(pytree_node=False)

    def __call__(self, local: LocalHeightmap, action: Float[Array, "4"]) -> Performance:
        """Performance of one loading; deterministic and differentiable.

        Heights, characteristics and action are held near the range of the training data, see
        `soft_clamp`, outputs to what is possible, see `bounded_performance`.

        Args:
            local: Local heightmap of 36 × 36 cells.
            action: Parameters of the bucket-filling controller.

        Raises:
            InputError: If the map has another number of cells.
        """
        network = nnx.merge(self.graph, self.params)
        return bounded_performance(network(*self._normalised(local, action)), self.outputs)

    def with_variance(
        self, local: LocalHeightmap, action: Float[Array, "4"]
    ) -> tuple[Performance, Performance]:
        """The performance, and the variance of what it may be off [tonne², s², kJ²].

        Raises:
            InputError: If the map has another number of cells, or the network was not trained to
                tell, see `Mlp.outputs_and_variances`.
        """
        network = nnx.merge(self.graph, self.params)
        features = network.features(*self._normalised(local, action))
        return performance_and_variance(network.head, features, self.outputs)

    def _normalised(self, local: LocalHeightmap, action: Array) -> tuple[Array, Array]:
        if local.height.shape != (PERFORMANCE_CELLS, PERFORMANCE_CELLS):
            raise InputError(
                f"The local heightmap has {local.height.shape} cells; ψ_high was trained on "
                f"{PERFORMANCE_CELLS} a side: sample it with cells={PERFORMANCE_CELLS}."
            )
        raw = jnp.concatenate([as_vector(characteristics(local)), jnp.asarray(action)])
        return (
            soft_clamp((local.height - self.maps.low[0]) / self.maps.span[0]),
            soft_clamp(self.inputs.normalise(raw)),
        )
