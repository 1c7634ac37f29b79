"""What ψ_high and the predictor of stalls see of a map: its principal components.

They are smooth in every height, and have as little detail as a few thousand cycles can teach.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE
from wlplan.models.layers import Standardiser, principal_components, soft_clamp
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import INPUTS
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.terrain.heightmap import PERFORMANCE_CELLS, PERFORMANCE_DISPLACEMENT
from wlplan.types import LocalHeightmap

# Principal components that are kept. Our choice, by trial on held-out cycles.
_COMPONENTS = 24
# Least spread of a component: its root mean square over the map, in units of the range of heights.
# A component that hardly varies stays small; blown up it would only be learnt by heart.
_LEAST_SPREAD = 0.02


class PrincipalComponents(nnx.Module):
    """What maps have in common: their components of most variance, not trained.

    Of a map and its mirror image the components are either the same or opposite.
    """

    size = _COMPONENTS + INPUTS  # of the features: components, characteristics, action

    def __init__(self) -> None:
        self.basis = nnx.BatchStat(jnp.zeros((PERFORMANCE_CELLS**2, _COMPONENTS)))

    def fit(self, maps: Float[Array, "n 36 36"]) -> None:
        """Takes the components from the maps of the training data and their mirror images."""
        rows = jnp.concatenate([maps, maps[:, :, ::-1]]).reshape(-1, PERFORMANCE_CELLS**2)
        centred = rows - jnp.broadcast_to(rows.mean(axis=0), rows.shape)
        self.basis[...] = principal_components(centred, _COMPONENTS)

    def fit_scale(
        self, scale: Standardiser, maps: Float[Array, "n 36 36"], inputs: Float[Array, "n 8"]
    ) -> None:
        """Takes the scale of the features from normalised training data."""
        least = jnp.where(jnp.arange(self.size) < _COMPONENTS, _LEAST_SPREAD, 1e-3)
        scale.fit(self.features(maps, inputs), least=least)

    def __call__(self, maps: Float[Array, "*batch 36 36"]) -> Float[Array, "*batch k"]:
        """The components of maps, each by its root mean square over the map."""
        return maps.reshape(*maps.shape[:-2], -1) @ self.basis[...] / PERFORMANCE_CELLS

    def features(
        self, maps: Float[Array, "*batch 36 36"], inputs: Float[Array, "*batch 8"]
    ) -> Float[Array, "*batch k"]:
        """The components, and what else is known of a loading."""
        return jnp.concatenate([self(maps), inputs], axis=-1)


def normalised_view(
    view: Float[Array, "36 36"], action: Float[Array, "4"], maps: Normaliser, inputs: Normaliser
) -> tuple[Float[Array, "36 36"], Float[Array, "8"]]:
    """A map, and its characteristics and the action, in the units of a network.

    Args:
        view: Heights of a local heightmap [m].
        action: Parameters of the bucket-filling controller.
        maps: Range of heights in the training data [m].
        inputs: Range of characteristics and actions there.
    """
    local = LocalHeightmap(view, CELL_SIZE, PERFORMANCE_DISPLACEMENT)
    raw = jnp.concatenate([as_vector(characteristics(local)), jnp.asarray(action)])
    return soft_clamp((view - maps.low[0]) / maps.span[0]), soft_clamp(inputs.normalise(raw))
