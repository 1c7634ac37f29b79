"""The approach lane: soil that lies there is met, taken up and pushed before the pile is.

A cycle with soil in its lane has two halves. The first is played on a heightfield of its own, of
the same size and with the same laws, that begins `LENGTH` further back: there the bucket drives
level on the ground, with the controller at rest. Where the heightfield of the dig pose begins, the
cycle goes on in that one, with what lies in the bucket and ahead of it. A cycle whose lane is free
has no first half; its approach has a closed form.

The floor of the lane is taken as level, whatever it is: what counts is how thick the soil lies.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.constants import CELL_SIZE, GRAVITY
from wlplan.engines.simulator import terrain
from wlplan.engines.simulator.cycle import (
    Cycle,
    Settings,
    State,
    begin,
    outcome,
    play_out,
    played_alone,
)
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.heightmap import STATE_CELLS, STATE_DISPLACEMENT, local_axes, sample, to_world
from wlplan.types import Action, Pile, Pose

ROWS = 40
"""Rows of the lane's heightfield that lie behind the heightfield of the dig pose."""
LENGTH = ROWS * CELL_SIZE
"""How far they reach [m]: to 5 m before the dig location, where the paper's approach begins."""
RESIDUE = 0.01
"""The edge rides over a layer of this thickness [m]: a lane with no more is free. Estimate."""

# A cycle enters its lane so far before the first soil there [m]: what it reads ahead is free.
_BEFORE = 0.5

_ALONG, _LEFT = local_axes(STATE_CELLS, STATE_DISPLACEMENT + LENGTH)


def behind(pose: Pose) -> Pose:
    """The pose whose local heightfield has the lane of a dig pose in it."""
    x, y = to_world(pose, jnp.asarray(-LENGTH, pose.x.dtype), jnp.zeros((), pose.x.dtype))
    return pose.replace(x=x, y=y)


def lane_of(
    pile: Pile, pose: Pose, machine: WheelLoader
) -> tuple[Float[Array, "52 52"], Bool[Array, ""]]:
    """How thick the soil lies on the floor of the lane [m], and whether any is to be met.

    Beyond the edge of the pile's map there is none. Where none is to be met, the map has none.

    Args:
        pile: The pile, or a part of it.
        pose: Dig location and heading.
        machine: Its bucket decides how wide the lane is.
    """
    lanes = terrain.Lanes(machine)
    columns = slice(lanes.first, lanes.end)
    # The bucket starts at the end of its approach: what lies behind is not met.
    rows = np.flatnonzero(_ALONG[:ROWS] >= -machine.approach_distance)
    if not len(rows):
        return jnp.zeros((STATE_CELLS, STATE_CELLS), pile.height.dtype), jnp.asarray(False)

    def soil(rows: np.ndarray, columns: slice) -> Float[Array, "n m"]:
        axes = (jnp.asarray(axis, pile.height.dtype) for axis in (_ALONG[rows], _LEFT[columns]))
        x, y = to_world(pose, *jnp.meshgrid(*axes, indexing="ij"))
        height = sample(pile.height, pile, x, y)
        if pile.ground is not None:
            height = height - sample(pile.ground, pile, x, y)
        i, j = ((v - pile.origin[axis]) / pile.cell_size for axis, v in enumerate((x, y)))
        nx, ny = pile.height.shape
        inside = (i >= 0.0) & (i <= nx - 1.0) & (j >= 0.0) & (j <= ny - 1.0)
        return jnp.where(inside, jnp.maximum(height, 0.0), 0.0)

    is_met = (lax.stop_gradient(soil(rows, columns)) > RESIDUE).any()
    every = np.arange(STATE_CELLS)
    thickness = lax.cond(
        is_met,
        lambda: soil(every, slice(None)),
        lambda: jnp.zeros((STATE_CELLS, STATE_CELLS), pile.height.dtype),
    )
    return thickness, is_met


