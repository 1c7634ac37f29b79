"""The simulator as a World: a cycle on the local heightfield, written back, and left to slide."""

from __future__ import annotations

import dataclasses
from typing import no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE, J_PER_KJ, KG_PER_TONNE
from wlplan.engines.simulator.cycle import Cycle, Settings, dig
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.automaton import DEFAULT_SCHEDULE, Schedule, settle_dug, window_of
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
        """The performance alone, the same as by calling it."""
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
        window, start = window_of(pile, pose)
        dug, missing, left = _written(window, pose, height, cycle)
        settled = settle_dug(
            pile,
            dug,
            start,
            repose_angle=self.soil.repose_angle,
            schedule=self.schedule,
        )
        performance = _performance(cycle, left, self.soil)
        report = SolveReport(settled.rounds, settled.at_rest, settled.steepest_slope, missing)
        return settled.pile, performance, report


def _written(
    window: Pile, pose: Pose, height: Float[Array, "52 52"], cycle: Cycle
) -> tuple[Float[Array, "n m"], Float[Array, ""], Float[Array, ""]]:
    """A loading written back to the part of the pile around it, before that slides.

    Returns:
        The part after [m]; what was to leave it and has not, since the loader dug beyond the edge
        of the map or deeper than there is soil [m^3]; and what has left it [m^3].
    """
    change = cycle.height - height
    # Rounding, step by step, may leave some 200 g more than was there, and no load.
    lost, gained = jnp.maximum(-change, 0.0).sum(), jnp.maximum(change, 0.0).sum()
    share = jnp.where(gained > lost, lost / jnp.where(gained > lost, gained, 1.0), 1.0)
    change = jnp.where(change > 0.0, share * change, change)
    dug, missing = add_local_change(window.height, window, pose, change, STATE_DISPLACEMENT)
    return dug, missing, CELL_SIZE**2 * (lost - share * gained) - missing


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
    cycle = dig(
        height,
        ground,
        action,
        machine=simulator.machine,
        soil=simulator.soil,
        settings=simulator.settings,
    )
    return height, cycle


@jax.jit
def _foresee(simulator: Simulator, pile: Pile, pose: Pose, action: Action) -> Performance:
    height, cycle = _dig(simulator, pile, pose, action)
    window, _ = window_of(pile, pose)
    *_, left = _written(window, pose, height, cycle)
    return _performance(cycle, left, simulator.soil)


@jax.jit
def _load(
    simulator: Simulator, pile: Pile, pose: Pose, action: Action
) -> tuple[tuple[Pile, Performance, SolveReport], Cycle]:
    """One loading, and the record of its cycle."""
    height, cycle = _dig(simulator, pile, pose, action)
    return simulator.leave(pile, pose, height, cycle), cycle
