"""Where the loads go."""

from __future__ import annotations

from typing import TYPE_CHECKING, no_type_check

from flax import struct
from jaxtyping import Array, ArrayLike, Float

from wlplan.site.machine import WheelLoader


@no_type_check
class Receiver(struct.PyTreeNode):
    """Where the middle of the loader is when it dumps into the truck or hopper, world frame."""

    x: Float[Array, ""]  # [m]
    y: Float[Array, ""]  # [m]
    heading: Float[Array, ""]  # [rad]

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
