"""φ as in the paper: a variational autoencoder and a step in its latent space. Section 4.5.

The paper takes the layers of its autoencoder from an off-the-shelf network that could not be
identified: the architecture here is assumed. Any module with `encode` and `decode` can take its
place. Strided convolutions are written as reshapes of 2 × 2 patches and matrix products, which XLA
is fast at on a CPU.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, ClassVar, no_type_check

import jax.numpy as jnp
import numpy as np
from flax import nnx, struct
from jaxtyping import Array, Float

from wlplan.models.grid import check_state_map
from wlplan.models.layers import StandardisedMlp, resize
from wlplan.terrain.heightmap import STATE_CELLS
from wlplan.types import LocalHeightmap

LATENT = 64
"""Length of the code of a map. Paper, section 4.5."""

# Paper, section 4.5: the map is brought to 64 × 64 cells. Channels of the stages: assumed.
_CELLS, _CHANNELS = 64, (32, 64, 128, 128)
# Least range of heights that a map is scaled by [m]: on flat ground there is none.
_LEAST_RANGE = 0.05
# Width of the band along the edges over which prediction and initial map blend [cells]. Assumed.
_BAND = 6


class Vae(nnx.Module):
    """A variational autoencoder of scaled maps, 52 × 52 cells outside, 64 × 64 inside."""

    def __init__(self, *, rngs: nnx.Rngs):
        channels = (1, *_CHANNELS)
        pairs = list(itertools.pairwise(channels))
        self.down = nnx.List(nnx.Linear(4 * n, m, rngs=rngs) for n, m in pairs)
        self.up = nnx.List(nnx.Linear(m, 4 * n, rngs=rngs) for n, m in reversed(pairs))
        size = _CHANNELS[-1] * (_CELLS >> len(_CHANNELS)) ** 2
        self.code = nnx.Linear(size, 2 * LATENT, rngs=rngs)
        self.uncode = nnx.Linear(LATENT, size, rngs=rngs)

    def encode(
        self, maps: Float[Array, "*batch n n"]
    ) -> tuple[Float[Array, "*batch k"], Float[Array, "*batch k"]]:
        """Mean and logarithm of the variance of the codes of scaled maps."""
        x = resize(maps, _CELLS)[..., None]
        for layer in self.down:
            x = nnx.leaky_relu(layer(_gathered(x)))
        code = self.code(x.reshape(*x.shape[:-3], -1))
        # Bounded, so that the exponential of the variance is finite from the first step on.
        return code[..., :LATENT], 5.0 * jnp.tanh(code[..., LATENT:] / 5.0)

    def decode(self, code: Float[Array, "*batch k"]) -> Float[Array, "*batch n n"]:
        """Scaled maps of codes."""
        side = _CELLS >> len(_CHANNELS)
        x = nnx.leaky_relu(self.uncode(code)).reshape(*code.shape[:-1], side, side, _CHANNELS[-1])
        for number, layer in enumerate(self.up):
            x = _scattered(layer(x))
            x = nnx.leaky_relu(x) if number < len(self.up) - 1 else x
        return resize(x[..., 0], STATE_CELLS)


def _gathered(maps: Float[Array, "*batch i j c"]) -> Float[Array, "*batch k l d"]:
    """The cells of each 2 × 2 patch beside each other."""
    *batch, i, j, c = maps.shape
    split = maps.reshape(*batch, i // 2, 2, j // 2, 2, c)
    return jnp.moveaxis(split, -4, -3).reshape(*batch, i // 2, j // 2, 4 * c)


def _scattered(maps: Float[Array, "*batch k l d"]) -> Float[Array, "*batch i j c"]:
    """The inverse of `_gathered`."""
    *batch, i, j, d = maps.shape
    split = jnp.moveaxis(maps.reshape(*batch, i, j, 2, 2, d // 4), -3, -4)
    return split.reshape(*batch, 2 * i, 2 * j, d // 4)


class LatentStep(StandardisedMlp):
    """The code after a loading, from the code before, the action and the range of heights."""

    def __init__(
        self, hidden: tuple[int, ...] = (1024, 1024), *, dropout: float = 0.1, rngs: nnx.Rngs
    ):
        super().__init__(
            LATENT + 5, LATENT, hidden, activation="leaky_relu", dropout=dropout, rngs=rngs
        )


class PhiVae(nnx.Module):
    """φ of the paper: an autoencoder, a step in its latent space, the mean map of the data.

    Args:
        hidden: Units of each hidden layer of the step.
        dropout: Part of the hidden units that is dropped in training.
        rngs: Random streams of the initial weights.
    """

    def __init__(
        self, hidden: tuple[int, ...] = (1024, 1024), *, dropout: float = 0.1, rngs: nnx.Rngs
    ):
        self.vae = Vae(rngs=rngs)
        self.step = LatentStep(hidden, dropout=dropout, rngs=rngs)
        self.mean = nnx.BatchStat(jnp.zeros((STATE_CELLS, STATE_CELLS)))


def scaled(
    heights: Float[Array, "n n"], mean: Float[Array, "n n"]
) -> tuple[Float[Array, "n n"], Float[Array, ""], Float[Array, ""]]:
    """A map in units of its own range. Paper, equations 13 and 14.

    Args:
        heights: Local heightmap [m].
        mean: Mean map of the training data [m].

    Returns:
        The scaled map, and the least height over the mean map and the range that it is scaled by
        [m].
    """
    centred = heights - mean
    low = centred.min()
    span = jnp.maximum(centred.max() - low, _LEAST_RANGE)
    return (centred - low) / span, low, span


def blended(change: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A change of a map [m] that fades to nothing along its edges. Paper, section 4.5.1.

    So the prediction stays inside and the map before along the edges. The weight rises linearly
    over a band whose width, which the paper does not give, is assumed.
    """
    return jnp.asarray(_blend_weight(change.shape[0]), change.dtype) * change


