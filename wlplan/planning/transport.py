"""From the pile to the load receiver and back: an estimate of the V-turn and the dumping.

The loader reverses out of the pile along an arc to a turning point, drives forward from there to
the receiver, dumps, and comes back the same way. The turning point is the best of a fan of
candidates, blended smoothly; turns at either end of the forward leg add to its straight length
what an arc of the least radius adds. Obstacles, the pile itself among them, are not considered.
"""

from __future__ import annotations

import functools
import math
from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from wlplan.constants import GRAVITY, J_PER_KJ, KG_PER_TONNE
from wlplan.site.machine import WA320, WheelLoader
from wlplan.types import Pile, Pose

# Turning radius at the outside of the tyres [m]; brochure of the WA320 class, 5.2 to 5.5.
TURNING_RADIUS = 5.4
# Dumping [s]: follow-up, 5 s without work.
DUMP_TIME = 5.0
# Each change between forward and reverse [s]. Estimate.
SHIFT_TIME = 1.0

# Least forward leg towards the receiver [m]. Estimate: about a machine length.
FORWARD_LEG = 6.0

# Rise over the ground that counts as pile [m].
_PILE_RISE = 0.15
# Candidates for the turning point: reversing distance [m] and deviation of its chord from
# straight back [rad]; and the length over which the best of them are blended [m].
_REVERSING = (3.0, 6.0, 9.0, 12.0, 16.0, 20.0)
_DEVIATION = tuple(math.radians(a) for a in (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0))
_BLEND = 0.3


@no_type_check
class Receiver(struct.PyTreeNode):
    """Where the loader stands when it dumps into the truck or hopper, world frame."""

    x: Float[Array, ""]  # [m]
    y: Float[Array, ""]  # [m]
    heading: Float[Array, ""]  # [rad]


def default_receiver(pile: Pile) -> Receiver:
    """The follow-up's receiver: 12 m before the toe, 3 m aside, at -30 degrees.

    The toe is taken on the side of the pile with the smallest x, at the middle of its y range.
    """
    height = np.asarray(pile.height) - (0.0 if pile.ground is None else np.asarray(pile.ground))
    origin = np.asarray(pile.origin)
    on_pile = height > _PILE_RISE
    rows, columns = np.nonzero(on_pile if on_pile.any() else np.ones_like(on_pile))
    left = origin[0] + pile.cell_size * rows.min()
    middle = origin[1] + pile.cell_size * 0.5 * (columns.min() + columns.max())
    dtype = pile.height.dtype
    return Receiver(
        *(jnp.asarray(v, dtype) for v in (left - 12.0, middle - 3.0, math.radians(-30.0)))
    )


def transport(
    pose: Pose, receiver: Receiver, mass: Float[Array, ""], *, machine: WheelLoader = WA320
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Time [s] and work [kJ] from the end of a loading to the start of the next approach.

    Args:
        pose: Dig pose; the loading ends `machine.approach_distance` behind it.
        receiver: Where the load goes.
        mass: Load [tonne].
        machine: Machine parameters.
    """
    path = v_turn_length(pose, receiver, machine=machine)
    speed = machine.travel_speed
    # There and back; two changes of direction each way.
    time = 2.0 * path / speed + 4.0 * SHIFT_TIME + DUMP_TIME
    load = mass * KG_PER_TONNE
    rolling = machine.rolling_resistance * GRAVITY * path * (2.0 * machine.mass + load)
    # Two starts from rest each way, laden on the way there.
    starts = 0.5 * speed**2 * 2.0 * (2.0 * machine.mass + load)
    return time, (rolling + starts) / J_PER_KJ


def v_turn_length(
    pose: Pose, receiver: Receiver, *, machine: WheelLoader = WA320
) -> Float[Array, ""]:
    """Length of the way from the end of a loading to the receiver [m]; smooth in the pose."""
    back = machine.approach_distance
    start_x = pose.x - back * jnp.cos(pose.heading)
    start_y = pose.y - back * jnp.sin(pose.heading)
    deviation, chord, arc = (jnp.asarray(a, jnp.result_type(pose.x)) for a in _turning_points())
    turn_x = start_x - chord * jnp.cos(pose.heading + deviation)
    turn_y = start_y - chord * jnp.sin(pose.heading + deviation)
    dx, dy = receiver.x - turn_x, receiver.y - turn_y
    # Where the turning point meets the receiver, distance and bearing have no derivative.
    distance = jnp.sqrt(dx**2 + dy**2 + 1e-4)
    meets = (dx == 0.0) & (dy == 0.0)
    bearing = jnp.arctan2(dy, jnp.where(meets, 1.0, dx))
    lengths = (
        arc
        + distance
        # The chord of an arc deviates by half of what the heading turns.
        + _detour(bearing - pose.heading - 2.0 * deviation)
        + _detour(receiver.heading - bearing)
        # Lining up takes a forward leg; a shorter one has to be made up for.
        + 2.0 * jnp.maximum(FORWARD_LEG - distance, 0.0)
    )
    return -_BLEND * jax.nn.logsumexp(-lengths / _BLEND)


@functools.cache
def _turning_points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviation [rad], chord and arc length [m] of each candidate for the turning point."""
    deviation, chord = (a.ravel() for a in np.meshgrid(_DEVIATION, _REVERSING))
    chord = np.maximum(chord, 2.0 * TURNING_RADIUS * np.sin(np.abs(deviation)))
    return deviation, chord, chord / np.sinc(deviation / np.pi)


def _detour(angle: Array) -> Array:
    """How much longer than straight ahead a turn by this angle is [m]."""
    wrapped = jnp.abs(jnp.arctan2(jnp.sin(angle), jnp.cos(angle)))
    return TURNING_RADIUS * (wrapped - jnp.sin(wrapped))
