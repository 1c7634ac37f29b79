"""What a load leaves of the pile: the strip in front of the bucket, or a learned change.

A pile state is asked `on_grid(pile, window, pose, action, volume, machine)`. A learned φ, which
knows local heightmaps alone, is `LocalChange(φ)`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, no_type_check

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from wlplan.site.machine import WheelLoader
from wlplan.terrain.excavation import excavate
from wlplan.terrain.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    add_local_change,
    local_points,
    sample,
    sample_local,
)
from wlplan.types import Action, Pile, Pose, action_vector


class Dug(NamedTuple):
    """A window of a pile after a load was taken out, before anything slides."""

    height: Float[Array, "n m"]  # [m]
    volume: Float[Array, ""]  # of the load [m^3]
    missing: Float[Array, ""]  # what of it has not left the window, see `SolveReport` [m^3]


@no_type_check
class Strip(struct.PyTreeNode):
    """The load leaves a strip as wide as the bucket. Paper, section 4.6."""

    if TYPE_CHECKING:

        def __init__(self) -> None: ...

    def on_grid(
        self,
        pile: Pile,
        window: Pile,
        pose: Pose,
        action: Action,
        volume: Float[Array, ""],
        machine: WheelLoader,
    ) -> Dug:
        """The window after a load; where the strip holds less, the load is what is there."""
        dug = excavate(window, pose, volume, width=machine.bucket_width)
        return Dug(dug.pile.height, dug.volume, dug.missing)


@no_type_check
class LocalChange(struct.PyTreeNode, eq=False):
    """A learned φ changes the local heightmap, which is written back. Paper, section 4.5.

    Where φ says `conserves_volume`, the load is exactly what leaves the pile. Otherwise the pile
    changes by whatever φ predicts, and the load is what was asked for.
    """

    phi: Any  # φ(local, action, volume, ground) -> change of the local heightmap [m]

    def on_grid(
        self,
        pile: Pile,
        window: Pile,
        pose: Pose,
        action: Action,
        volume: Float[Array, ""],
        machine: WheelLoader,
    ) -> Dug:
        """The window after a load."""
        local = sample_local(pile, pose, cells=STATE_CELLS, displacement=STATE_DISPLACEMENT)
        points = local_points(pose, STATE_CELLS, STATE_DISPLACEMENT, pile.height.dtype)
        ground = local.height - sample(pile.height - pile.floor, pile, *points)
        change = self.phi(local, action_vector(action), volume, ground)
        height, missing = add_local_change(window.height, window, pose, change, STATE_DISPLACEMENT)
        if getattr(self.phi, "conserves_volume", False):
            # On a pile that is used up, rounding must not be less than nothing.
            volume = jnp.maximum((window.height - height).sum(), 0.0) * pile.cell_size**2
        return Dug(height, volume, missing)


def pile_state_of(value: Any) -> Any:
    """A pile state as it is; a bare φ as a `LocalChange`."""
    return value if hasattr(value, "on_grid") else LocalChange(value)
