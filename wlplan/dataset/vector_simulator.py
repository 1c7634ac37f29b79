"""The vectorised simulator: cycles of many episodes side by side, each in a slot of its own."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from wlplan.constants import CELL_SIZE, J_PER_KJ
from wlplan.dataset.episode import Episode
from wlplan.engines.simulator import Simulator
from wlplan.engines.simulator.cycle import State, advance, begin, outcome
from wlplan.engines.simulator.lane import begin_in_lane, go_on, lane_of
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.terrain.heightmap import (
    PERFORMANCE_CELLS,
    PERFORMANCE_DISPLACEMENT,
    STATE_CELLS,
    STATE_DISPLACEMENT,
    local_points,
    sample,
    to_world,
)
from wlplan.types import Action, LocalHeightmap, Pile, Pose

# Cycles that one process computes side by side. Of half as many a time step takes 1.4 times as long
# a cycle, of twice as many no less; more leave more idle when the last episodes end.
_SLOTS = 32
# Time steps after which ended cycles make room for others. A cycle takes about 170 and waits half
# of these; more of them make fewer calls.
_STEPS = 10
# What a slot is at: under way, at the end of its cycle, or at the end of its approach lane.
_UNDER_WAY, _AT_END, _THROUGH_LANE = 0, 1, 2


class VectorSimulator:
    """Simulates episodes whose cycles are computed side by side, each at its own stage.

    A cycle that has ended makes room for the next of its episode at once, and an episode for
    another; so none waits for the slowest. What comes of an episode does not depend on the others.

    Args:
        simulator: The simulator.
        next_episode: Returns another episode; None when there are no more.
        report: Called with None after each loading, and with each episode when it is finished.
        stopped: Set from another thread when the rest is no longer wanted.
    """

    def __init__(
        self,
        simulator: Simulator,
        next_episode: Callable[[], Episode | None],
        report: Callable[[Episode | None], None],
        stopped: threading.Event,
    ):
        self.programs, self.stopped = _programs(simulator), stopped
        self.next_episode, self.report = next_episode, report
        self.states = _idle(simulator)
        self.slots: list[Episode | None] = [None] * _SLOTS
        self.views: list[Array] = [jnp.zeros(0)] * _SLOTS
        # Soil in the lanes, and once a cycle is through its lane what that has changed of it.
        self.lanes: list[Array] = [jnp.zeros(0)] * _SLOTS

    def run(self) -> None:
        """Simulates episodes until there are no more, or it is stopped."""
        for slot in range(_SLOTS):
            self._fill(slot)
        while any(self.slots) and not self.stopped.is_set():
            self.states, stages = self.programs.advance(self.states)
            for slot, stage in enumerate(np.asarray(stages).tolist()):
                if stage == _UNDER_WAY or self.slots[slot] is None:
                    continue
                if stage == _AT_END:
                    self._empty(slot)
                else:
                    self.states, self.lanes[slot] = self.programs.go_on(
                        self.states, slot, self.views[slot], self.lanes[slot]
                    )

    def _fill(self, slot: int) -> None:
        """Puts the next loading of a slot's episode there, or the first of another."""
        episode = self.slots[slot]
        if episode is None:
            episode = self.slots[slot] = self.next_episode()
            if episode is None:
                return
            episode.reset()
        pose, action = episode.next_loading()
        self.states, self.views[slot], self.lanes[slot] = self.programs.enter(
            self.states, slot, episode.origin, episode.height, pose, action
        )

    def _empty(self, slot: int) -> None:
        """Writes a loading back to its pile and goes on."""
        episode = self.slots[slot]
        assert episode is not None
        height, maps, numbers = self.programs.leave(
            *(self.states, slot, episode.origin, episode.height, episode.pose),
            *(self.views[slot], self.lanes[slot]),
        )
        episode.add_loading(height, jax.tree.map(np.asarray, maps) | _named(np.asarray(numbers)))
        self.report(None)
        if episode.load == episode.loads:
            self.report(episode)
            self.slots[slot] = None
        self._fill(slot)


# Cycles side by side, as the programs hand them to each other: the heightfields, and the rows of
# one array for all the rest. Each array of a call takes as long as some arithmetic.
_States = tuple[Array, ...]


