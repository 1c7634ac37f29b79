"""The discrete elements as a World: sampled from the pile, dug, written back, and left to slide."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE, J_PER_KJ, KG_PER_TONNE
from wlplan.engines.dem import columns, process
from wlplan.engines.dem.bed import DEPTH
from wlplan.engines.dem.cycle import CycleRecord, change_of
from wlplan.engines.dem.grains import DemSettings
from wlplan.errors import InputError
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.automaton import DEFAULT_SCHEDULE, Schedule, settle_dug, window_of
from wlplan.terrain.heightmap import add_local_change, local_points, sample
from wlplan.types import Action, Performance, Pile, Pose, action_vector

# Where a pile higher than the bed matters: as far ahead as a loading moves soil [m], and how much
# of it has to be missing, as a mean over the bucket's width [m].
_MATTERS, _MISSING = 4.2, 0.1
# Soil taken out of the bucket's way before a loading that is worth a word [m^3].
_CLEARED = 0.1


@no_type_check
class DiscreteElements(struct.PyTreeNode):
    """A World that plays each loading with spheres, in a process of its own; all fields are static.

    A loading takes a minute or more. It works under `jit`, `vmap` (one after the other) and in
    `wlplan.rollout`. It has no derivative.
    """

    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    settings: DemSettings = struct.field(pytree_node=False, default=DemSettings())
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)

    differentiable = False

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Raises:
            InputError: If the engine is missing or fails, or a derivative is asked for. Under `jit`
                JAX wraps it into an error of its own.
        """
        surface, numbers = self.view(pile, pose), action_vector(action)
        result = _without_derivative(self, surface, numbers.astype(surface.dtype))
        return self.leave(pile, pose, *result)

    def view(self, pile: Pile, pose: Pose) -> Float[Array, "n n"]:
        """Height of the soil over its floor in the local frame of a dig pose [m].

        The engine's floor is level: where the pile's is not, the soil is laid down on a level one.
        """
        height: Array = _view(pile, pose)
        return height

    def play(
        self, surface: np.ndarray, action: np.ndarray, tell: Callable[[str], None]
    ) -> CycleRecord:
        """Plays one loading in the engine.

        Args:
            surface: As of `view`.
            action: delta_bm, k_bm, delta_bk, k_bk.
            tell: Called with a note on soil that the engine does not see.

        Raises:
            InputError: If the engine is missing or fails.
        """
        missing = _above_bed(surface, self.machine)
        if missing > _MISSING:
            tell(
                f"the pile ahead of the dig is {missing:.1f} m higher on average than the bed of "
                f"{DEPTH:g} m that it is cut from: what is above is left out"
            )
        played = process.play(
            np.asarray(surface),
            np.asarray(action),
            machine=self.machine,
            soil=self.soil,
            settings=self.settings,
        )
        if played.cleared > _CLEARED:
            tell(
                f"{played.cleared:.1f} m³ of soil lay where the bucket starts, behind the dig: it "
                f"was left out of the loading"
            )
        return played

    def play_load(
        self, pile: Pile, pose: Pose, action: Action, note: Callable[[str], None]
    ) -> tuple[Pile, Performance, CycleRecord]:
        """Plays one loading outside of any trace.

        What was played is in the cache: to continue after an interrupt, begin again.

        Args:
            pile: Pile before.
            pose: Dig location and heading.
            action: Parameters of the bucket-filling controller.
            note: As of `play`.

        Returns:
            The pile after, the performance, and the record of the cycle.

        Raises:
            InputError: As of `play`.
        """
        surface, numbers = self.view(pile, pose), action_vector(action)
        played = self.play(np.asarray(surface), np.asarray(numbers), note)
        change, outcome = (
            jnp.asarray(part, pile.height.dtype) for part in outcome_of(played, self)
        )
        return *self.leave(pile, pose, change, outcome), played

    def notes(self) -> list[str]:
        """What to know before a plan is played."""
        ignored = [
            name
            for name in ("friction", "cohesion", "adhesion")
            if getattr(self.soil, name) != getattr(GRAVEL, name)
        ]
        notes = [
            f"the spheres are gravel: of the soil only density and friction on steel carry over, "
            f"{' and '.join(ignored)} not"
        ]
        return (notes if ignored else []) + [
            f"a load takes a minute or more; those that were played are kept in "
            f"{process.cache_folder()}, so that the same command continues where it was interrupted"
        ]

    def leave(
        self,
        pile: Pile,
        pose: Pose,
        change: Float[Array, "n n"],
        numbers: Float[Array, "3"],
    ) -> tuple[Pile, Performance]:
        """Writes a loading back to its pile.

        Args:
            pile: Pile before.
            pose: Dig location and heading.
            change: Of the column heights in the local frame; its sum is the load [m].
            numbers: Mass [tonne], time [s] and work [kJ].

        Returns:
            The pile after, relaxed, and the performance.
        """
        after, missing = _leave(pile, pose, change, self.soil.repose_angle, self.schedule)
        # What left the grid is the load, as in the simulator.
        mass = jnp.maximum(numbers[0] - missing * self.soil.density / KG_PER_TONNE, 0.0)
        return after, Performance(mass, numbers[1], numbers[2])


