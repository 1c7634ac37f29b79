"""From the pile to the load receiver and back: an estimate of the V-turn and the dumping.

The loader reverses out of the pile along an arc to a turning point, drives forward from there to
the receiver, dumps, and comes back the same way. The turning point is the best of a fan of
candidates, blended smoothly; turns at either end of the forward leg add to its straight length
what an arc of the least radius adds. Obstacles, the pile itself among them, are not considered.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.constants import GRAVITY, J_PER_KJ, KG_PER_TONNE
from wlplan.planning.loading import Transport
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.types import Pose

# Dumping [s]: follow-up, 5 s without work.
DUMP_TIME = 5.0
# Each change between forward and reverse [s]. Estimate.
SHIFT_TIME = 1.0

# Least forward leg towards the receiver [m]. Estimate: about a machine length.
FORWARD_LEG = 6.0

# Candidates for the turning point: reversing distance [m] and deviation of its chord from
# straight back [rad]; and the length over which the best of them are blended [m].
_REVERSING = (3.0, 6.0, 9.0, 12.0, 16.0, 20.0)
_DEVIATION = tuple(math.radians(a) for a in (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0))
_BLEND = 0.3


def transport(pose: Pose, mass: Float[Array, ""], site: Site) -> Transport:
    """From the end of a loading to the start of the next approach.

    Args:
        pose: Dig pose; the loading ends the machine's `approach_distance` behind it.
        mass: Load [tonne].
        site: Machine, and the receiver that the load goes to.
    """
    machine = site.machine
    path = v_turn_length(pose, site.placed_receiver, machine=machine)
    speed = machine.travel_speed
    # There and back; two changes of direction each way.
    time = 2.0 * path / speed + 4.0 * SHIFT_TIME + DUMP_TIME
    load = mass * KG_PER_TONNE
    rolling = machine.rolling_resistance * GRAVITY * path * (2.0 * machine.mass + load)
    # Two starts from rest each way, laden on the way there.
    starts = 0.5 * speed**2 * 2.0 * (2.0 * machine.mass + load)
    return Transport(time, (rolling + starts) / J_PER_KJ)


def v_turn_length(pose: Pose, receiver: Receiver, *, machine: WheelLoader) -> Float[Array, ""]:
    """Length of the way from the end of a loading to the receiver [m]; smooth in the pose."""
    radius = machine.turning_radius
    back = machine.approach_distance
    start_x = pose.x - back * jnp.cos(pose.heading)
    start_y = pose.y - back * jnp.sin(pose.heading)
    points = (jnp.asarray(a, jnp.result_type(pose.x)) for a in _turning_points(radius))
    deviation, chord, arc = points
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
        + _detour(bearing - pose.heading - 2.0 * deviation, radius)
        + _detour(receiver.heading - bearing, radius)
        # Lining up takes a forward leg; a shorter one has to be made up for.
        + 2.0 * jnp.maximum(FORWARD_LEG - distance, 0.0)
    )
    return -_BLEND * jax.nn.logsumexp(-lengths / _BLEND)


@functools.cache
def _turning_points(radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviation [rad], chord and arc length [m] of each candidate for the turning point."""
    deviation, chord = (a.ravel() for a in np.meshgrid(_DEVIATION, _REVERSING))
    chord = np.maximum(chord, 2.0 * radius * np.sin(np.abs(deviation)))
    return deviation, chord, chord / np.sinc(deviation / np.pi)


def _detour(angle: Array, radius: float) -> Array:
    """How much longer than straight ahead a turn by this angle is [m]."""
    wrapped = jnp.abs(jnp.arctan2(jnp.sin(angle), jnp.cos(angle)))
    return radius * (wrapped - jnp.sin(wrapped))
