"""Where the loads go."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, no_type_check

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Float

from wlplan.types import Pile

# Rise over the ground that counts as pile [m].
_PILE_RISE = 0.15


@no_type_check
class Receiver(struct.PyTreeNode):
    """Where the loader stands when it dumps into the truck or hopper, world frame."""

    x: Float[Array, ""]  # [m]
    y: Float[Array, ""]  # [m]
    heading: Float[Array, ""]  # [rad]

    if TYPE_CHECKING:

        def __init__(self, x: ArrayLike, y: ArrayLike, heading: ArrayLike) -> None: ...


def default_receiver(pile: Pile) -> Receiver:
    """The follow-up's receiver: 12 m before the toe, 3 m aside, at -30 degrees.

    The toe is taken on the side of the pile with the smallest x, at the middle of its y range.
    """
    height = np.asarray(pile.height) - np.asarray(pile.floor)
    origin = np.asarray(pile.origin)
    on_pile = height > _PILE_RISE
    rows, columns = np.nonzero(on_pile if on_pile.any() else np.ones_like(on_pile))
    left = origin[0] + pile.cell_size * rows.min()
    middle = origin[1] + pile.cell_size * 0.5 * (columns.min() + columns.max())
    dtype = pile.height.dtype
    return Receiver(
        *(jnp.asarray(v, dtype) for v in (left - 12.0, middle - 3.0, math.radians(-30.0)))
    )
