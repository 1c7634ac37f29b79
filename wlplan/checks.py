"""What the public functions refuse, once and at the door: one `InputError` that says what to do.

Checks need values, so they look at arrays that are known and let traced ones pass: the same
functions stay pure under `jit`, `vmap` and `grad`.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import numpy as np

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.errors import InputError
from wlplan.types import Action, LoadingPlan, Pile, Pose

# Slack on the box of the actions, for numbers that went through float32.
_ROUNDING = 1e-6


def is_traced(*values: Any) -> bool:
    """Whether a leaf of some pytrees stands for values that are not known yet."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def check_world(world: Any) -> None:
    """Refuses what cannot be a world.

    Raises:
        InputError: If it is a name or not callable.
    """
    if isinstance(world, str):
        raise InputError(
            f"the world is the name {world!r}: load it first, with wlplan.load_world({world!r})."
        )
    if not callable(world):
        raise InputError(
            f"the world is of type {type(world).__name__}: give a function "
            f"world(pile, pose, action) -> (pile_after, performance), or wlplan.load_world(...)."
        )


def check_pile(pile: Any) -> None:
    """Refuses a pile that no one can load from.

    Raises:
        InputError: If it is no `Pile`, or one of its heights is NaN or infinite.
    """
    if not isinstance(pile, Pile):
        raise InputError(
            f"the pile is of type {type(pile).__name__}: make a wlplan.Pile of it, or read one "
            f"with wlplan.read_pile."
        )
    for name, field in (("height", pile.height), ("ground", pile.ground)):
        if field is None or is_traced(field):
            continue
        bad = int(np.count_nonzero(~np.isfinite(np.asarray(field))))
        if bad:
            raise InputError(
                f"`{name}` of the pile is NaN or infinite in {bad} cells: fill them, and mark "
                f"them as unseen in `valid`; wlplan.read_pile does both."
            )


def check_pose(pose: Pose) -> None:
    """Refuses poses that are not finite, or whose heading cannot be in radians.

    Raises:
        InputError: If so.
    """
    for name in ("x", "y", "heading"):
        values = getattr(pose, name)
        if is_traced(values):
            continue
        numbers = np.asarray(values, float)
        if not np.isfinite(numbers).all():
            raise InputError(f"`{name}` of a pose is NaN or infinite: give finite numbers.")
        if name == "heading" and np.abs(numbers).max(initial=0.0) > 2.0 * math.pi + _ROUNDING:
            largest = float(numbers.flat[np.abs(numbers).argmax()])
            raise InputError(
                f"a heading is {largest:g} rad, beyond one turn: give radians; if it is in "
                f"degrees, use math.radians."
            )


def check_action(action: Action) -> None:
    """Refuses actions outside their box.

    Raises:
        InputError: If a parameter is outside its range, or not finite.
    """
    names = ("delta_bm", "k_bm", "delta_bk", "k_bk")
    for name, low, high in zip(names, ACTION_LOW, ACTION_HIGH, strict=True):
        values = getattr(action, name)
        if is_traced(values):
            continue
        numbers = np.asarray(values, float)
        inside = (numbers >= low - _ROUNDING * high) & (numbers <= high + _ROUNDING * high)
        if not inside.all():
            worst = float(numbers[~inside].flat[0])
            raise InputError(f"{name} is {worst:g}, outside its range {low:g} to {high:g}.")


def check_plan(plan: Any) -> None:
    """Refuses a plan that cannot be played.

    Raises:
        InputError: If it is no `LoadingPlan`, its leaves do not have one axis of the same length
            each, or a pose or an action makes no sense.
    """
    if not isinstance(plan, LoadingPlan):
        raise InputError(
            f"the plan is of type {type(plan).__name__}: make a wlplan.LoadingPlan of poses and "
            f"actions, or read one with wlplan.read_plan."
        )
    shapes = {np.shape(leaf) for leaf in jax.tree.leaves(plan)}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        raise InputError(
            f"the leaves of the plan have shapes {sorted(shapes)}: each needs one axis, the "
            f"loadings, of the same length."
        )
    check_pose(plan.pose)
    check_action(plan.action)
