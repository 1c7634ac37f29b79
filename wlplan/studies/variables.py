"""What studies vary: loadings, moved by steps as long as a planner's.

A step is what a planner moves a component by, and about as much of each: 0.2 m, 3 degrees, a tenth
of the range of a parameter. So a gradient per step says what a planner gains, and the angle between
two such gradients does not hang on units. A study takes any function of an array, a single
number or several; the functions of this module are those of loadings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.errors import InputError
from wlplan.planning.job import Job
from wlplan.planning.playing import play_candidate
from wlplan.planning.search import Cusps
from wlplan.terrain.heightmap import to_world
from wlplan.types import Action, LoadingPlan, Pile, Pose, World, action_from, action_vector
from wlplan.worlds.capabilities import foresee, with_derivatives

COMPONENTS = ("ahead", "aside", "turn", "delta_bm", "k_bm", "delta_bk", "k_bk")
"""Components of a loading: along the heading, to its left, its turn to the left, the action."""

STEPS = (
    *(0.2, 0.2, math.radians(3.0)),
    *(0.1 * (high - low) for low, high in zip(ACTION_LOW, ACTION_HIGH, strict=True)),
)
"""Length of a step of each component [m, m, rad, then of the action]."""

Function = Callable[[Array], Array]
"""`function(variables) -> values`, an array each. One of which something has to be computed by
reverse mode may have another form for that: `function.with_derivatives()`."""


def direction(name: str, *, load: int = 1, loads: int | None = None) -> Float[np.ndarray, "*n 7"]:
    """One step of one component.

    Args:
        name: One of `COMPONENTS`.
        load: Of a plan, which of its loads, from 1.
        loads: How many loads the plan has; None: it is a single loading, without an axis of loads.

    Raises:
        InputError: If there is no such component or load.
    """
    if name not in COMPONENTS:
        raise InputError(f"there is no component {name!r}: name one of {', '.join(COMPONENTS)}.")
    one: np.ndarray = np.eye(len(COMPONENTS))[COMPONENTS.index(name)]
    if loads is None:
        return one
    if not 1 <= load <= loads:
        raise InputError(f"there is no load {load} of {loads}: loads are counted from 1.")
    rows: np.ndarray = np.eye(loads)[load - 1][:, None] * one
    return rows


def moved(pose: Pose, action: Action, steps: Float[Array, "*n 7"]) -> tuple[Pose, Action]:
    """A loading moved by some steps of each component; its action stays in its box.

    Args:
        pose: Dig location and heading; the frame of the steps is its own.
        action: Parameters of the controller.
        steps: How many steps of each of `COMPONENTS`.
    """
    by = steps * jnp.broadcast_to(jnp.asarray(STEPS, steps.dtype), steps.shape)
    x, y = to_world(pose, by[..., 0], by[..., 1])
    parameters = action_vector(action) + by[..., 3:]
    low, high = (
        jnp.broadcast_to(jnp.asarray(edge, steps.dtype), parameters.shape)
        for edge in (ACTION_LOW, ACTION_HIGH)
    )
    parameters = jnp.clip(parameters, low, high)
    return Pose(x, y, pose.heading + by[..., 2]), action_from(parameters)


@no_type_check
class LoadingYield(struct.PyTreeNode):
    """Mass [tonne], time [s] and work [kJ] of a loading over the steps that it is moved by, [7]."""

    world: World
    pile: Pile
    pose: Pose
    action: Action

    def __call__(self, steps: Float[Array, "7"]) -> Float[Array, "3"]:
        """What the world foresees of the loading so moved."""
        seen = foresee(self.world, self.pile, *moved(self.pose, self.action, steps))
        return jnp.stack([seen.mass, seen.time, seen.work])

    def with_derivatives(self) -> LoadingYield:
        """The same in the form of the world that passes reverse mode."""
        return self.replace(world=with_derivatives(self.world))


@no_type_check
class PlanCost(struct.PyTreeNode):
    """Cost of a plan over the steps that its N loads are moved by, [N, 7], as planners see it."""

    job: Job
    plan: LoadingPlan  # leaves (N,)
    # Of the best ways to the receiver, see `wlplan.planning.playing.cusps_of_plans`; None: they
    # are looked for each time, and the cost jumps where others are found.
    cusps: Cusps | None = None

    def __call__(self, steps: Float[Array, "n 7"]) -> Float[Array, ""]:
        """The cost of the plan so moved."""
        pose, action = moved(self.plan.pose, self.plan.action, steps)
        plan = self.plan.replace(pose=pose, action=action)
        return play_candidate(self.job, plan, cusps=self.cusps, report=False).cost

    def with_derivatives(self) -> PlanCost:
        """The same in the form of the world that passes reverse mode."""
        return self.replace(job=self.job.replace(world=with_derivatives(self.job.world)))


def as_function(function: Function) -> Any:
    """A function that can be passed to what is jitted: a plain one becomes a static part."""
    if any(callable(leaf) for leaf in jax.tree.leaves(function)):
        return jax.tree_util.Partial(function)
    return function


def values_at(function: Any, points: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Values at several points side by side, which is how a simulator is quickest."""
    values: Array = jax.vmap(function)(points)
    return values


def jacobians_at(function: Any, points: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Derivatives at several points.

    By reverse mode, one point after the other: side by side, a simulator whose cycles end at
    different times would compute all of its branches for all of them.
    """
    function = with_derivatives(function)
    if isinstance(function, Differenced):
        return jax.vmap(function.jacobian)(points)
    jacobians: Array = jax.lax.map(jax.jacrev(function), points)
    return jacobians


@no_type_check
class Differenced(struct.PyTreeNode):
    """A function whose derivatives are narrow central differences instead of reverse mode.

    For worlds without a derivative, and for those where two values a variable, side by side, cost
    less than reverse mode does: on a CPU, the simulator. Narrow differences need float64.
    """

    function: Function
    width: Float[Array, ""] | float = 1e-5  # half of that of a difference

    def __post_init__(self) -> None:
        object.__setattr__(self, "function", as_function(self.function))

    def __call__(self, variables: Float[Array, "*d"]) -> Float[Array, "*k"]:
        """The function itself."""
        return self.function(variables)

    def jacobian(self, variables: Float[Array, "*d"]) -> Float[Array, "..."]:
        """Its derivatives: the axes of the outcome, then those of the variables."""
        away = self.width * jnp.eye(variables.size, dtype=variables.dtype)
        away = away.reshape(-1, *variables.shape)
        ahead, behind = jnp.split(
            values_at(self.function, variables[None] + jnp.concatenate([away, -away])), 2
        )
        slopes = jnp.moveaxis((ahead - behind) / (2.0 * self.width), 0, -1)
        return slopes.reshape(*slopes.shape[:-1], *variables.shape)
