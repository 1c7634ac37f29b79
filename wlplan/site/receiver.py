"""Where the loads go."""

from __future__ import annotations

from typing import TYPE_CHECKING, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Float, Int

from wlplan.site.machine import WheelLoader
from wlplan.site.stands import stands


@no_type_check
class Receiver(struct.PyTreeNode):
    """Where the middle of the loader is when it dumps into the truck or hopper, world frame.

    Of plans whose trucks stand in different places the leaves are (K,): one for each truck in turn.
    """

    x: Float[Array, "*trucks"]  # [m]
    y: Float[Array, "*trucks"]  # [m]
    heading: Float[Array, "*trucks"]  # [rad]

    if TYPE_CHECKING:

        def __init__(self, x: ArrayLike, y: ArrayLike, heading: ArrayLike) -> None: ...


# The truck [m]: length and width of a hauler, the gap that the loader leaves to it as it dumps.
_TRUCK_LENGTH, _TRUCK_WIDTH, _TRUCK_GAP = 7.0, 2.6, 0.3


def truck_outline(machine: WheelLoader) -> tuple[float, float, float]:
    """Where the truck stands, in the frame of the receiver: across the heading of the loader.

    Returns:
        Distances ahead of the middle of the loader to the side that is loaded and to the far side,
        and half the length of the truck, to the left and to the right [m].
    """
    near = 0.5 * machine.length - machine.overhang + _TRUCK_GAP
    return near, near + _TRUCK_WIDTH, 0.5 * _TRUCK_LENGTH


def receiver_count(receiver: Receiver) -> int:
    """Trucks that have a place of their own; 0: there is one place for all."""
    return 0 if np.ndim(receiver.x) == 0 else len(receiver.x)


def receiver_for(receiver: Receiver, truck: Int[Array, ""] | int) -> Receiver:
    """The receiver of a truck, counted from 0; of a load that is not made any of them."""
    if receiver_count(receiver) == 0:
        return receiver
    picked: Receiver = jax.tree.map(lambda leaf: jnp.asarray(leaf)[jnp.maximum(truck, 0)], receiver)
    return picked


def stands_of(receiver: Receiver) -> list[tuple[str, int]]:
    """Who stands at each of the different places, in words, and the first of these trucks."""
    columns = [np.atleast_1d(np.asarray(leaf)).tolist() for leaf in jax.tree.leaves(receiver)]
    return stands(list(zip(*columns, strict=True)))