def begin_in_lane(
    thickness: Float[Array, "52 52 b"],
    is_met: Bool[Array, " b"],
    action: Action,
    machine: WheelLoader,
) -> State:
    """The first halves of cycles about to begin; where the lane is free they have ended.

    Args:
        thickness: Of the soil in the lane, see `lane_of` [m].
        is_met: Whether there is any to be met.
        action: Parameters of the bucket-filling controller, leaves of shape [b].
        machine: Machine parameters.
    """
    lanes = terrain.Lanes(machine)
    state = begin(thickness, jnp.minimum(thickness, RESIDUE), action, machine)
    met = thickness[:ROWS, lanes.first : lanes.end].max(axis=1) > RESIDUE
    first = jnp.argmax(met, axis=0).astype(thickness.dtype) * CELL_SIZE - STATE_DISPLACEMENT
    nearest = max(LENGTH - machine.approach_distance, -STATE_DISPLACEMENT)
    start = jnp.maximum(first - _BEFORE, nearest)
    travelled = start - LENGTH + machine.approach_distance
    all_of_it = jnp.full_like(start, machine.bucket_heaped * 10.0)
    return state.replace(
        position=start,
        reach=start,
        time=travelled / machine.travel_speed,
        work_drive=machine.rolling_resistance * machine.mass * GRAVITY * travelled,
        dig_x=jnp.where(is_met, LENGTH, 0.0).astype(start.dtype),
        taken=all_of_it,
        phase=jnp.where(is_met, state.phase, state.ended().phase),
    )


def go_on(
    state: State, thickness: Float[Array, "52 52 b"], main: State, machine: WheelLoader
) -> tuple[State, Float[Array, "52 52 b"]]:
    """The second halves of cycles that have come to the end of their first.

    Args:
        state: After the first half.
        thickness: Of the soil in the lane before it [m].
        main: The cycles begun as if their lanes were free.
        machine: Machine parameters.

    Returns:
        Cycles about to go on, those with a free lane as begun, and what has changed behind their
        heightfields in the lane [m]. A cycle that was stuck in its lane has ended.
    """
    was_met = state.dig_x > 0.0
    change = jnp.where(was_met, state.height[1:-1, 1:-1] - thickness, 0.0)
    ahead = jnp.pad(change[ROWS:], ((0, ROWS), (0, 0), (0, 0)))
    position = state.position - LENGTH
    arrived = main.replace(
        height=main.height + terrain.rimmed(ahead),
        fill=state.fill,
        taken=terrain.total(state.fill),
        time=state.time,
        position=position,
        speed=state.speed,
        boom=state.boom,
        tilt=state.tilt,
        reach=state.reach - LENGTH,
        boom_force=state.boom_force,
        boom_command=state.boom_command,
        tilt_command=state.tilt_command,
        dig_start=jnp.where(
            state.has_arrived, state.time - position / machine.travel_speed, state.dig_start
        ),
        stop_time=state.stop_time,
        stop_x=state.stop_x - LENGTH,
        stop_z=state.stop_z,
        work_drive=state.work_drive,
        work_boom=state.work_boom,
        work_bucket=state.work_bucket,
        work_slip=state.work_slip,
        stop_reason=state.stop_reason,
        phase=jnp.where(state.has_arrived, main.phase, state.phase),
    )
    halves: State = jax.tree.map(
        lambda begun, other: begun if other is begun else jnp.where(was_met, other, begun),
        main,
        arrived,
    )
    return halves, change.at[ROWS:].set(0.0)


def dig_through_lane(
    height: Float[Array, "52 52"],
    ground: Float[Array, "52 52"],
    lane: tuple[Float[Array, "52 52"], Bool[Array, ""]],
    action: Action,
    *,
    machine: WheelLoader = WA320,
    soil: Soil = GRAVEL,
    settings: Settings = Settings(),  # noqa: B008 (frozen)
) -> Cycle:
    """Plays one loading cycle with what lies in its approach lane.

    Args:
        height: Heights in the local frame of the dig pose, as for `dig` [m].
        ground: Floor under the pile in the same frame [m].
        lane: How thick soil lies in the lane, and whether it is met, see `lane_of`. Where it is
            not, this is `dig`.
        action: Parameters of the bucket-filling controller.
        machine: Machine parameters.
        soil: Soil parameters.
        settings: Time step, and whether reverse-mode derivatives must pass.
    """

    def play(height: Array, ground: Array, lane: tuple[Array, Array], action: Action) -> Cycle:
        main = begin(height, ground, action, machine)
        longer = (LENGTH + STATE_DISPLACEMENT) / machine.travel_speed

        # A loop of two, so that the time step is compiled once.
        def half(carry: tuple[State, Array], is_first: Array) -> tuple[tuple[State, Array], None]:
            state, change = carry
            state = play_out(state, machine=machine, soil=soil, settings=settings, longer=longer)
            return lax.cond(
                is_first, lambda: go_on(state, lane[0], main, machine), lambda: (state, change)
            ), None

        first = begin_in_lane(*lane, action, machine), jnp.zeros_like(height)
        (state, change), _ = lax.scan(half, first, jnp.array([True, False]))
        return outcome(state, machine=machine, soil=soil).replace(lane_change=change)

    return played_alone(play, settings, height, ground, lane, action)
