"""The machine: linkage, actuators, drive line, and the way back from the pile.

Positions are in the vertical plane of the heading, x forward from the dig location and z up from
the ground. The vehicle's `position` is where the cutting edge would be with the boom at its lowest
and the bucket level; angles are the boom's over the horizontal and the bucket's over level.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.constants import GRAVITY
from wlplan.engines.limits import ACTUATOR_SATURATION, RETREAT_SPEED
from wlplan.site.machine import WheelLoader

# Slowest speed at which wheel power is turned into force [m/s]; below it traction is the limit.
_LEAST_SPEED = 0.2


def bucket_tip(
    machine: WheelLoader,
    position: Float[Array, "*b"],
    boom: Float[Array, "*b"],
    tilt: Float[Array, "*b"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Position of the cutting edge [m]. The linkage keeps the tilt while the boom moves."""
    forward, down = machine.tip_arm
    pin_x = position - forward + machine.boom_length * (jnp.cos(boom) - math.cos(machine.boom_low))
    pin_z = machine.pivot_height + machine.boom_length * jnp.sin(boom)
    # The bucket rests on the ground at the lowest boom angle, whatever the drawing's last digit.
    pin_z = pin_z - machine.pivot_height - machine.boom_length * math.sin(machine.boom_low) + down
    c, s = jnp.cos(tilt), jnp.sin(tilt)
    return pin_x + c * forward + s * down, pin_z + s * forward - c * down


def boom_force(
    machine: WheelLoader,
    boom: Float[Array, "*b"],
    vertical: Float[Array, "*b"],
    horizontal: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """Force of the boom cylinders [N] from the virtual work of a small lift.

    The parallel linkage keeps the bucket's tilt, so only the loads' sums matter and not where on
    the bucket they act. A boom below the horizontal swings the bucket forward as it lifts: the
    horizontal dig force loads the cylinders too, and this is what triggers the controller.

    Args:
        machine: Machine parameters.
        boom: Boom angle [rad].
        vertical: Downward load on the bucket, soil weight included, own weight not [N].
        horizontal: Dig force against the direction of travel [N].
    """
    own = (machine.bucket_mass + 0.5 * machine.boom_mass) * GRAVITY
    moment = machine.boom_length * ((own + vertical) * jnp.cos(boom) - horizontal * jnp.sin(boom))
    return moment / machine.boom_lever


def tilt_moment(
    machine: WheelLoader,
    tilt: Float[Array, "*b"],
    vertical: Float[Array, "*b"],
    horizontal: Float[Array, "*b"],
    moment: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """Moment that the bucket cylinder must overcome to tilt back [N m].

    Args:
        machine: Machine parameters.
        tilt: Bucket angle over level [rad].
        vertical: Downward force of the soil on the bucket [N].
        horizontal: Force of the soil against the direction of travel [N].
        moment: Moment of these forces about the cutting edge, against tilting back [N m].
    """
    forward, down = machine.tip_arm
    c, s = jnp.cos(tilt), jnp.sin(tilt)
    edge_x, edge_z = c * forward + s * down, s * forward - c * down
    # The bucket weighs on the middle of its floor.
    own = machine.bucket_mass * GRAVITY * (edge_x - 0.5 * machine.bucket_depth * c)
    return own + vertical * edge_x - horizontal * edge_z + moment


def actuator_speed(load: Float[Array, "*b"], stall: float) -> Float[Array, "*b"]:
    """Part of the commanded speed that an actuator reaches under load [1]."""
    return jnp.clip((stall - load) / (ACTUATOR_SATURATION * stall), 0.0, 1.0)


def drive(
    machine: WheelLoader, speed: Float[Array, "*b"], vertical: Float[Array, "*b"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Thrust of the wheels [N] and slip speed [m/s] towards the travel speed.

    Args:
        machine: Machine parameters.
        speed: Vehicle speed [m/s].
        vertical: Downward load on the bucket [N]; it presses the front wheels down.
    """
    demand = machine.speed_gain * jnp.maximum(machine.travel_speed - speed, 0.0)
    traction = machine.traction * (machine.mass * GRAVITY + vertical)
    power = machine.wheel_power / jnp.maximum(speed, _LEAST_SPEED)
    thrust = jnp.minimum(jnp.minimum(demand, traction), power)
    # The wheels spin when traction is what limits the thrust, as fast as the power allows.
    room = jnp.minimum(demand, power) - traction
    spinning = jnp.clip(room / (0.1 * traction), 0.0, 1.0)
    spare = machine.wheel_power / jnp.maximum(thrust, 1.0) - speed
    slip = jnp.clip(jnp.minimum(spare, machine.travel_speed - speed), 0.0, machine.slip_speed)
    return thrust, spinning * slip


def retreat(
    machine: WheelLoader,
    position: Float[Array, "*b"],
    boom: Float[Array, "*b"],
    load_mass: Float[Array, "*b"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]:
    """The way back from standstill in the pile to the start, with the bucket tilted back.

    Args:
        machine: Machine parameters.
        position: Vehicle position at the start of the retreat [m].
        boom: Boom angle [rad].
        load_mass: Mass in the bucket [kg].

    Returns:
        Time [s], work of the drive [J] and work of the boom [J].
    """
    total = machine.mass + load_mass
    distance = machine.approach_distance + position
    rolling = machine.rolling_resistance * total * GRAVITY
    speed = machine.travel_speed
    # Power-limited acceleration: the energy is delivered at the wheel power.
    acceleration_time = 0.5 * total * speed**2 / machine.wheel_power
    # Constant power covers two thirds of speed * time while accelerating.
    time_back = distance / speed + acceleration_time / 3.0
    time_boom = jnp.abs(machine.boom_carry - boom) / (RETREAT_SPEED * machine.boom_speed)
    lift = jnp.maximum(math.sin(machine.boom_carry) - jnp.sin(boom), 0.0) * machine.boom_length
    raised = machine.bucket_mass + 0.5 * machine.boom_mass + load_mass
    return (
        jnp.maximum(time_back, time_boom),
        0.5 * total * speed**2 + rolling * distance,
        raised * GRAVITY * lift,
    )