@jax.jit
def _view(pile: Pile, pose: Pose) -> Float[Array, "n n"]:
    points = local_points(pose, columns.CELLS, columns.DISPLACEMENT, pile.height.dtype)
    return jnp.maximum(sample(pile.height - pile.floor, pile, *points), 0.0)


@functools.partial(jax.jit, static_argnums=(3, 4))
def _leave(
    pile: Pile, pose: Pose, change: Float[Array, "n n"], repose_angle: float, schedule: Schedule
) -> tuple[Pile, Float[Array, ""]]:
    """The pile after, relaxed, and what of the load was not there [m^3]."""
    window, start = window_of(pile, pose)
    dug, missing = add_local_change(window.height, window, pose, change, columns.DISPLACEMENT)
    settled = settle_dug(pile, dug, start, repose_angle=repose_angle, schedule=schedule)
    return settled.pile, missing


def outcome_of(cycle: CycleRecord, world: DiscreteElements) -> tuple[np.ndarray, np.ndarray]:
    """What `DiscreteElements.leave` takes of a cycle: the change, and the numbers."""
    work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
    numbers = [cycle.mass / KG_PER_TONNE, cycle.time, work / J_PER_KJ]
    return change_of(cycle, world.soil.density), np.array(numbers)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _without_derivative(world: DiscreteElements, surface: Array, numbers: Array) -> Any:
    dtype = surface.dtype

    def call(surface: Array, numbers: Array) -> tuple[np.ndarray, np.ndarray]:
        played = world.play(np.asarray(surface), np.asarray(numbers), _warn)
        change, outcome = outcome_of(played, world)
        return change.astype(dtype), outcome.astype(dtype)

    if not any(isinstance(part, jax.core.Tracer) for part in (surface, numbers)):
        # Without a trace, errors arrive as they are.
        return tuple(jnp.asarray(part) for part in call(surface, numbers))
    shapes = (
        jax.ShapeDtypeStruct((columns.CELLS, columns.CELLS), dtype),
        jax.ShapeDtypeStruct((3,), dtype),
    )
    return jax.pure_callback(call, shapes, surface, numbers, vmap_method="sequential")


@_without_derivative.defjvp
def _no_jvp(world: DiscreteElements, primals: Any, tangents: Any) -> Any:
    raise InputError(
        "the discrete elements have no derivative: plan in a learned world, or use a planner "
        "without gradients."
    )


def _warn(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=2)


def _above_bed(surface: np.ndarray, machine: WheelLoader) -> float:
    """Mean height of the soil that the bed is too low for, where it matters [m]."""
    x, y = columns.axes()
    near = np.asarray(surface)[np.ix_((x > 0.0) & (x < _MATTERS), np.abs(y) < _half(machine))]
    return float(np.maximum(near - DEPTH, 0.0).max(axis=0).mean())


def _half(machine: WheelLoader) -> float:
    return math.ceil(0.5 * machine.bucket_width / CELL_SIZE) * CELL_SIZE
