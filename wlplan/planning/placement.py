"""Where the loader dumps, from what a person says about it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from wlplan.errors import InputError
from wlplan.planning.transport import v_turn_length
from wlplan.site.frame import LOCAL, Frame
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.receiver import Receiver
from wlplan.terrain.heightmap import sample
from wlplan.terrain.toe import ToeContour, edge_poses, toe_contour
from wlplan.types import Pile

# Farthest that a receiver may be from the middle of the map [m].
_FARTHEST = 500.0
# Height above the floor that counts as on the pile [m].
_ON_PILE = 0.5
# Dig locations and headings over which the ways are averaged.
_LOCATIONS, _HEADING_STEP = 24, 5.0


def place_receiver(
    pile: Pile,
    place: Sequence[float],
    heading: float | None = None,
    *,
    machine: WheelLoader = WA320,
    contour: ToeContour | None = None,
    frame: Frame = LOCAL,
) -> Receiver:
    """A receiver at a place.

    Args:
        pile: The pile.
        place: x and y [m], in the frame of the pile.
        heading: Of the loader as it dumps [rad]; None: the one with the shortest ways.
        machine: What drives there.
        contour: Toe of the pile where it is known already.
        frame: What complaints give places in.

    Raises:
        InputError: If the place lies on the pile or far away from it.
    """
    x, y = (float(value) for value in place)
    size = pile.cell_size * np.array(pile.height.shape)
    low = np.asarray(pile.origin, float)
    away = math.hypot(*(np.array([x, y]) - low - 0.5 * size))
    if not away <= _FARTHEST:
        first, last = frame.scan(*low), frame.scan(*(low + size))
        raise InputError(
            f"the truck at {frame.place(x, y)} is {away:.0f} m from the middle of the scan, which "
            f"spans x {first[0]:.1f} to {last[0]:.1f} and y {first[1]:.1f} to {last[1]:.1f} m: "
            f"give it in the coordinates of the scan."
        )
    dtype = pile.height.dtype
    point = jnp.asarray(x, dtype), jnp.asarray(y, dtype)
    inside = bool(np.all((np.array([x, y]) >= low) & (np.array([x, y]) <= low + size)))
    if inside and float(sample(pile.height - pile.floor, pile, *point)) > _ON_PILE:
        raise InputError(
            f"the truck at {frame.place(x, y)} is on the pile: give a place beside it."
        )
    if heading is None:
        heading = _heading_of_shortest_ways(pile, point, machine, contour)
    return Receiver(*point, jnp.asarray(math.remainder(heading, 2.0 * math.pi), dtype))


def _heading_of_shortest_ways(
    pile: Pile, place: tuple[Array, Array], machine: WheelLoader, contour: ToeContour | None
) -> float:
    """Heading [rad] at a place x, y [m] from where the ways to the toe are shortest on average."""
    dtype = pile.height.dtype
    contour = toe_contour(pile, machine=machine) if contour is None else contour
    poses = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), edge_poses(contour, _LOCATIONS))
    headings = np.radians(np.arange(-180.0, 180.0, _HEADING_STEP))

    def length(heading: Array) -> Array:
        receiver = Receiver(*place, heading)
        return jax.vmap(lambda pose: v_turn_length(pose, receiver, machine=machine))(poses).mean()

    lengths = jax.jit(jax.vmap(length))(jnp.asarray(headings, dtype))
    return float(headings[int(np.argmin(lengths))])