def _pack(state: State) -> _States:
    leaves = jax.tree.leaves(state)
    small = [leaf.astype(jnp.float32) for leaf in leaves if leaf.ndim < 3]
    rows = jnp.concatenate([leaf.reshape(-1, leaf.shape[-1]) for leaf in small])
    return *(leaf for leaf in leaves if leaf.ndim == 3), rows


def _unpack(simulator: Simulator, states: _States) -> State:
    *large, rows = states
    cell = jnp.zeros((STATE_CELLS, STATE_CELLS, rows.shape[-1]), jnp.float32)
    number = cell[0, 0]
    begin_one = functools.partial(_begin, simulator)
    like, tree = jax.tree.flatten(
        jax.eval_shape(begin_one, cell, Action(number, number, number, number))
    )
    leaves, heightfields, row = [], iter(large), 0
    for leaf in like:
        if leaf.ndim == 3:
            leaves.append(next(heightfields))
            continue
        count = math.prod(leaf.shape[:-1])
        leaves.append(rows[row : row + count].reshape(leaf.shape).astype(leaf.dtype))
        row += count
    state: State = jax.tree.unflatten(tree, leaves)
    return state


def _begin(simulator: Simulator, height: Array, action: Action) -> State:
    """Cycles about to begin, leaves with the cycles as their last axis."""
    return begin(height, jnp.zeros_like(height), action, simulator.machine)


def _idle(simulator: Simulator) -> _States:
    """A full set of slots in which nothing goes on."""
    zero = jnp.zeros(_SLOTS, jnp.float32)
    height = jnp.zeros((STATE_CELLS, STATE_CELLS, _SLOTS), jnp.float32)
    states = _pack(_begin(simulator, height, Action(zero, zero, zero, zero)).ended())
    # Each an array of its own, for they are given away.
    return tuple(jnp.array(part, copy=True) for part in states)


def _advance(simulator: Simulator, states: _States) -> tuple[_States, Int[Array, " b"]]:
    """Some time steps further, and what each slot is at."""
    state = advance(
        _unpack(simulator, states),
        machine=simulator.machine,
        soil=simulator.soil,
        settings=simulator.settings,
        steps=_STEPS,
    )
    at_end = jnp.where(state.dig_x > 0.0, _THROUGH_LANE, _AT_END)
    return _pack(state), jnp.where(state.has_ended, at_end, _UNDER_WAY)


def _enter(
    simulator: Simulator,
    states: _States,
    slot: Int[Array, ""] | int,
    origin: Float[Array, "2"],
    height: Float[Array, "nx ny"],
    pose: Float[Array, "3"] | np.ndarray,
    action: Float[Array, "4"] | np.ndarray,
) -> tuple[_States, Float[Array, "52 52"], Float[Array, "52 52"]]:
    """The slots with a new loading in one of them, its surface, and the soil in its lane.

    Both in the local frame. Of a lane that is taken as free there is nothing to be known.
    """
    pile, dig_pose = Pile(height, CELL_SIZE, origin), Pose(*pose)
    view, _ = simulator.view(pile, dig_pose)
    one = Action(*(part[None] for part in action))
    if not simulator.lane_soil:
        return _put(states, slot, _begin(simulator, view[..., None], one)), view, view
    lane, is_met = lane_of(pile, dig_pose, simulator.machine)
    begun = lax.cond(
        is_met,
        lambda: begin_in_lane(lane[..., None], is_met[None], one, simulator.machine),
        lambda: _begin(simulator, view[..., None], one),
    )
    return _put(states, slot, begun), view, lane


def _put(states: _States, slot: Int[Array, ""] | int, begun: State) -> _States:
    pairs = zip(states, _pack(begun), strict=True)
    return tuple(all_.at[..., slot].set(new[..., 0]) for all_, new in pairs)


def _get(simulator: Simulator, states: _States, slot: Int[Array, ""] | int) -> State:
    return _unpack(simulator, tuple(part[..., slot][..., None] for part in states))


def _go_on(
    simulator: Simulator,
    states: _States,
    slot: Int[Array, ""] | int,
    view: Float[Array, "52 52"],
    lane: Float[Array, "52 52"],
) -> tuple[_States, Float[Array, "52 52"]]:
    """The slots with one of them through its lane, and what that has changed there."""
    one = _get(simulator, states, slot)
    main = _begin(simulator, view[..., None], one.action)
    begun, change = go_on(one, lane[..., None], main, simulator.machine)
    return _put(states, slot, begun), change[..., 0]


