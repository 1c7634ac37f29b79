"""The motion of a loading, step by step: `dig` keeps its outcome only."""

from __future__ import annotations

from typing import no_type_check

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

    def play(height: Array, ground: Array, action: Action) -> Trajectory:
        def step(state: State, _: None) -> tuple[State, Trajectory]:
            # Does nothing once all cycles have ended.
            after = advance(state, machine=machine, soil=soil, settings=settings, steps=1)
            return after, _moment(state, machine, soil)

        state = begin(height, ground, action, machine)
        return lax.scan(step, state, None, length=settings.max_steps + 1)[1]

    one = jax.tree.map(lambda part: jnp.asarray(part)[..., None], (height, ground, action))
    path: Trajectory = jax.tree.map(lambda part: part[..., 0], side_by_side(play)(*one))
    return path


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
