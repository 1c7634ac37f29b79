"""The simulator as a World: a cycle on the local heightfield, written back, and left to slide."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE, J_PER_KJ, KG_PER_TONNE
from wlplan.engines.simulator.cycle import Cycle, Settings, dig
from wlplan.engines.simulator.lane import behind, dig_through_lane, lane_of
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.automaton import (
    DEFAULT_SCHEDULE,
    Schedule,
    paste,
    settle_dug,
    window_of,
)
from wlplan.terrain.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    add_local_change,
    local_points,
    sample,
)
from wlplan.types import Action, Performance, Pile, Pose, SolveReport


@no_type_check
class Simulator(struct.PyTreeNode):
    """A World that plays the loading cycle; all fields are static."""

    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    settings: Settings = struct.field(pytree_node=False, default=Settings())
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)
    lane_soil: bool = struct.field(pytree_node=False, default=False)
    """Whether soil that lies in the approach lane is met; otherwise the lane is taken as free."""

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        The loader stands on the floor at the dig location, level; a floor that rises into the
        pile limits the cut from below. The pile is relaxed; the work includes the wheels' slip.
        """
        (after, performance, _), _ = _load(self, pile, pose, action)
        return after, performance

    def foresee(self, pile: Pile, pose: Pose, action: Action) -> Performance:
        """The performance alone, the same as by calling it.

        But for soil that is not there to be dug because it has slid off in the lane before.
        """
        performance: Performance = _foresee(self, pile, pose, action)
        return performance

    @property
    def differentiable(self) -> bool:
        """Whether it passes reverse mode, which takes several times as long."""
        return self.settings.differentiable

    def with_derivatives(self) -> Simulator:
        """The same simulator, in the setting that passes reverse mode."""
        return self.replace(settings=dataclasses.replace(self.settings, differentiable=True))

    def solve(
        self, pile: Pile, pose: Pose, action: Action
    ) -> tuple[Pile, Performance, SolveReport]:
        """One loading as by calling it, and how the automaton ended."""
        solved: tuple[Pile, Performance, SolveReport] = _load(self, pile, pose, action)[0]
        return solved

    def play(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance, Cycle]:
        """One loading with its record.

        Args:
            pile: Pile before.
            pose: Dig location and heading.
            action: Parameters of the bucket-filling controller.

        Returns:
            The pile after, relaxed; the performance; and the record of the cycle in SI units.
        """
        (after, performance, _), cycle = _load(self, pile, pose, action)
        return after, performance, cycle

    def view(self, pile: Pile, pose: Pose) -> tuple[Float[Array, "52 52"], Float[Array, "52 52"]]:
        """Surface and floor in the local frame of a dig pose, over the floor there [m]."""
        window, _ = window_of(pile, pose)
        points = local_points(pose, STATE_CELLS, STATE_DISPLACEMENT, pile.height.dtype)
        if window.ground is None:
            height = sample(window.height, window, *points)
            return height, jnp.zeros_like(height)
        level = sample(window.ground, window, pose.x, pose.y)
        height = sample(window.height, window, *points) - level
        return height, sample(window.ground, window, *points) - level

    def leave(
        self, pile: Pile, pose: Pose, height: Float[Array, "52 52"], cycle: Cycle
    ) -> tuple[Pile, Performance, SolveReport]:
        """Writes a loading back to its pile.

        Args:
            pile: Pile before.
            pose: Dig location and heading.
            height: Surface before in the local frame, see `view` [m].
            cycle: Record of the loading.

        Returns:
            The pile after, relaxed, the performance, and how the automaton ended.
        """
        changes = _changes(height, cycle)
        after, report = self._settled(pile, pose, changes)
        return after, _performance(cycle, changes.taken - report.missing, self.soil), report

    def _settled(self, pile: Pile, pose: Pose, changes: _Changes) -> tuple[Pile, SolveReport]:
        """The pile with what a loading changes, slid: in the lane first, where there is one."""

        def settle(
            surface: Array, pose: Pose, change: Array
        ) -> tuple[Array, tuple[Array, Array, Array, Array]]:
            before = pile.replace(height=surface)
            dug, start, missing = _written(before, pose, change)
            after = settle_dug(
                before, dug, start, repose_angle=self.soil.repose_angle, schedule=self.schedule
            )
            height: Array = after.pile.height
            return height, (after.rounds, after.at_rest, after.steepest_slope, missing)

        if changes.in_lane is None:
            height, ended = settle(pile.height, pose, changes.ahead)
            return pile.replace(height=height), SolveReport(*ended)

        # A loop of two, so that the automaton is compiled once.
        def turn(
            surface: Array, part: tuple[Pose, Array, Array]
        ) -> tuple[Array, tuple[Array, ...]]:
            where, change, is_wanted = part
            nothing = jnp.zeros_like(surface[0, 0])
            rest = jnp.zeros((), jnp.int32), jnp.ones((), bool), nothing, nothing
            after: tuple[Array, tuple[Array, ...]] = lax.cond(
                is_wanted, lambda: settle(surface, where, change), lambda: (surface, rest)
            )
            return after

        poses = jax.tree.map(lambda *v: jnp.stack(v), behind(pose), pose)
        both = jnp.stack([changes.in_lane, changes.ahead])
        is_wanted = jnp.stack([(changes.in_lane != 0.0).any(), jnp.ones((), bool)])
        height, (rounds, at_rest, slope, missing) = lax.scan(
            turn, pile.height, (poses, both, is_wanted)
        )
        # The way through a loop gives even these tangents, of which JAX has no rule.
        rounds, at_rest = lax.stop_gradient((rounds, at_rest))
        report = SolveReport(rounds.sum(), at_rest.all(), slope[1], missing.sum())
        return pile.replace(height=height), report


