"""What worlds say they can do, beside being called.

A world is any function `world(pile, pose, action) -> (pile_after, performance)`. Attributes say
more, where there is more to say:

* `differentiable`: True or False. A function that says nothing is differentiated when a planner
  asks for it, and refused if that fails.
* `has_uncertainty`: whether `uncertainty(pile, pose, action)` gives the standard deviation of the
  error of the performance.
* `has_stall_probability`: whether `stall_probability(pile, pose, action)` gives the probability
  that the loading stalls.
* `faces_seen`: the least and the largest characteristics of the faces that it was trained on.
* `foresee(pile, pose, action)`: the performance alone, where that takes less than the pile after.
* `roughly()`: a world that foresees about the same in less time, to find what is worth a look.
* `solve(pile, pose, action)`: as by calling it, with a `SolveReport` besides.
* `with_derivatives()`: the same world in the form that has derivatives.
* `play_load(pile, pose, action, note)`: plays one loading outside of any trace and returns pile,
  performance and a record, for worlds in which a loading takes minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, no_type_check

import jax
from flax import struct
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.types import Action, Performance, Pile, Pose, World

Uncertainty = Callable[[Pile, Pose, Action], Performance]
"""`uncertainty(pile, pose, action)`: the standard deviation of the error of the performance."""

StallProbability = Callable[[Pile, Pose, Action], Float[Array, ""]]
"""`stall_probability(pile, pose, action)`: how likely the limit of time ends the filling."""

FORESIGHT = {
    "uncertainty": "the uncertainty of its performance",
    "stall_probability": "how likely a loading stalls",
}
"""What a world may know of a loading beside its outcome, and what that is in words."""


@no_type_check
class FunctionWorld(struct.PyTreeNode):
    """A plain function as a world that can be passed to jitted functions, and what it can do."""

    function: World = struct.field(pytree_node=False)
    differentiable: bool | None = struct.field(pytree_node=False, default=None)  # None: not said
    deviation: Uncertainty | None = struct.field(pytree_node=False, default=None)
    stall: StallProbability | None = struct.field(pytree_node=False, default=None)

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading."""
        return self.function(pile, pose, action)

    @property
    def has_uncertainty(self) -> bool:
        """Whether it gives the uncertainty of its performance."""
        return self.deviation is not None

    def uncertainty(self, pile: Pile, pose: Pose, action: Action) -> Performance:
        """Standard deviation of the error of the performance [tonne, s, kJ].

        Raises:
            InputError: If the world has none.
        """
        if self.deviation is None:
            raise InputError(
                "this world has no uncertainty: give it one with wlplan.world(function, "
                "uncertainty=...)."
            )
        return self.deviation(pile, pose, action)

    @property
    def has_stall_probability(self) -> bool:
        """Whether it foresees stalls."""
        return self.stall is not None

    def stall_probability(self, pile: Pile, pose: Pose, action: Action) -> Float[Array, ""]:
        """Probability that the loading stalls [1].

        Raises:
            InputError: If the world does not know it.
        """
        if self.stall is None:
            raise InputError(
                "this world does not foresee stalls: give it what does with "
                "wlplan.world(function, stall_probability=...)."
            )
        return self.stall(pile, pose, action)


def world(
    function: World,
    *,
    differentiable: bool = True,
    uncertainty: Uncertainty | None = None,
    stall_probability: StallProbability | None = None,
) -> FunctionWorld:
    """A function as a world that says what it can do.

    Args:
        function: `function(pile, pose, action) -> (pile_after, performance)`. One that calls out
            of JAX, for instance by `jax.pure_callback`, has no derivative.
        differentiable: Whether it passes reverse mode.
        uncertainty: `uncertainty(pile, pose, action) -> Performance`, the standard deviation of
            the error of its performance; None: it does not know.
        stall_probability: `stall_probability(pile, pose, action)`, a number from 0 to 1; None: it
            does not know.
    """
    return FunctionWorld(function, differentiable, uncertainty, stall_probability)


def as_pytree(world: World) -> World:
    """A world that can be passed to a jitted function: a plain function becomes a static part."""
    if any(callable(leaf) for leaf in jax.tree.leaves(world)):
        return FunctionWorld(
            world,
            getattr(world, "differentiable", None),
            *(getattr(world, name) if can(world, name) else None for name in FORESIGHT),
        )
    return world


def foresee(world: World, pile: Pile, pose: Pose, action: Action) -> Performance:
    """The performance of a loading, whatever becomes of the pile."""
    alone = getattr(world, "foresee", None)
    performance: Performance = (
        world(pile, pose, action)[1] if alone is None else alone(pile, pose, action)
    )
    return performance


def roughly(world: World) -> World:
    """The world in the form that is quick and rough, where it has one."""
    return getattr(world, "roughly", lambda: world)()


def can(world: Any, name: str) -> bool:
    """Whether a world, if there is one, knows one of `FORESIGHT`."""
    return bool(getattr(world, f"has_{name}", False))


def is_differentiable(world: World) -> bool | None:
    """Whether a world has a derivative; None if it does not say."""
    return getattr(world, "differentiable", None)


def with_derivatives(world: World) -> World:
    """The world in the form that has derivatives, where it has several."""
    return getattr(world, "with_derivatives", lambda: world)()