@functools.cache
def _blend_weight(cells: int) -> np.ndarray:
    inside = np.minimum(np.arange(cells), np.arange(cells)[::-1])
    ramp = np.clip(inside / _BAND, 0.0, 1.0)
    return np.minimum(ramp[:, None], ramp[None, :])


@no_type_check
class VaePileStateModel(struct.PyTreeNode, eq=False):
    """A trained φ of the paper. A pytree: weights and the mean map are leaves.

    Nothing keeps its volume: see `wlplan.models.phi.HeightChangeModel` for one that does.
    """

    conserves_volume: ClassVar[bool] = False

    params: nnx.State[Any, Any]
    graph: nnx.GraphDef[Any] = struct.field(pytree_node=False)
    # Whether the map before stays along the edges, see `blended`.
    blend: bool = struct.field(pytree_node=False, default=True)

    def __call__(
        self,
        local: LocalHeightmap,
        action: Float[Array, "4"],
        volume: Float[Array, ""],
        ground: Float[Array, "52 52"],
    ) -> Float[Array, "52 52"]:
        """The change of the local heightmap by a loading [m].

        Args:
            local: Local heightmap of 52 × 52 cells.
            action: Parameters of the bucket-filling controller.
            volume: Ignored.
            ground: Ignored.

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """

        def step(phi: PhiVae, code: Array, span: Array) -> Array:
            return phi.step(jnp.concatenate([code, action, span[None]]))

        change = self._by_code(local, step) - local.height
        return blended(change) if self.blend else change

    def reconstruction(self, local: LocalHeightmap) -> Float[Array, "52 52"]:
        """What is left of a map in its code [m]: no prediction is sharper than this.

        Args:
            local: Local heightmap of 52 × 52 cells.

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """
        return self._by_code(local, lambda phi, code, span: code)

    def _by_code(
        self, local: LocalHeightmap, change: Callable[[PhiVae, Array, Array], Array]
    ) -> Float[Array, "52 52"]:
        """The map of the code of a map [m], once `change` of φ, code and range is made to it."""
        check_state_map(local)
        phi = nnx.merge(self.graph, self.params)
        mean = phi.mean[...]
        unit, low, span = scaled(local.height, mean)
        code, _ = phi.vae.encode(unit)
        after: Array = mean + low + span * phi.vae.decode(change(phi, code, span))
        return after