def with_lane_soil(**parts: Any) -> Simulator:
    """A simulator whose loader meets the soil in its approach lane; parts as of `Simulator`."""
    return Simulator(**parts, lane_soil=True)


class _Changes(NamedTuple):
    """What a loading changes of the surface, in the frames of its pose and of its lane."""

    ahead: Float[Array, "52 52"]  # [m]
    in_lane: Float[Array, "52 52"] | None  # None: the lane is taken as free [m]
    taken: Float[Array, ""]  # what leaves both [m^3]


def _changes(height: Float[Array, "52 52"], cycle: Cycle) -> _Changes:
    """The changes of a cycle that dug a surface [m].

    Rounding, step by step, may leave some 200 g more than was there, and no load.
    """
    parts = [cycle.height - height]
    if cycle.lane_change is not None:
        parts.append(cycle.lane_change)
    lost = jnp.stack([jnp.maximum(-part, 0.0).sum() for part in parts]).sum()
    gained = jnp.stack([jnp.maximum(part, 0.0).sum() for part in parts]).sum()
    share = jnp.where(gained > lost, lost / jnp.where(gained > lost, gained, 1.0), 1.0)
    parts = [jnp.where(part > 0.0, share * part, part) for part in parts]
    taken = CELL_SIZE**2 * (lost - share * gained)
    return _Changes(parts[0], parts[1] if len(parts) > 1 else None, taken)


def _written(
    pile: Pile, pose: Pose, change: Float[Array, "52 52"]
) -> tuple[Float[Array, "n m"], tuple[Array, Array], Float[Array, ""]]:
    """A change written to the part of the pile around its pose, before that slides.

    Returns:
        The part after [m]; its first cell; and what was to leave it and has not, since the loader
        dug beyond the edge of the map or deeper than there is soil [m^3].
    """
    window, start = window_of(pile, pose)
    dug, missing = add_local_change(window.height, window, pose, change, STATE_DISPLACEMENT)
    return dug, start, missing


def _performance(cycle: Cycle, left: Float[Array, ""], soil: Soil) -> Performance:
    """What a cycle yields; the load is what left the grid [m^3].

    That is not `cycle.mass`: in float32 a bucket that pushes until its time is up may count some
    200 g too much, step by step.
    """
    work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
    mass = jnp.maximum(soil.density * left, 0.0)
    return Performance(mass=mass / KG_PER_TONNE, time=cycle.time, work=work / J_PER_KJ)


def _dig(
    simulator: Simulator, pile: Pile, pose: Pose, action: Action
) -> tuple[Float[Array, "52 52"], Cycle]:
    height, ground = simulator.view(pile, pose)
    machine, soil, settings = simulator.machine, simulator.soil, simulator.settings
    if not simulator.lane_soil:
        cycle = dig(height, ground, action, machine=machine, soil=soil, settings=settings)
        return height, cycle
    lane = lane_of(pile, pose, machine)
    cycle = dig_through_lane(
        height, ground, lane, action, machine=machine, soil=soil, settings=settings
    )
    return height, cycle


@jax.jit
def _foresee(simulator: Simulator, pile: Pile, pose: Pose, action: Action) -> Performance:
    height, cycle = _dig(simulator, pile, pose, action)
    changes = _changes(height, cycle)
    surface, missing = pile.height, jnp.zeros_like(changes.taken)
    if changes.in_lane is not None:
        in_lane = changes.in_lane

        def written() -> tuple[Array, Array]:
            dug, start, missing = _written(pile, behind(pose), in_lane)
            return paste(pile.height, dug, jnp.stack(start)), missing

        surface, missing = lax.cond((in_lane != 0.0).any(), written, lambda: (surface, missing))
    *_, more = _written(pile.replace(height=surface), pose, changes.ahead)
    return _performance(cycle, changes.taken - missing - more, simulator.soil)


@jax.jit
def _load(
    simulator: Simulator, pile: Pile, pose: Pose, action: Action
) -> tuple[tuple[Pile, Performance, SolveReport], Cycle]:
    """One loading, and the record of its cycle."""
    height, cycle = _dig(simulator, pile, pose, action)
    return simulator.leave(pile, pose, height, cycle), cycle
