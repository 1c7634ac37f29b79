"""φ of a learned world: what one loading leaves of the local heightmap."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from wlplan.constants import CELL_SIZE, KG_PER_TONNE
from wlplan.errors import InputError
from wlplan.portable.function import Port, PortableFunction, checksum
from wlplan.portable.functions import ACTION, Asked, actions, local_map, poses
from wlplan.terrain.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    local_points,
    sample,
    sample_local,
)
from wlplan.types import LocalHeightmap, Pose

# Loads of the cases: from half a bucket to a full one [tonne].
_LIGHT, _FULL = 2.0, 5.0


def portable(asked: Asked) -> PortableFunction:
    """φ with its normalisers.

    Raises:
        InputError: If the world has no φ.
    """
    state: Any = getattr(asked.world, "pile_state", None)
    phi: Any = getattr(state, "phi", state)
    if phi is None or hasattr(phi, "on_grid"):
        raise InputError(
            "this world has no learned pile state: choose --world high, or give one with "
            "--pile-state."
        )
    cells = (STATE_CELLS, STATE_CELLS)
    inputs = (
        local_map("heights", STATE_CELLS, STATE_DISPLACEMENT),
        ACTION,
        Port("volume", "that leaves the pile; a phi-vae ignores it", "m^3"),
        Port(
            "ground",
            "floor under the pile, over the same level as the heights; a phi-vae ignores it",
            "m",
            "local",
            cells,
        ),
    )
    output = Port("change", "of the heights by the loading", "m", "local", cells)

    def function(heights: Array, action: Array, volume: Array, ground: Array) -> tuple[Array, ...]:
        local = LocalHeightmap(heights, CELL_SIZE, STATE_DISPLACEMENT)
        return (phi(local, action, volume, ground),)

    heights, ground = _maps(asked)
    masses = np.linspace(_LIGHT, _FULL, asked.count, dtype=np.float32)
    volumes = masses / np.float32(asked.site.soil.density / KG_PER_TONNE)
    return PortableFunction(
        name="pile-state",
        meaning="what one loading changes of the local heightmap, as a network predicts it",
        function=function,
        inputs=inputs,
        outputs=(output,),
        cases=(heights, actions(asked), volumes, ground),
        origin={**asked.origin, "sha256": checksum(phi)},
    )


def _maps(asked: Asked) -> tuple[np.ndarray, np.ndarray]:
    """Local heightmaps around the toe, and the floor under them."""
    pile = asked.pile

    def around(pose: Pose) -> tuple[Array, Array]:
        local = sample_local(pile, pose, cells=STATE_CELLS, displacement=STATE_DISPLACEMENT)
        points = local_points(pose, STATE_CELLS, STATE_DISPLACEMENT, pile.height.dtype)
        return local.height, local.height - sample(pile.height - pile.floor, pile, *points)

    heights, ground = jax.vmap(around)(poses(asked))
    return np.asarray(heights, np.float32), np.asarray(ground, np.float32)
