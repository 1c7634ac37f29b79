"""The simulator as a World: a cycle on the local heightfield, written back, and left to slide."""

from __future__ import annotations

import dataclasses
from typing import no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from wlplan.constants import J_PER_KJ, KG_PER_TONNE
from wlplan.engines.simulator.cycle import Cycle, Settings
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
        after, report = self._settled(pile, pose, cycle.height - height, cycle.lane_change)
        return after, _performance(cycle, report.missing, self.soil), report

    def _settled(
        self,
        pile: Pile,
        pose: Pose,
        change: Float[Array, "52 52"],
        lane_change: Float[Array, "52 52"] | None,
    ) -> tuple[Pile, SolveReport]:
        """Writes the changes of a loading to its pile and lets it slide, first in the lane."""

        def settle(
            surface: Array, pose: Pose, change: Array
        ) -> tuple[Array, tuple[Array, Array, Array, Array]]:
            before = pile.replace(height=surface)
            window, start = window_of(before, pose)
            dug, missing = add_local_change(window.height, window, pose, change, STATE_DISPLACEMENT)
            after = settle_dug(
                before, dug, start, repose_angle=self.soil.repose_angle, schedule=self.schedule
            )
            ended = after.rounds, after.at_rest, after.steepest_slope, missing
            height: Array = after.pile.height
            return height, ended

        if lane_change is None:
            height, ended = settle(pile.height, pose, change)
            return pile.replace(height=height), SolveReport(*ended)

        # A loop of two, so that the automaton is compiled once.
        def turn(
            surface: Array, part: tuple[Pose, Array, Array]
        ) -> tuple[Array, tuple[Array, ...]]:
            where, change, wanted = part
            nothing = jnp.zeros_like(surface[0, 0])
            rest = jnp.zeros((), jnp.int32), jnp.ones((), bool), nothing, nothing
            after: tuple[Array, tuple[Array, ...]] = lax.cond(
                wanted, lambda: settle(surface, where, change), lambda: (surface, rest)
            )
            return after

        is_met = (lane_change != 0.0).any()
        poses = jax.tree.map(lambda *v: jnp.stack(v), behind(pose), pose)
        changes = jnp.stack([lane_change, change])
        wanted = jnp.stack([is_met, jnp.ones((), bool)])
        height, (rounds, at_rest, slope, missing) = lax.scan(
            turn, pile.height, (poses, changes, wanted)
        )
        report = SolveReport(rounds.sum(), at_rest.all(), slope[1], missing.sum())
        return pile.replace(height=height), report


def _performance(cycle: Cycle, missing: Float[Array, ""], soil: Soil) -> Performance:
    """What a cycle yields; the load is what left the grid.

    The loader may have dug beyond the edge of the map, or deeper than there is soil. Rounding of
    the time stepping goes to the mass.
    """
    work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
    mass = jnp.maximum(cycle.mass - soil.density * missing, 0.0)
    return Performance(mass=mass / KG_PER_TONNE, time=cycle.time, work=work / J_PER_KJ)


def _dig(
    simulator: Simulator, pile: Pile, pose: Pose, action: Action
) -> tuple[Float[Array, "52 52"], Cycle]:
    height, ground = simulator.view(pile, pose)
    cycle = dig_through_lane(
        height,
        ground,
        lane_of(pile, pose, simulator.machine),
        action,
        machine=simulator.machine,
        soil=simulator.soil,
        settings=simulator.settings,
    )
    return height, cycle


@jax.jit
def _foresee(simulator: Simulator, pile: Pile, pose: Pose, action: Action) -> Performance:
    height, cycle = _dig(simulator, pile, pose, action)
    change, lane_change = cycle.height - height, cycle.lane_change
    assert lane_change is not None
    surface, missing = lax.cond(
        (lane_change != 0.0).any(),
        lambda: _written(pile, behind(pose), lane_change),
        lambda: (pile.height, jnp.zeros_like(change[0, 0])),
    )
    _, more = _written(pile.replace(height=surface), pose, change)
    return _performance(cycle, missing + more, simulator.soil)


def _written(
    pile: Pile, pose: Pose, change: Float[Array, "52 52"]
) -> tuple[Float[Array, "nx ny"], Float[Array, ""]]:
    """A pile's surface after a change before it slides [m], and what is missing of it [m^3]."""
    window, start = window_of(pile, pose)
    dug, missing = add_local_change(window.height, window, pose, change, STATE_DISPLACEMENT)
    return paste(pile.height, dug, jnp.stack(start)), missing


@jax.jit
def _load(
    simulator: Simulator, pile: Pile, pose: Pose, action: Action
) -> tuple[tuple[Pile, Performance, SolveReport], Cycle]:
    """One loading, and the record of its cycle."""
    height, cycle = _dig(simulator, pile, pose, action)
    return simulator.leave(pile, pose, height, cycle), cycle