def _leave(
    simulator: Simulator,
    states: _States,
    slot: Int[Array, ""] | int,
    origin: Float[Array, "2"],
    height: Float[Array, "nx ny"],
    pose: Float[Array, "3"] | np.ndarray,
    view: Float[Array, "52 52"],
    lane: Float[Array, "52 52"],
) -> tuple[Float[Array, "nx ny"], dict[str, Array], Float[Array, " k"]]:
    """The surface after the loading of one slot, the local maps, and the numbers of `_named`."""
    one = _get(simulator, states, slot)
    cycles = outcome(one, machine=simulator.machine, soil=simulator.soil)
    cycle = jax.tree.map(lambda part: part[..., 0], cycles)
    if simulator.lane_soil:
        cycle = cycle.replace(lane_change=lane)
    pile, dig_pose = Pile(height, CELL_SIZE, origin), Pose(*pose)
    after, performance, _ = simulator.leave(pile, dig_pose, view, cycle)

    def reference(displacement: float) -> Array:
        point = to_world(dig_pose, jnp.asarray(-displacement), jnp.asarray(0.0))
        return sample(height, pile, *point)

    # The smaller map is a part of the larger, over a reference of its own.
    row = round((STATE_DISPLACEMENT - PERFORMANCE_DISPLACEMENT) / CELL_SIZE)
    column = (STATE_CELLS - PERFORMANCE_CELLS) // 2
    part = view[row : row + PERFORMANCE_CELLS, column : column + PERFORMANCE_CELLS]
    h36 = LocalHeightmap(
        part - reference(PERFORMANCE_DISPLACEMENT), CELL_SIZE, PERFORMANCE_DISPLACEMENT
    )
    h52 = view - reference(STATE_DISPLACEMENT)
    points = local_points(dig_pose, STATE_CELLS, STATE_DISPLACEMENT, height.dtype)
    maps = {
        "h36": h36.height,
        "h52": h52,
        # Sampling is linear, so the change can be sampled: where nothing moved it is zero.
        "h52_after": h52 + sample(after.height - height, pile, *points),
    }
    numbers = {
        "mass": performance.mass,
        "time": performance.time,
        "work": performance.work,
        "work_slip": cycle.work_slip / J_PER_KJ,
        "fill_time": cycle.fill_time,
        "stop_reason": cycle.stop_reason.astype(jnp.float32),
    }
    in_order = jnp.stack([numbers[name] for name in _NUMBERS])
    return after.height, maps, jnp.concatenate([in_order, as_vector(characteristics(h36))])


_NUMBERS = ("mass", "time", "work", "work_slip", "fill_time", "stop_reason")


def _named(numbers: Float[np.ndarray, " k"]) -> dict[str, Any]:
    """The variables that `_leave` returns as one array: `_NUMBERS`, and the characteristics."""
    count = len(_NUMBERS)
    return dict(zip(_NUMBERS, numbers[:count], strict=True)) | {"characteristics": numbers[count:]}


class _Programs(NamedTuple):
    """`_advance`, `_enter`, `_go_on` and `_leave` of one simulator, compiled."""

    advance: Callable[..., tuple[_States, Int[Array, " b"]]]
    enter: Callable[..., tuple[_States, Float[Array, "52 52"], Float[Array, "52 52"]]]
    go_on: Callable[..., tuple[_States, Float[Array, "52 52"]]]
    leave: Callable[..., tuple[Float[Array, "nx ny"], dict[str, Array], Float[Array, " k"]]]


@functools.cache
def _programs(simulator: Simulator) -> _Programs:
    # Bound to their simulator, for JAX takes 0.2 ms a call to look at it.
    def compiled(function: Callable[..., Any], **how: Any) -> Callable[..., Any]:
        program: Callable[..., Any] = jax.jit(functools.partial(function, simulator), **how)
        return program

    # The slots are changed where they are.
    return _Programs(
        compiled(_advance, donate_argnums=0),
        compiled(_enter, donate_argnums=0),
        compiled(_go_on, donate_argnums=0),
        compiled(_leave),
    )
