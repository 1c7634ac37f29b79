"""The motion of a loading, step by step: `dig` keeps its outcome only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from wlplan.engines.simulator import loader, terrain
from wlplan.engines.simulator.cycle import Settings, State, advance, begin, side_by_side
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.types import Action

_SETTINGS = Settings()


@no_type_check
class Trajectory(struct.PyTreeNode):
    """Machine and load at the start of every time step, from 1 m before the dig location on.

    After the brake has let go the last values repeat; the retreat is not part of it. SI units.
    """

    time: Float[Array, " steps"]  # since the start of the cycle [s]
    tip_x: Float[Array, " steps"]  # cutting edge ahead of the dig location [m]
    tip_z: Float[Array, " steps"]  # cutting edge over the ground there [m]
    tilt: Float[Array, " steps"]  # bucket over level [rad]
    boom: Float[Array, " steps"]  # boom over the horizontal [rad]
    speed: Float[Array, " steps"]  # of the vehicle [m/s]
    mass: Float[Array, " steps"]  # soil in the bucket [kg]
    phase: Int[Array, " steps"]  # 0 approaching and filling, 1 stopped, 2 ended


@no_type_check
class Section(struct.PyTreeNode):
    """What the vertical plane of the heading cuts of soil and bucket at the same moments."""

    surface: Float[Array, "steps 52"]  # of the soil, along the heading of the local frame [m]
    content: Float[Array, " steps"]  # soil in the bucket there [m^2]


def trace(
    height: Float[Array, "52 52"],
    ground: Float[Array, "52 52"],
    action: Action,
    *,
    machine: WheelLoader = WA320,
    soil: Soil = GRAVEL,
    settings: Settings = _SETTINGS,
) -> Trajectory:
    """The trajectory of the loading that `dig` plays, by the same time stepping.

    Args:
        height: Heights in the local frame of the dig pose, as for `dig` [m].
        ground: Floor under the pile in the same frame [m].
        action: Parameters of the bucket-filling controller.
        machine: Machine parameters.
        soil: Soil parameters.
        settings: Time step; there are no derivatives, whatever the setting.

    Returns:
        `settings.max_steps` + 1 moments; the last has all cycles at their end.
    """

    def moment(state: State) -> Trajectory:
        return _moment(state, machine, soil)

    path: Trajectory = _recorded(moment, height, ground, action, machine, soil, settings)
    return path


def trace_section(
    height: Float[Array, "52 52"],
    ground: Float[Array, "52 52"],
    action: Action,
    *,
    machine: WheelLoader = WA320,
    soil: Soil = GRAVEL,
    settings: Settings = _SETTINGS,
) -> tuple[Trajectory, Section]:
    """The trajectory of `trace`, and beside it where the soil is by then.

    Args:
        height: As for `trace`.
        ground: As for `trace`.
        action: As for `trace`.
        machine: As for `trace`.
        soil: As for `trace`.
        settings: As for `trace`.
    """

    def moment(state: State) -> tuple[Trajectory, Section]:
        return _moment(state, machine, soil), _section(state, machine)

    both: tuple[Trajectory, Section] = _recorded(
        moment, height, ground, action, machine, soil, settings
    )
    return both


def _recorded(
    moment: Callable[[State], Any],
    height: Float[Array, "52 52"],
    ground: Float[Array, "52 52"],
    action: Action,
    machine: WheelLoader,
    soil: Soil,
    settings: Settings,
) -> Any:
    """What `moment` takes from the state at the start of every time step of one cycle."""

    def play(height: Array, ground: Array, action: Action) -> Any:
        def step(state: State, _: None) -> tuple[State, Any]:
            # Does nothing once all cycles have ended.
            after = advance(state, machine=machine, soil=soil, settings=settings, steps=1)
            return after, moment(state)

        state = begin(height, ground, action, machine)
        return lax.scan(step, state, None, length=settings.max_steps + 1)[1]

    one = jax.tree.map(lambda part: jnp.asarray(part)[..., None], (height, ground, action))
    return jax.tree.map(lambda part: part[..., 0], side_by_side(play)(*one))


def _moment(state: State, machine: WheelLoader, soil: Soil) -> Trajectory:
    """What a trajectory has of the state of cycles side by side."""
    tip_x, tip_z = loader.bucket_tip(machine, state.position, state.boom, state.tilt)
    return Trajectory(
        time=state.time,
        tip_x=tip_x,
        tip_z=tip_z,
        tilt=state.tilt,
        boom=state.boom,
        speed=state.speed,
        mass=terrain.total(state.fill) * soil.density,
        phase=state.phase,
    )


def _section(state: State, machine: WheelLoader) -> Section:
    """The middle of the same cycles: no column lies on the centre line, so those beside it."""
    columns = state.height.shape[1]
    middle = state.height[1:-1, columns // 2 - 1 : columns // 2 + 1]
    lanes = terrain.Lanes(machine)
    width = jnp.asarray(lanes.width, state.fill.dtype)
    inner = slice(lanes.count // 2 - 1, lanes.count // 2 + 1)
    return Section(
        surface=middle.mean(axis=1),
        content=(state.fill[inner] / jnp.broadcast_to(width, state.fill.shape)[inner]).mean(axis=0),
    )
