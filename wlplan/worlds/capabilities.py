"""What worlds say they can do, beside being called.

A world is any function `world(pile, pose, action) -> (pile_after, performance)`. Attributes say
more, where there is more to say:

* `differentiable`: True or False. A function that says nothing is differentiated when a planner
  asks for it, and refused if that fails.
* `has_uncertainty`: whether `uncertainty(pile, pose, action)` gives the standard deviation of the
  error of the performance.
* `faces_seen`: the least and the largest characteristics of the faces that it was trained on.
* `solve(pile, pose, action)`: as by calling it, with a `SolveReport` besides.
* `with_derivatives()`: the same world in the form that has derivatives.
* `play_load(pile, pose, action, note)`: plays one loading outside of any trace and returns pile,
  performance and a record, for worlds in which a loading takes minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import no_type_check

import jax
from flax import struct

from wlplan.errors import InputError
from wlplan.types import Action, Performance, Pile, Pose, World

Uncertainty = Callable[[Pile, Pose, Action], Performance]
"""`uncertainty(pile, pose, action)`: the standard deviation of the error of the performance."""


@no_type_check
class FunctionWorld(struct.PyTreeNode):
    """A plain function as a world that can be passed to jitted functions, and what it can do."""

    function: World = struct.field(pytree_node=False)
    differentiable: bool | None = struct.field(pytree_node=False, default=None)  # None: not said
    deviation: Uncertainty | None = struct.field(pytree_node=False, default=None)

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


def world(
    function: World,
    *,
    differentiable: bool = True,
    uncertainty: Uncertainty | None = None,
) -> FunctionWorld:
    """A function as a world that says what it can do.

    Args:
        function: `function(pile, pose, action) -> (pile_after, performance)`. One that calls out
            of JAX, for instance by `jax.pure_callback`, has no derivative.
        differentiable: Whether it passes reverse mode.
        uncertainty: `uncertainty(pile, pose, action) -> Performance`, the standard deviation of
            the error of its performance; None: it does not know.
    """
    return FunctionWorld(function, differentiable, uncertainty)


def as_pytree(world: World) -> World:
    """A world that can be passed to a jitted function: a plain function becomes a static part."""
    if any(callable(leaf) for leaf in jax.tree.leaves(world)):
        return FunctionWorld(world, getattr(world, "differentiable", None))
    return world


def is_differentiable(world: World) -> bool | None:
    """Whether a world has a derivative; None if it does not say."""
    return getattr(world, "differentiable", None)


def with_derivatives(world: World) -> World:
    """The world in the form that has derivatives, where it has several."""
    return getattr(world, "with_derivatives", lambda: world)()
