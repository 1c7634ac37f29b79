"""The gradient of a plan's cost against central differences, component by component, in float64."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.errors import InputError
from wlplan.planning.job import Job, check_has_gradient
from wlplan.planning.playing import outcomes, play_candidate
from wlplan.terrain.toe import ToeContour, check_accessible, toe_contour
from wlplan.types import LoadingPlan, Pile, Pose, action_from, action_vector
from wlplan.worlds.capabilities import with_derivatives

COMPONENTS = ("x", "y", "heading", "delta_bm", "k_bm", "delta_bk", "k_bk")
"""Components of one loading: those of its pose, then those of its action."""

STEP = 1e-6
"""Step of the differences, in m, rad or the unit of the action parameter."""
TOLERANCE = 1e-4
"""Relative error above which a component counts as wrong."""
SIMULATOR_TOLERANCE = 3e-3
"""The same in the simulator: what its earthmoving force, whose derivative is approximate, keeps."""

# Components smaller than this part of the largest are compared with that instead.
_SMALLEST_PART = 1e-3
# Neighbouring digs of a random plan lie this many points of the toe apart, 1.1 m: less than half a
# bucket width, so each feels what the ones before did.
_POINTS_APART = 11
# Deviation of its headings from the inward normal [rad], and the part of the box its actions fill.
_HEADING_SPREAD, _ACTION_PART = 0.1, (0.3, 0.7)

Verdict = Literal["ok", "kink", "wrong"]


@dataclasses.dataclass(frozen=True)
class Component:
    """One component of the gradient, in cost per m, per rad or per unit of the parameter."""

    load: int  # from 1
    component: str  # one of `COMPONENTS`
    reverse: float  # by reverse mode
    central: float  # by central differences
    relative_error: float  # of the two; infinite where one of them is not finite
    step: float  # of the difference that decided
    verdict: Verdict


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """The comparison of a whole plan."""

    cost: float  # of the plan
    step: float
    tolerance: float
    components: tuple[Component, ...]  # load by load, in the order of `COMPONENTS`

    def with_verdict(self, verdict: Verdict) -> list[Component]:
        """The components with that verdict."""
        return [component for component in self.components if component.verdict == verdict]

    @property
    def kink_fraction(self) -> float:
        """Part of the components that are at kinks."""
        return len(self.with_verdict("kink")) / len(self.components)

    @property
    def largest_error(self) -> float:
        """Largest relative error of the components that are not at kinks; NaN if all are."""
        return max(self._errors, default=math.nan)

    @property
    def median_error(self) -> float:
        """Median relative error of the components that are not at kinks; NaN if all are."""
        return float(np.median(self._errors)) if self._errors else math.nan

    @property
    def _errors(self) -> list[float]:
        return [c.relative_error for c in self.components if c.verdict != "kink"]

    def as_dict(self) -> dict[str, Any]:
        """Settings, summary and rows for JSON; None stands for numbers that are not finite."""
        rows = [dataclasses.asdict(component) for component in self.components]
        return {
            "cost": self.cost,
            "step": self.step,
            "tolerance": self.tolerance,
            "components": len(self.components),
            "kinks": len(self.with_verdict("kink")),
            "kink_fraction": self.kink_fraction,
            "wrong": len(self.with_verdict("wrong")),
            "largest_relative_error": _finite(self.largest_error),
            "median_relative_error": _finite(self.median_error),
            "rows": [{name: _finite(value) for name, value in row.items()} for row in rows],
        }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def random_plan(
    pile: Pile, loads: int, *, seed: int, contour: ToeContour | None = None
) -> LoadingPlan:
    """A plan to check: neighbouring digs along the toe, actions in the middle of their box.

    Args:
        pile: The pile before the first loading.
        loads: Number of loadings.
        seed: Of the first dig location, the headings and the actions.
        contour: Toe of the pile where it is known already.

    Raises:
        InputError: If no load is asked for, there is nothing to dig, or a bucket can start nowhere.
    """
    if loads < 1:
        raise InputError(f"{loads} loads were asked for: ask for at least 1.")
    contour = toe_contour(pile) if contour is None else contour
    check_accessible(contour.accessible)
    accessible = np.flatnonzero(contour.accessible)
    rng = np.random.default_rng(seed)
    first = rng.integers(accessible.size)
    spots = accessible[(first + _POINTS_APART * np.arange(loads)) % accessible.size]
    heading = contour.heading[spots] + _HEADING_SPREAD * rng.normal(size=loads)
    low, high = np.asarray(ACTION_LOW), np.asarray(ACTION_HIGH)
    action = low + (high - low) * rng.uniform(*_ACTION_PART, (loads, 4))
    return plan_from(np.concatenate([contour.points[spots], heading[:, None], action], axis=1))


def as_table(plan: LoadingPlan) -> Float[Array, "*n 7"]:
    """The components of a plan, or of its gradient, along a last axis."""
    pose = jnp.stack([plan.pose.x, plan.pose.y, plan.pose.heading], axis=-1)
    return jnp.concatenate([pose, action_vector(plan.action)], axis=-1)


def plan_from(table: Float[np.ndarray, "*n 7"]) -> LoadingPlan:
    """The inverse of `as_table`, in the precision that JAX has at the time."""
    columns = jnp.asarray(table, float)
    return LoadingPlan(Pose(*(columns[..., k] for k in range(3))), action_from(columns[..., 3:]))


def cost_and_gradient(job: Job, plan: LoadingPlan) -> tuple[Float[Array, ""], LoadingPlan]:
    """Cost of a plan with its poses as they are, and its gradient, a pytree like the plan."""
    return jax.value_and_grad(lambda plan: play_candidate(job, plan, report=False).cost)(plan)


_cost_and_gradient = jax.jit(cost_and_gradient)


def check_gradient(
    job: Job,
    plan: LoadingPlan,
    *,
    step: float = STEP,
    tolerance: float = TOLERANCE,
    progress: Callable[[int, int], None] | None = None,
) -> GradientCheck:
    """Compares the reverse-mode gradient of a plan's cost with central differences, in float64.

    A component is wrong if it is off by more than the tolerance, also with differences ten times
    as wide and ten times as narrow, and no kink explains it. It is at a kink if the two one-sided
    differences disagree by more than half of the error, and not just because the cost is curved.

    Args:
        job: World, pile, site and objective. A world that has several forms is taken in the one
            that has derivatives.
        plan: N loadings.
        step: Of the differences, in m, rad or the unit of the action parameter.
        tolerance: Largest error, relative to the larger of the two values or to a thousandth of
            the largest component.
        progress: Called with the number of comparisons made, and of all to be made so far.

    Raises:
        InputError: If step or tolerance are not positive, the world has no derivative, or the cost
            is not finite.
    """
    for name, value in (("step", step), ("tolerance", tolerance)):
        if not 0.0 < value < math.inf:
            raise InputError(f"the {name} is {value:g}: it has to be positive.")
    with jax.enable_x64(True):
        job = jax.tree.map(_widened, job.replace(world=with_derivatives(job.world)))
        check_has_gradient(job, "check another world")
        plan = jax.tree.map(_widened, plan)
        if progress is not None:
            progress(0, as_table(plan).size)
        cost, gradient = _cost_and_gradient(job, plan)
        if not math.isfinite(cost):
            raise InputError("the cost of the plan is not finite: check the pile for spikes.")
        compare = _Comparison(job, plan, gradient, progress)
        here = compare(range(compare.size), step)
        doubtful = [k for k, compared in here.items() if compared.error > tolerance]
        finer, coarser = compare(doubtful, step / _RATIO), compare(doubtful, step * _RATIO)
    components = []
    for k, decisive in here.items():
        verdict: Verdict = "ok"
        if k in finer:
            verdict, decisive = _decide(decisive, finer[k], coarser[k], tolerance)
        components.append(
            Component(
                load=k // len(COMPONENTS) + 1,
                component=COMPONENTS[k % len(COMPONENTS)],
                reverse=float(compare.reverse[k]),
                central=decisive.central,
                relative_error=decisive.error,
                step=decisive.step,
                verdict=verdict,
            )
        )
    return GradientCheck(float(cost), step, tolerance, tuple(components))


def _widened(leaf: Any) -> Any:
    array = np.asarray(leaf)
    return jnp.asarray(array, jnp.float64) if array.dtype.kind == "f" else leaf


class _Compared(NamedTuple):
    """A component beside its differences at one step."""

    step: float
    central: float
    error: float  # relative
    bend: float  # forward less backward difference, relative

    @property
    def bends(self) -> bool:
        return abs(self.bend) > 0.5 * self.error


# How much finer and coarser the steps are that a doubtful component is looked at with again.
_RATIO = 10.0


def _decide(
    here: _Compared, finer: _Compared, coarser: _Compared, tolerance: float
) -> tuple[Verdict, _Compared]:
    """What to make of a component that is off at the step asked for, and by which difference."""
    # A kink would show in the wider difference even more: what it hides is rounding.
    if coarser.error <= tolerance:
        return "ok", coarser
    # Curvature bends too, but in proportion to the step.
    in_proportion = abs(here.bend - _RATIO * finer.bend) < 0.5 * here.error
    if finer.error <= tolerance:
        return ("kink", here) if here.bends and not in_proportion else ("ok", finer)
    # The error that a single kink makes shrinks with the part of the difference beyond it.
    curved = in_proportion and finer.error > 0.5 * here.error
    return ("kink" if here.bends and finer.bends and not curved else "wrong"), here


class _Comparison:
    """Compares components of a gradient with differences of the cost; to be used in float64."""

    def __init__(
        self,
        job: Job,
        plan: LoadingPlan,
        gradient: LoadingPlan,
        progress: Callable[[int, int], None] | None,
    ):
        self._job, self._table, self._progress = job, np.asarray(as_table(plan)), progress
        self._costs = self._costs_of(self._table[None])
        self.reverse = np.asarray(as_table(gradient)).ravel()
        self.size = self.reverse.size
        largest = np.abs(self.reverse[np.isfinite(self.reverse)]).max(initial=0.0)
        self._least_scale = _SMALLEST_PART * float(largest)
        self._done = self._total = 0

    def __call__(self, components: Sequence[int], step: float) -> dict[int, _Compared]:
        """The components by their place in the table, load by load."""
        self._total += len(components)
        compared = {}
        for first in range(0, len(components), len(COMPONENTS)):
            batch = components[first : first + len(COMPONENTS)]
            shifts = np.zeros((2 * len(batch), self.size))
            for n, k in enumerate(batch):
                shifts[2 * n : 2 * n + 2, k] = step, -step
            costs = self._costs_of(self._table + shifts.reshape(-1, *self._table.shape))
            # Load by load before the sum: what does not change does not round either.
            changes = (costs - self._costs).sum(axis=1).reshape(-1, 2) / step
            for k, (ahead, behind) in zip(batch, changes.tolist(), strict=True):
                compared[k] = self._compared(k, step, ahead, -behind)
            self._done += len(batch)
            if self._progress is not None:
                self._progress(self._done, self._total)
        return compared

    def _compared(self, k: int, step: float, forward: float, backward: float) -> _Compared:
        reverse, central = float(self.reverse[k]), 0.5 * (forward + backward)
        scale = max(abs(reverse), abs(central), self._least_scale)
        if scale == 0.0:
            return _Compared(step, central, 0.0, 0.0)
        error, bend = abs(central - reverse) / scale, (forward - backward) / scale
        return _Compared(step, central, error if math.isfinite(error) else math.inf, bend)

    def _costs_of(self, tables: Float[np.ndarray, "k n 7"]) -> Float[np.ndarray, "k n"]:
        return np.asarray(outcomes(self._job, plan_from(tables)).costs)
