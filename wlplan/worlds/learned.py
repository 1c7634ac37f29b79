"""Learned worlds: a performance predictor ψ and a pile state. Paper, section 4.6."""

from __future__ import annotations

from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from wlplan.constants import KG_PER_TONNE
from wlplan.errors import InputError
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.automaton import (
    DEFAULT_SCHEDULE,
    Schedule,
    movable,
    settle_dug,
    steepest_slope,
    window_of,
)
from wlplan.terrain.automaton.windows import paste
from wlplan.terrain.heightmap import sample_local
from wlplan.types import (
    Action,
    Characteristics,
    Performance,
    Pile,
    Pose,
    SolveReport,
    action_vector,
)
from wlplan.worlds.pile_states import Dug, Strip, pile_state_of


@no_type_check
class LearnedWorld(struct.PyTreeNode, eq=False):
    """ψ predicts what a loading yields, the pile state what it leaves, the automaton how it slides.

    Any ψ goes with any pile state. The paper's low-dimensional world is ψ_low with the strip, its
    high-dimensional one ψ_high with φ, and the hybrid one ψ_high with the strip.

    Without `settle` the surface that φ predicts is left as it is. Sliding keeps its volume: a pile
    that was within the schedule's tolerance of the angle of repose is so afterwards. Over 8
    held-out rollouts of 30 loads of the high world that takes 71 ms instead of 29, and leaves a
    pile that differs from the simulator's by 3.0 m³ instead of 6.6, at most 33° steep instead of
    83°.
    """

    performance: Any  # ψ(local, action) -> Performance
    pile_state: Any = Strip()  # a pile state, or φ(local, action, volume, ground) -> change
    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    schedule: Schedule = struct.field(pytree_node=False, default=DEFAULT_SCHEDULE)
    settle: bool = struct.field(pytree_node=False, default=True)
    stall: Any = None  # stall(local, action) -> probability; None: it does not foresee stalls

    differentiable = True

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading.

        Where there is less than ψ predicts, the load is what is there.
        """
        after, performance, _ = _solve(self, pile, pose, action)
        return after, performance

    def solve(
        self, pile: Pile, pose: Pose, action: Action
    ) -> tuple[Pile, Performance, SolveReport]:
        """The same, and how the solvers ended."""
        solved: tuple[Pile, Performance, SolveReport] = _solve(self, pile, pose, action)
        return solved

    def foresee(self, pile: Pile, pose: Pose, action: Action) -> Performance:
        """The performance alone, the same as by calling it."""
        performance: Performance = _foresee(self, pile, pose, action)
        return performance

    def roughly(self) -> LearnedWorld:
        """The same with a part of the ensemble, if ψ is one."""
        performance = self.performance
        return self.replace(performance=getattr(performance, "roughly", lambda: performance)())

    @property
    def faces_seen(self) -> tuple[Characteristics, Characteristics] | None:
        """Least and largest characteristics that ψ was trained on; None: it does not say."""
        seen: tuple[Characteristics, Characteristics] | None = getattr(
            self.performance, "faces_seen", None
        )
        return seen

    @property
    def has_uncertainty(self) -> bool:
        """Whether ψ gives the uncertainty of what it predicts: an ensemble does."""
        return hasattr(self.performance, "with_deviation")

    def uncertainty(self, pile: Pile, pose: Pose, action: Action) -> Performance:
        """Standard deviation of the error of the predicted performance [tonne, s, kJ].

        It is that of one loading on the pile as given, whatever came before, and of what ψ
        predicts: where there is less to be loaded, it does not shrink. Differentiable.

        Raises:
            InputError: If ψ is no ensemble.
        """
        if not self.has_uncertainty:
            raise InputError(
                "the model of this world is a single network without uncertainty: train an "
                "ensemble with `wlplan train --members 5`."
            )
        deviation: Performance = _deviation(self, pile, pose, action)
        return deviation

    @property
    def has_stall_probability(self) -> bool:
        """Whether it has a predictor of stalls."""
        return self.stall is not None

    def stall_probability(self, pile: Pile, pose: Pose, action: Action) -> Float[Array, ""]:
        """Probability that a loading on the pile as given stalls [1]. Differentiable.

        Raises:
            InputError: If it has no predictor of stalls.
        """
        if not self.has_stall_probability:
            raise InputError(
                "this world has no predictor of stalls: train one with `wlplan train stall`, and "
                "give it to LearnedWorld(..., stall=...) or load_world(..., stall=...)."
            )
        probability: Array = _stall_probability(self.stall, pile, pose, action)
        return probability


def _dig(
    world: LearnedWorld, pile: Pile, pose: Pose, action: Action
) -> tuple[Performance, Dug, tuple[Array, Array]]:
    """What is loaded, and the part of the pile around it before it slides."""
    predicted = world.performance(sample_local(pile, pose), action_vector(action))
    window, start = window_of(pile, pose)
    per_volume = world.soil.density / KG_PER_TONNE
    dug = pile_state_of(world.pile_state).on_grid(
        pile, window, pose, action, predicted.mass / per_volume, world.machine
    )
    return predicted.replace(mass=dug.volume * per_volume), dug, start


@jax.jit
def _foresee(world: LearnedWorld, pile: Pile, pose: Pose, action: Action) -> Performance:
    return _dig(world, pile, pose, action)[0]


@jax.jit
def _solve(
    world: LearnedWorld, pile: Pile, pose: Pose, action: Action
) -> tuple[Pile, Performance, SolveReport]:
    performance, dug, start = _dig(world, pile, pose, action)
    repose = world.soil.repose_angle
    if world.settle:
        settled = settle_dug(pile, dug.height, start, repose_angle=repose, schedule=world.schedule)
        after = settled.pile
        report = SolveReport(settled.rounds, settled.at_rest, settled.steepest_slope, dug.missing)
    else:
        after = pile.replace(height=paste(pile.height, dug.height, jnp.stack(start)))
        slope = steepest_slope(after, movable(after, repose))
        report = SolveReport(jnp.zeros((), jnp.int32), jnp.array(False), slope, dug.missing)
    return after, performance, report


@jax.jit
def _deviation(world: LearnedWorld, pile: Pile, pose: Pose, action: Action) -> Performance:
    local, vector = sample_local(pile, pose), action_vector(action)
    deviation: Performance = world.performance.with_deviation(local, vector)[1]
    return deviation


@jax.jit
def _stall_probability(stall: Any, pile: Pile, pose: Pose, action: Action) -> Array:
    probability: Array = stall(sample_local(pile, pose), action_vector(action))
    return probability
