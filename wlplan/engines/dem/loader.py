"""The machine in closed loop: drive, linkage, controller, and the sequence of one cycle.

The same machine as `engines.simulator` has, with what a bucket among grains needs besides: moments
about the pin, wheels that brake against the soil, and a vehicle that the soil can push back.
Positions are in the vertical plane of the heading: x forward from the dig location, z up.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections import deque
from collections.abc import Callable

import numpy as np

from wlplan.constants import GRAVITY
from wlplan.engines.limits import (
    ACTUATOR_SATURATION,
    AVERAGING_TIME,
    BRAKE_TIME,
    BREAKOUT_CLEARANCE,
    BREAKOUT_FROM,
    MAX_FILL_TIME,
    MAX_PENETRATION,
    RETREAT_SPEED,
    SMOOTHING_TIME,
    STOP_REASONS,
)
from wlplan.site.machine import WheelLoader

_TILT_END, _PENETRATION, _BREAKOUT, _TIMEOUT = STOP_REASONS

# Where the cycle enters the engine, if the lane is free, and leaves it: position of the cutting
# edge [m].
START, FREE = -0.70, -1.90
# A cycle that takes longer is given up [s]; filling ends after `MAX_FILL_TIME`.
MAX_TIME = 40.0

# Largest thrust, in parts of the machine's weight: what the torque converter gives at stall.
# Estimate; 130 kN for a machine of 15.5 t.
_MOST_THRUST = 0.855
# Centre of mass of the empty bucket, ahead of and above its pin, in parts of the tip radius.
# Estimate.
_BUCKET_AHEAD, _BUCKET_ABOVE = 0.513, 0.110
# The least speed at which power is turned into force [m/s], and the speed at which the rolling
# resistance has nearly its full value.
_LEAST_SPEED, _ROLLING_SPEED = 0.1, 0.05
# The bucket counts as tilted within this angle of its end [rad].
_ANGLE = 1e-3


class Phase(enum.IntEnum):
    """What the cycle is at."""

    APPROACH = 0
    FILLING = 1
    STOPPED = 2
    RETREAT = 3


@dataclasses.dataclass(frozen=True)
class BucketForce:
    """What the soil does to the bucket: force [N] forward and up, and moment about its pin [N m].

    The moment is positive where it tilts the bucket back.
    """

    forward: float = 0.0
    up: float = 0.0
    moment: float = 0.0


class Linkage:
    """Geometry of boom and bucket, which keeps its tilt while the boom moves.

    Args:
        machine: Machine parameters.
    """

    def __init__(self, machine: WheelLoader):
        self._machine = machine
        # How far the cutting edge of a level, lowered bucket is ahead of and below its pin [m].
        self.forward, self.down = machine.tip_arm

    def pin(self, position: float, boom: float) -> tuple[float, float]:
        """Position of the bucket's pin [m]; `position` is the edge's with the bucket lowered."""
        machine = self._machine
        reach = machine.boom_length * (math.cos(boom) - math.cos(machine.boom_low))
        return (
            position - self.forward + reach,
            machine.pivot_height + machine.boom_length * math.sin(boom),
        )

    def points(self, position: float, boom: float, tilt: float, local: np.ndarray) -> np.ndarray:
        """Points of the bucket, given in the frame of its level cutting edge [m], shape [n, 3]."""
        x, z = self.pin(position, boom)
        c, s = math.cos(tilt), math.sin(tilt)
        ahead, above = local[:, 0] + self.forward, local[:, 2] - self.down
        return np.stack([x + c * ahead - s * above, local[:, 1], z + s * ahead + c * above], axis=1)

    def tip(self, position: float, boom: float, tilt: float) -> tuple[float, float]:
        """Position of the cutting edge [m]."""
        x, z = self.pin(position, boom)
        c, s = math.cos(tilt), math.sin(tilt)
        return x + c * self.forward + s * self.down, z + s * self.forward - c * self.down

    def in_bucket(
        self, position: float, boom: float, tilt: float, points: np.ndarray
    ) -> np.ndarray:
        """Points given in the frame of the level cutting edge: the inverse of `points`."""
        x, z = self.pin(position, boom)
        c, s = math.cos(tilt), math.sin(tilt)
        dx, dz = points[:, 0] - x, points[:, 2] - z
        return np.stack(
            [c * dx + s * dz - self.forward, points[:, 1], -s * dx + c * dz + self.down], axis=1
        )


class Loader:
    """A wheel loader that plays one cycle, step by step, against the forces of the soil.

    Args:
        machine: Machine parameters.
        action: Parameters of the controller: delta_bm, k_bm, delta_bk, k_bk.
        surface: `surface(x)`: height of the initial surface on the centre line [m]; the edge above
            it is what ends filling by breakout.
        step: Time between two calls of `advance` [s].
        start: Where the cycle enters the engine [m].
    """

    def __init__(
        self,
        machine: WheelLoader,
        action: np.ndarray,
        surface: Callable[[float], float],
        step: float,
        start: float = START,
    ):
        self.machine, self.linkage, self.step = machine, Linkage(machine), step
        self._action, self._surface = [float(value) for value in action], surface
        travelled = machine.approach_distance + start
        self.time = travelled / machine.travel_speed
        self.position, self.boom, self.tilt = start, machine.boom_low, 0.0
        self.speed, self.boom_rate, self.tilt_rate = machine.travel_speed, 0.0, 0.0
        self.work_drive = machine.rolling_resistance * machine.mass * GRAVITY * travelled
        self.work_boom = self.work_bucket = self.work_slip = 0.0
        self.phase, self.stop_reason = Phase.APPROACH, ""
        self.dig_time = self.stop_time = math.nan
        self.stop_tip = (math.nan, math.nan)
        self._forces: deque[float] = deque(maxlen=max(1, round(AVERAGING_TIME / step)))
        self._boom_command = self._tilt_command = 0.0
        self._tilted_at = math.nan
        self.record: tuple[float, ...] = ()

    @property
    def is_free(self) -> bool:
        """Whether the bucket has left the soil behind, or the cycle was given up."""
        away = self.phase is Phase.RETREAT and self.position < FREE
        return away or self.time > MAX_TIME

    def advance(self, soil: BucketForce) -> None:
        """One step: decides on forces and speeds, then moves.

        Args:
            soil: Forces on the bucket, averaged over the last step.
        """
        boom_moment, tilt_moment = self._moments(soil)
        force = boom_moment / self.machine.boom_lever / self.machine.boom_force_nominal
        self._forces.append(force)
        smoothed = sum(self._forces) / len(self._forces)
        tip = self.linkage.tip(self.position, self.boom, self.tilt)
        boom, tilt = self._commands(smoothed, tip)
        self._actuate(boom, tilt, boom_moment, tilt_moment)
        thrust = self._drive(soil)
        self.work_drive += max(0.0, thrust * self.speed) * self.step
        self.work_boom += max(0.0, boom_moment * self.boom_rate) * self.step
        self.work_bucket += max(0.0, tilt_moment * self.tilt_rate) * self.step
        self.record = (
            *(self.time, self.position, self.boom, self.tilt, self.speed),
            *(soil.forward, soil.up, smoothed, self._boom_command, self._tilt_command),
            *(*tip, boom_moment, tilt_moment, thrust, float(self.phase)),
        )

    def move(self) -> None:
        """Carries position and angles over the step that `advance` decided on."""
        self.position += self.speed * self.step
        self.boom += self.boom_rate * self.step
        self.tilt += self.tilt_rate * self.step
        self.time += self.step

    def retreat(self, load: float) -> None:
        """The rest of the way back and up, without soil.

        Args:
            load: Mass in the bucket [kg].
        """
        machine, total = self.machine, self.machine.mass + load
        lifted = machine.bucket_mass + 0.5 * machine.boom_mass + load
        moment = GRAVITY * machine.boom_length * math.cos(self.boom) * lifted
        rate = RETREAT_SPEED * machine.boom_speed
        while self.position > -machine.approach_distance or self.boom < machine.boom_carry:
            if self.time > 2.0 * MAX_TIME:
                break
            arrived = self.position <= -machine.approach_distance
            target = 0.0 if arrived else -machine.travel_speed
            most = _MOST_THRUST * machine.mass * GRAVITY
            thrust = self._within(machine.speed_gain * (target - self.speed), most)
            rolling = self._rolling(total * GRAVITY)
            self.speed += (thrust - rolling) / total * self.step
            self.position += self.speed * self.step
            self.time += self.step
            self.work_drive += max(0.0, thrust * self.speed) * self.step
            if self.boom < machine.boom_carry:
                self.boom += rate * self.step
                self.work_boom += moment * rate * self.step

    def _moments(self, soil: BucketForce) -> tuple[float, float]:
        """Moments that the cylinders of boom and bucket have to hold [N m]."""
        machine = self.machine
        c, s = math.cos(self.boom), math.sin(self.boom)
        own = GRAVITY * (machine.bucket_mass + 0.5 * machine.boom_mass)
        # By virtual work: lifting swings the bucket up and, below the horizontal, forward.
        boom = machine.boom_length * (own * c + s * soil.forward - c * soil.up)
        ahead = machine.tip_radius * (
            _BUCKET_AHEAD * math.cos(self.tilt) - _BUCKET_ABOVE * math.sin(self.tilt)
        )
        return boom, GRAVITY * machine.bucket_mass * ahead - soil.moment

    def _commands(self, force: float, tip: tuple[float, float]) -> tuple[float, float]:
        """Wanted speeds of boom and bucket, in parts of their maxima; the sequence of phases."""
        if self.phase is Phase.APPROACH:
            # In a free lane the edge is at the dig location by then. Stuck in one that is not, the
            # cycle ends as a filling does that takes too long.
            free = self.machine.approach_distance / self.machine.travel_speed
            if tip[0] >= 0.0:
                self.phase, self.dig_time = Phase.FILLING, self.time
            elif self.time - free > MAX_FILL_TIME:
                self.phase, self.dig_time = Phase.FILLING, free
        if self.phase is Phase.FILLING:
            self.stop_reason = self._reason_to_stop(tip)
            if self.stop_reason:
                self.phase, self.stop_time, self.stop_tip = Phase.STOPPED, self.time, tip
        if self.phase is Phase.STOPPED and self._has_stood():
            self.phase = Phase.RETREAT
        delta_bm, k_bm, delta_bk, k_bk = self._action
        if self.phase is Phase.FILLING:
            boom, tilt = k_bm * (force - delta_bm), k_bk * (force - delta_bk)
        elif self.phase is Phase.STOPPED:
            boom, tilt = 0.0, 1.0
        elif self.phase is Phase.RETREAT:
            boom = RETREAT_SPEED if self.boom < self.machine.boom_carry else 0.0
            tilt = RETREAT_SPEED
        else:
            boom = tilt = 0.0
        boom = boom if self.boom < self.machine.boom_high else 0.0
        tilt = 0.0 if self._is_tilted() else tilt
        return min(max(boom, 0.0), 1.0), min(max(tilt, 0.0), 1.0)

    def _reason_to_stop(self, tip: tuple[float, float]) -> str:
        if self._is_tilted():
            return _TILT_END
        if tip[0] >= MAX_PENETRATION:
            return _PENETRATION
        if tip[0] > BREAKOUT_FROM and tip[1] > self._surface(tip[0]) + BREAKOUT_CLEARANCE:
            return _BREAKOUT
        return _TIMEOUT if self.time - self.dig_time > MAX_FILL_TIME else ""

    def _has_stood(self) -> bool:
        """Whether the brake was on for long enough, with the bucket at its end for 0.2 s of it."""
        if self._is_tilted() and math.isnan(self._tilted_at):
            self._tilted_at = self.time
        if not math.isnan(self._tilted_at):
            return self.time - max(self._tilted_at - 0.3, self.stop_time) >= BRAKE_TIME
        # A bucket that cannot tilt is taken out as it is.
        return self.time - self.stop_time > 6.0

    def _is_tilted(self) -> bool:
        return self.tilt >= self.machine.tilt_end - _ANGLE

    def _actuate(self, boom: float, tilt: float, boom_moment: float, tilt_moment: float) -> None:
        """Lets commands follow what is wanted, and speeds what the loads allow."""
        machine, follow = self.machine, min(1.0, self.step / SMOOTHING_TIME)
        self._boom_command += (boom - self._boom_command) * follow
        self._tilt_command += (tilt - self._tilt_command) * follow

        def part(load: float, stall: float) -> float:
            return min(max((stall - load) / (ACTUATOR_SATURATION * stall), 0.0), 1.0)

        stall = machine.boom_force * machine.boom_lever
        self.boom_rate = machine.boom_speed * self._boom_command * part(boom_moment, stall)
        self.tilt_rate = (
            machine.tilt_speed * self._tilt_command * part(tilt_moment, machine.tilt_moment)
        )
        if self.phase is Phase.RETREAT and self.boom >= machine.boom_carry:
            self.boom_rate = 0.0
        if self.tilt >= machine.tilt_end:
            self.tilt_rate = 0.0

    def _drive(self, soil: BucketForce) -> float:
        """Changes the vehicle's speed; thrust of the wheels [N], none while they brake."""
        machine = self.machine
        weight = machine.mass * GRAVITY - soil.up
        grip = machine.traction * max(weight, 0.0)
        if self.phase is Phase.STOPPED:
            # Comes to rest within about 0.1 s, and holds against the soil.
            needed = self.speed * machine.mass / 0.1 + soil.forward
            brake = -min(max(needed, -grip), grip)
            self.speed += (brake + soil.forward) / machine.mass * self.step
            return 0.0
        backwards = self.phase is Phase.RETREAT
        target = -machine.travel_speed if backwards else machine.travel_speed
        limit = min(_MOST_THRUST * machine.mass * GRAVITY, grip)
        thrust = self._within(machine.speed_gain * (target - self.speed), limit)
        if abs(thrust) >= 0.98 * limit:
            # The wheels spin towards the speed that is asked for.
            slip = min(abs(target - self.speed), machine.slip_speed)
            self.work_slip += abs(thrust) * slip * self.step
        change = thrust + soil.forward - self._rolling(weight)
        self.speed += change / machine.mass * self.step
        return thrust

    def _within(self, thrust: float, limit: float) -> float:
        """A thrust bounded by a limit and by the power at the wheels [N]."""
        power = self.machine.wheel_power / max(abs(self.speed), _LEAST_SPEED)
        most = min(limit, power)
        return min(max(thrust, -most), most)

    def _rolling(self, weight: float) -> float:
        """Rolling resistance, against the motion [N]."""
        sense = math.tanh(self.speed / _ROLLING_SPEED)
        return self.machine.rolling_resistance * weight * sense


RECORDED = (
    *("time_s", "position_m", "boom_rad", "tilt_rad", "speed_m_s"),
    *("soil_forward_N", "soil_up_N", "boom_force", "boom_command", "tilt_command"),
    *("tip_x_m", "tip_z_m", "boom_moment_Nm", "tilt_moment_Nm", "thrust_N", "phase"),
)
"""Names of the numbers of `Loader.record`."""
