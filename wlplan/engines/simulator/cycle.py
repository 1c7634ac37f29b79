"""One loading cycle on a local heightfield: approach, dig, breakout, retreat. Paper, section 5.

Time marches in fixed steps while the bucket is in the soil; the approach before it and the retreat
after it have closed forms. Where soil lies in the approach lane, time marches there too: see
`lane`. An event that ends a phase is located inside its step and the state interpolated to it, so
that outcomes are continuous in the inputs.

Cycles are computed side by side, the last axis of every array: `begin` some, `advance` them by a
few steps at a time, and take each one's `outcome` when it `has_ended`. `dig` does it all for one,
and `lane.dig_through_lane` for one with the lane.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from wlplan.constants import CELL_SIZE, GRAVITY
from wlplan.engines.limits import (
    BRAKE_TIME,
    BREAKOUT_CLEARANCE,
    BREAKOUT_FROM,
    MAX_FILL_TIME,
    MAX_PENETRATION,
)
from wlplan.engines.simulator import controller, loader, terrain, walls
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.heightmap import STATE_DISPLACEMENT
from wlplan.types import Action
from wlplan.xla import materialize_if


@dataclasses.dataclass(frozen=True)
class Settings:
    """Numerical settings of the simulator."""

    # Time step [s]. Mass, time and work change by less than 1.5 % against 0.005 s, see the tests.
    step: float = 0.02
    # Whether reverse-mode derivatives must pass: a fixed number of steps, instead of as many as
    # the longest cycle of the batch needs.
    differentiable: bool = False

    @property
    def max_steps(self) -> int:
        """Steps after which every cycle has ended."""
        approach, settle = 1.0, 3.5
        return math.ceil((approach + MAX_FILL_TIME + settle) / self.step)


@no_type_check
class Cycle(struct.PyTreeNode):
    """The outcome of one loading cycle, SI units."""

    mass: Float[Array, ""]  # load [kg]
    time: Float[Array, ""]  # from start to end position [s]
    work_drive: Float[Array, ""]  # thrust times vehicle speed [J]
    work_boom: Float[Array, ""]  # [J]
    work_bucket: Float[Array, ""]  # [J]
    work_slip: Float[Array, ""]  # thrust times slip speed of the wheels [J]
    fill_time: Float[Array, ""]  # from the dig location to the stop [s]
    stop_reason: Int[Array, ""]  # index into `loading_cycle.STOP_REASONS`
    tip_x: Float[Array, ""]  # cutting edge at the stop [m]
    tip_z: Float[Array, ""]
    height: Float[Array, "52 52"]  # local heightfield afterwards, not relaxed [m]
    # What the approach changes behind that heightfield, see `lane` [m]; None: the lane was free.
    lane_change: Float[Array, "52 52"] | None = None


@no_type_check
class State(struct.PyTreeNode):
    """What the time stepping carries of cycles side by side."""

    height: Float[Array, "54 54 b"]  # with its rim, see `terrain` [m]
    ground: Float[Array, "54 54 b"]  # likewise; does not change
    profile: Float[Array, "52 b"]  # surface before, across the bucket; does not change [m]
    wall_x: Float[Array, "51 b"]  # faces of walls along the heading; do not change [m]
    wall_top: Float[Array, "51 b"]  # how high they stand; does not change [m]
    action: Action  # does not change
    # Where the dig location lies in the frame of the heightfield: 0, or ahead, see `lane` [m].
    dig_x: Float[Array, " b"]
    taken: Float[Array, " b"]  # of the fill, what was taken up on the approach, at most [m^3]
    fill: Float[Array, "lanes b"]  # soil in each lane of the bucket [m^3]
    time: Float[Array, " b"]
    position: Float[Array, " b"]
    speed: Float[Array, " b"]
    boom: Float[Array, " b"]
    tilt: Float[Array, " b"]
    reach: Float[Array, " b"]  # furthest position of the cutting edge [m]
    boom_force: Float[Array, " b"]  # smoothed, over the nominal force [1]
    boom_command: Float[Array, " b"]
    tilt_command: Float[Array, " b"]
    dig_start: Float[Array, " b"]  # time at which the edge reached the dig location [s]
    stop_time: Float[Array, " b"]
    stop_x: Float[Array, " b"]
    stop_z: Float[Array, " b"]
    work_drive: Float[Array, " b"]
    work_boom: Float[Array, " b"]
    work_bucket: Float[Array, " b"]
    work_slip: Float[Array, " b"]
    stop_reason: Int[Array, " b"]
    phase: Int[Array, " b"]  # 0 filling (approach included), 1 stopped, 2 ended, 3 arrived

    @property
    def has_ended(self) -> Bool[Array, " b"]:
        """Whether a further step changes nothing."""
        return self.phase >= _ENDED

    @property
    def has_arrived(self) -> Bool[Array, " b"]:
        """Whether it has come through the lane, up to the heightfield of the dig pose."""
        return self.phase == _ARRIVED

    def ended(self) -> State:
        """The same with all cycles at an end."""
        return self.replace(phase=jnp.full_like(self.phase, _ENDED))


_FILLING, _STOPPED, _ENDED, _ARRIVED = 0, 1, 2, 3

# The pile comes to stand behind the soil that is met over this way before the dig location [m],
# if so much was taken up in the lane [m^3]; with less in part, so that outcomes are continuous.
_TOE, _LITTLE = 0.5, 0.1


def begin(
    height: Float[Array, "52 52 b"],
    ground: Float[Array, "52 52 b"],
    action: Action,
    machine: WheelLoader,
) -> State:
    """Cycles about to begin: bucket level, at the near edge of the heightfield, at travel speed.

    Args:
        height: Heights in the local frames of the dig poses, see `dig` [m].
        ground: Floors under the piles in the same frames [m].
        action: Parameters of the bucket-filling controller, leaves of shape [b].
        machine: Machine parameters.
    """
    dtype = height.dtype
    width = terrain.lane_widths(machine)
    zero = jnp.zeros(height.shape[2], dtype)
    count = jnp.zeros(height.shape[2], jnp.int32)
    start = zero - STATE_DISPLACEMENT
    travelled = machine.approach_distance - STATE_DISPLACEMENT
    rolling = machine.rolling_resistance * machine.mass * GRAVITY * travelled
    boom = zero + machine.boom_low
    floor = terrain.rimmed(ground)
    wall_x, wall_top = walls.faces(terrain.Lanes(machine).of(floor))
    return State(
        height=terrain.rimmed(height),
        ground=floor,
        wall_x=wall_x,
        wall_top=wall_top,
        profile=jnp.einsum("ijb,j->ib", height, jnp.asarray(width / width.sum(), dtype)),
        action=jax.tree.map(lambda part: jnp.asarray(part, dtype), action),
        dig_x=zero,
        taken=zero,
        fill=jnp.zeros((terrain.Lanes(machine).count, height.shape[2]), dtype),
        time=zero + travelled / machine.travel_speed,
        position=start,
        speed=zero + machine.travel_speed,
        boom=boom,
        tilt=zero,
        reach=start,
        boom_force=loader.boom_force(machine, boom, zero, zero) / machine.boom_force_nominal,
        boom_command=zero,
        tilt_command=zero,
        dig_start=zero + machine.approach_distance / machine.travel_speed,
        stop_time=zero,
        stop_x=zero,
        stop_z=zero,
        work_drive=zero + rolling,
        work_boom=zero,
        work_bucket=zero,
        work_slip=zero,
        stop_reason=count,
        phase=count,
    )


def advance(
    state: State,
    *,
    machine: WheelLoader,
    soil: Soil,
    settings: Settings,
    steps: int | Int[Array, ""],
) -> State:
    """At most `steps` time steps; it stops early when all cycles have ended."""

    def more(counted: tuple[State, Array]) -> Array:
        return (counted[1] < steps) & ~counted[0].has_ended.all()

    def step(counted: tuple[State, Array]) -> tuple[State, Array]:
        return _step(counted[0], machine, soil, settings.step), counted[1] + 1

    return lax.while_loop(more, step, (state, jnp.zeros((), jnp.int32)))[0]


def outcome(state: State, *, machine: WheelLoader, soil: Soil) -> Cycle:
    """The records of cycles that have ended, leaves with the cycles as their last axis."""
    mass = terrain.total(state.fill) * soil.density
    time, drive, boom = loader.retreat(machine, state.position, state.boom, mass)
    return Cycle(
        mass=mass,
        time=state.time + time,
        work_drive=state.work_drive + drive,
        work_boom=state.work_boom + boom,
        work_bucket=state.work_bucket,
        work_slip=state.work_slip,
        fill_time=state.stop_time - state.dig_start,
        stop_reason=state.stop_reason,
        tip_x=state.stop_x,
        tip_z=state.stop_z,
        height=state.height[1:-1, 1:-1],
    )


def _step(state: State, machine: WheelLoader, soil: Soil, step: float) -> State:
    """One time step, cut short at the first event inside it."""
    filling = state.phase == _FILLING
    wanted = ~state.has_ended.all()
    x, z = loader.bucket_tip(machine, state.position, state.boom, state.tilt)
    wall = materialize_if(walls.nearest(state.wall_x, state.wall_top, z), wanted)
    bucket = terrain.Bucket(x, z, state.tilt, wall)
    backed = 1.0 - jnp.clip(state.taken / _LITTLE, 0.0, 1.0) * jnp.clip(
        (state.dig_x - x) / _TOE, 0.0, 1.0
    )
    soil_force = terrain.reaction(
        machine, soil, state.height, state.ground, state.fill, bucket, wanted, state.taken, backed
    )
    soil_force = materialize_if(soil_force, wanted)
    vertical = soil_force.vertical

    # Vehicle: thrust while filling, brake after the stop. The soil can stop it, not push it back.
    # So can a wall, at once.
    total = machine.mass + soil_force.content_mass
    thrust, slip = loader.drive(machine, state.speed, vertical)
    brake = machine.traction * total * GRAVITY
    rolling = machine.rolling_resistance * total * GRAVITY
    thrust = jnp.where(filling, thrust, 0.0)
    passive = rolling + jnp.where(filling, 0.0, brake)
    # What the soil must resist to bring the vehicle to rest within the step.
    stopping = jnp.maximum(thrust - passive + total * state.speed / step, 0.0)
    horizontal = jnp.minimum(soil_force.horizontal, stopping)
    free = jnp.maximum(state.speed + (thrust - passive - horizontal) / total * step, 0.0)
    speed = jnp.minimum(free, jnp.maximum(wall - x, 0.0) / step)
    horizontal = horizontal + total * (free - speed) / step

    # Controller and actuators.
    force = loader.boom_force(machine, state.boom, vertical, horizontal)
    boom_force = controller.smooth(state.boom_force, force / machine.boom_force_nominal, step)
    boom_target, tilt_target = controller.command(state.action, boom_force)
    # Engaged when the edge reaches the dig location; a short ramp keeps this continuous.
    engaged = jnp.clip((x - state.dig_x) / CELL_SIZE + 0.5, 0.0, 1.0)
    boom_target = jnp.where(filling, engaged * boom_target, 0.0)
    tilt_target = jnp.where(filling, engaged * tilt_target, 1.0)
    boom_command = controller.smooth(state.boom_command, boom_target, step)
    tilt_command = controller.smooth(state.tilt_command, tilt_target, step)
    moment = loader.tilt_moment(machine, state.tilt, vertical, horizontal, soil_force.moment)
    boom_rate = machine.boom_speed * boom_command * loader.actuator_speed(force, machine.boom_force)
    tilt_rate = (
        machine.tilt_speed * tilt_command * loader.actuator_speed(moment, machine.tilt_moment)
    )
    boom = jnp.minimum(state.boom + boom_rate * step, machine.boom_high)
    tilt = state.tilt + tilt_rate * step
    position = state.position + speed * step
    new_x, new_z = loader.bucket_tip(machine, position, boom, tilt)
    # A boom that rises swings the bucket forward. At a wall the machine gives way instead.
    beyond = jnp.maximum(new_x - wall, 0.0)
    position, new_x = position - beyond, new_x - beyond
    reach = jnp.maximum(state.reach, new_x)
    height, fill = terrain.move(
        machine,
        soil,
        state.height,
        state.fill,
        state.ground,
        terrain.Bucket(new_x, new_z, tilt, wall),
        (state.reach, reach),
        step,
        wanted,
    )

    trial = state.replace(
        height=height,
        fill=fill,
        time=state.time + step,
        position=position,
        speed=speed,
        boom=boom,
        tilt=tilt,
        reach=reach,
        boom_force=boom_force,
        boom_command=boom_command,
        tilt_command=tilt_command,
        work_drive=state.work_drive + thrust * speed * step,
        work_slip=state.work_slip + jnp.where(filling, thrust * slip, 0.0) * step,
        work_boom=state.work_boom + jnp.maximum(force, 0.0) * machine.boom_lever * boom_rate * step,
        work_bucket=state.work_bucket + jnp.maximum(moment, 0.0) * tilt_rate * step,
    )

    # Events: each is a margin that reaches zero.
    def surface_margin(tip_x: Array, tip_z: Array) -> Array:
        surface = _interpolated(state.profile, walls.in_front(tip_x, wall))
        early = jnp.maximum(BREAKOUT_FROM - (tip_x - state.dig_x), 0.0)
        return surface + BREAKOUT_CLEARANCE + early - tip_z

    deadline = state.dig_start + MAX_FILL_TIME
    old_margins = jnp.stack(
        [
            machine.tilt_end - state.tilt,
            MAX_PENETRATION - (x - state.dig_x),
            surface_margin(x, z),
            deadline - state.time,
        ]
    )
    new_margins = jnp.stack(
        [
            machine.tilt_end - tilt,
            MAX_PENETRATION - (new_x - state.dig_x),
            surface_margin(new_x, new_z),
            deadline - trial.time,
        ]
    )
    crossed = (new_margins <= 0.0) & filling[None]
    drop = jnp.where(crossed, jnp.maximum(old_margins - new_margins, 1e-9), 1.0)
    part = jnp.where(crossed, jnp.clip(old_margins / drop, 0.0, 1.0), 1.0)
    reason = jnp.argmin(part, axis=0).astype(jnp.int32)
    # In the lane a cycle gives way to its other half where that one's heightfield begins.
    gate = state.dig_x - STATE_DISPLACEMENT
    arrives = filling & (state.dig_x > 0.0) & (new_x >= gate)
    stops = crossed.any(axis=0) & ~arrives

    # After the stop the bucket tilts to its end and the brake holds; the later of the two ends it.
    left_tilt = (machine.tilt_end - state.tilt) / jnp.maximum(tilt - state.tilt, 1e-9)
    left_brake = (state.stop_time + BRAKE_TIME - state.time) / step
    give_up = (state.stop_time + 3.0 - state.time) / step
    left = jnp.minimum(jnp.maximum(left_tilt, left_brake), give_up)
    ends = (state.phase == _STOPPED) & (left <= 1.0)
    fraction = jnp.where(filling, part.min(axis=0), jnp.where(ends, jnp.clip(left, 0.0, 1.0), 1.0))
    arrived = jnp.clip((gate - x) / jnp.where(arrives, new_x - x, 1.0), 0.0, 1.0)
    fraction = jnp.where(arrives, arrived, fraction)
    fraction = jnp.where(state.has_ended, 0.0, fraction)

    # What the step does not change is the same array before and after.
    def mix(old: Array, new: Array) -> Array:
        if new is old:
            return old
        return old + fraction.reshape(*(1,) * (old.ndim - 1), -1) * (new - old)

    mixed: State = jax.tree.map(mix, state, trial)
    # The bucket may be at its tilt end before the brake lets go.
    mixed = mixed.replace(tilt=jnp.minimum(mixed.tilt, machine.tilt_end))
    stop_x, stop_z = loader.bucket_tip(machine, mixed.position, mixed.boom, mixed.tilt)
    return mixed.replace(
        phase=jnp.where(
            stops, _STOPPED, jnp.where(ends, _ENDED, jnp.where(arrives, _ARRIVED, state.phase))
        ),
        stop_reason=jnp.where(stops, reason, state.stop_reason),
        stop_time=jnp.where(stops, mixed.time, state.stop_time),
        stop_x=jnp.where(stops, stop_x, state.stop_x),
        stop_z=jnp.where(stops, stop_z, state.stop_z),
    )


def _interpolated(profile: Float[Array, "n b"], x: Float[Array, " b"]) -> Float[Array, " b"]:
    """Heights of profiles at positions along the heading; beyond its ends a profile is level."""
    position = jnp.clip((x + STATE_DISPLACEMENT) / CELL_SIZE, 0.0, len(profile) - 1.0)
    left = jnp.clip(jnp.floor(position), 0, len(profile) - 2).astype(jnp.int32)
    here, ahead = (jnp.take_along_axis(profile, (left + k)[None], axis=0)[0] for k in (0, 1))
    return here + (position - left) * (ahead - here)


def dig(
    height: Float[Array, "52 52"],
    ground: Float[Array, "52 52"],
    action: Action,
    *,
    machine: WheelLoader = WA320,
    soil: Soil = GRAVEL,
    settings: Settings = Settings(),
) -> Cycle:
    """Plays one loading cycle on a local heightfield.

    Args:
        height: Heights in the local frame of the dig pose, 52 x 52 cells displaced by 1.0 m, over
            the ground at the dig location [m].
        ground: Floor under the pile in the same frame [m].
        action: Parameters of the bucket-filling controller.
        machine: Machine parameters.
        soil: Soil parameters.
        settings: Time step, and whether reverse-mode derivatives must pass.
    """

    def play(height: Array, ground: Array, action: Action) -> Cycle:
        state = begin(height, ground, action, machine)
        state = play_out(state, machine=machine, soil=soil, settings=settings)
        return outcome(state, machine=machine, soil=soil)

    return played_alone(play, settings, height, ground, action)


def play_out(
    state: State, *, machine: WheelLoader, soil: Soil, settings: Settings, longer: float = 0.0
) -> State:
    """Steps until all cycles have ended.

    Args:
        state: Cycles side by side.
        machine: Machine parameters.
        soil: Soil parameters.
        settings: Time step, and whether reverse-mode derivatives must pass.
        longer: Time that a cycle may take beyond that of `Settings.max_steps` [s].
    """
    most = settings.max_steps + math.ceil(longer / settings.step)
    if not settings.differentiable:
        return advance(state, machine=machine, soil=soil, settings=settings, steps=most)
    # As many steps as any cycle may take. Rematerialised in chunks: memory grows with the square
    # root of the number of steps.
    chunk = math.isqrt(most) + 1

    @jax.checkpoint
    def advance_chunk(state: State, _: None) -> tuple[State, None]:
        def step(s: State, _: None) -> tuple[State, None]:
            return _step(s, machine, soil, settings.step), None

        def steps(state: State) -> State:
            return lax.scan(step, state, None, length=chunk)[0]

        # When all have ended there is nothing left to do, nor to go back through.
        return lax.cond(state.has_ended.all(), lambda s: s, steps, state), None

    last: State = lax.scan(advance_chunk, state, None, length=chunk)[0]
    return last


def played_alone(play: Callable[..., Cycle], settings: Settings, *arguments: Any) -> Cycle:
    """One cycle of a function that plays them side by side.

    Args:
        play: As of `side_by_side`.
        settings: Whether reverse-mode derivatives must pass.
        arguments: What it is called with, for one cycle.
    """
    one = jax.tree.map(lambda part: jnp.asarray(part)[..., None], arguments)
    cycles = play(*one) if settings.differentiable else side_by_side(play)(*one)
    cycle: Cycle = jax.tree.map(lambda part: part[..., 0], cycles)
    return cycle


def side_by_side(play: Callable[..., Any]) -> Callable[..., Any]:
    """A function of cycles side by side that under `vmap` still takes them so.

    Args:
        play: Function of pytrees of arrays to one, the cycles the last axis of all of them.
    """
    play = jax.custom_batching.custom_vmap(play)

    @play.def_vmap
    def play_batch(size: Any, batched: Sequence[Any], *arguments: Any) -> tuple[Any, Any]:
        # The size is a whole number, or a symbol for one while the function is exported.
        def join(leaf: Array, is_batched: bool) -> Array:
            leaf = leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))
            return jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], -1)

        results = play(*jax.tree.map(join, arguments, tuple(batched)))

        def part(leaf: Array) -> Array:
            return jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], size, -1), -2, 0)

        return jax.tree.map(part, results), jax.tree.map(lambda _: True, results)

    return play
