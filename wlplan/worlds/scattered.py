"""A world with the scatter of a real pile: the same dig never loads quite the same twice.

In discrete elements, two packings of grains on the same surface with the same action differ by
some percent. A world that is deterministic knows nothing of that. `scattered` draws it: factors on
mass, time and work of each loading, lognormal and correlated as the repeats in `tests/references`
are. Whether a loading stalls is left to the world.
"""

from __future__ import annotations

from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from wlplan.types import Action, Performance, Pile, Pose, SolveReport, World
from wlplan.worlds.capabilities import as_pytree, is_differentiable, with_derivatives

# Deviations of the logarithms of mass, time and work between packings, and their correlations:
# `python -m experiments.dem_reference`, 12 cycles of the four surfaces that stall in none.
DEVIATION = (0.029, 0.013, 0.013)
CORRELATION = ((1.0, 0.36, 0.81), (0.36, 1.0, 0.52), (0.81, 0.52, 1.0))
# No draw lies further out than this, in deviations.
_FURTHEST = 3.0
# Poses and actions that differ by less than this are the same loading [m, rad, 1].
_ALIKE = 1e-3


@no_type_check
class Scattered(struct.PyTreeNode):
    """A world whose outcomes scatter; made by `scattered`."""

    world: World
    seed: Int[Array, ""]  # of the scatter; `vmap` over several for as many outcomes
    deviation: Float[Array, "3"]  # of the logarithms of mass, time and work [1]

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile and the performance after one loading."""
        after, performance = self.world(pile, pose, action)
        return self._scattered(pile, pose, action, after, performance)

    @property
    def differentiable(self) -> bool | None:
        """Whether the world without scatter has a derivative."""
        return is_differentiable(self.world)

    def with_derivatives(self) -> Scattered:
        """The same scatter on the world in the form that has derivatives."""
        return self.replace(world=with_derivatives(self.world))

    def _scattered(
        self, pile: Pile, pose: Pose, action: Action, after: Pile, performance: Performance
    ) -> tuple[Pile, Performance]:
        """What a loading leaves and yields with scatter; without it, `after` and `performance`."""
        factor = self.factors(pose, action).astype(pile.height.dtype)
        # More or less of what was moved is moved; what lies on the floor cannot be less.
        change = after.height - pile.height
        height = jnp.maximum(
            pile.height + factor[0] * change, jnp.minimum(pile.floor, after.height)
        )
        # The load is what has left the pile, exactly.
        lost, more = -change.sum(), (after.height - height).sum()
        mass = performance.mass * (1.0 + more / jnp.where(lost > 0.0, lost, jnp.inf))
        scattered = Performance(mass, performance.time * factor[1], performance.work * factor[2])
        return after.replace(height=height), scattered

    def factors(self, pose: Pose, action: Action) -> Float[Array, "3"]:
        """Factors on mass, time and work: of a seed and a loading always the same.

        Args:
            pose: Dig location and heading.
            action: Parameters of the bucket-filling controller.
        """
        key = jax.random.key(self.seed)
        for value in (pose.x, pose.y, pose.heading, *jax.tree.leaves(action)):
            number = jnp.round(lax.stop_gradient(value) / _ALIKE).astype(jnp.int32)
            key = jax.random.fold_in(key, lax.bitcast_convert_type(number, jnp.uint32))
        drawn = jax.random.truncated_normal(key, -_FURTHEST, _FURTHEST, (3,), jnp.float32)
        mixed = jnp.linalg.cholesky(jnp.asarray(CORRELATION, jnp.float32)) @ drawn
        # Less half the variance: the mean stays what the world says.
        spread = jnp.asarray(self.deviation, jnp.float32)
        return jnp.exp(spread * mixed - 0.5 * spread**2)


@no_type_check
class ScatteredSolver(Scattered):
    """`Scattered` of a world that also says how its solves ended."""

    def solve(
        self, pile: Pile, pose: Pose, action: Action
    ) -> tuple[Pile, Performance, SolveReport]:
        """One loading as by calling it, and how the solve without scatter ended."""
        world: Any = self.world
        after, performance, report = world.solve(pile, pose, action)
        return *self._scattered(pile, pose, action, after, performance), report


def scattered(
    world: World, *, seed: int = 0, deviation: tuple[float, float, float] = DEVIATION
) -> Scattered:
    """A world with the scatter that two packings of grains have.

    The same seed, dig and action scatter alike, on whatever pile, so the world stays a pure
    function: it can be jitted, mapped and differentiated as the one without scatter.

    Args:
        world: Any world, for instance the simulator.
        seed: Of the scatter.
        deviation: Standard deviations of the logarithms of mass, time and work [1]; the default
            is that of discrete elements.
    """
    kind = ScatteredSolver if hasattr(world, "solve") else Scattered
    made: Scattered = kind(
        as_pytree(world), jnp.asarray(seed, jnp.int32), jnp.asarray(deviation, jnp.float32)
    )
    return made
