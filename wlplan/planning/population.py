"""Populations of whole plans: what planners share that judge plans by playing them."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wlplan.errors import InputError
from wlplan.planning.job import Decisions, Job, contour_length
from wlplan.planning.playing import outcomes
from wlplan.planning.proposals import Planner
from wlplan.planning.watch import Watch

PER_LOAD = 6
"""Variables of a load: position, offset and action."""


@dataclasses.dataclass(frozen=True)
class Spread:
    """How far plans are from the one that they are near: standard deviations."""

    position: float = 0.3  # along the toe [m]
    offset: float = 0.07  # of the heading, before squashing
    action: float = 0.15  # before squashing


class Near:
    """Plans near one, as numbers: how far each variable is from it, in units of the spread.

    Loads that the plan does not make have no variables; trucks stay as they are.

    Args:
        job: With its toe.
        plan: The plan that the others are near, leaves [N].
        spread: The units.

    Attributes:
        loads: Loads with variables, n.
    """

    def __init__(self, job: Job, plan: Decisions, spread: Spread):
        assert job.toe is not None
        made = np.ones(len(plan.position), bool) if plan.truck is None else plan.truck >= 0
        self._rows = np.flatnonzero(made)
        self._plan, self._dtype = plan, job.pile.height.dtype
        length = float(contour_length(job))
        self._units = np.array(
            [spread.position / length, spread.offset, *(spread.action,) * (PER_LOAD - 2)]
        )
        self._around = length / spread.position if bool(job.toe.closed) else math.inf
        self.loads = len(self._rows)

    def plans(self, numbers: Float[np.ndarray, "k n 6"]) -> Decisions:
        """The plans of some numbers, leaves [K, N]."""
        count = len(numbers)
        plans: Any = jax.tree.map(
            lambda leaf: np.repeat(np.asarray(leaf)[None], count, axis=0), self._plan
        )
        away = (numbers * self._units).astype(self._dtype)
        plans.position[:, self._rows] += away[..., 0]
        plans.offset[:, self._rows] += away[..., 1]
        plans.action[:, self._rows] += away[..., 2:]
        decisions: Decisions = jax.tree.map(jnp.asarray, plans)
        return decisions

    def shortest(self, steps: Float[np.ndarray, "*k n 6"]) -> Float[np.ndarray, "*k n 6"]:
        """Steps from numbers to others, the short way around a closed toe."""
        if math.isinf(self._around):
            return steps
        position = steps[..., :1]
        position = position - self._around * np.round(position / self._around)
        return np.concatenate([position, steps[..., 1:]], axis=-1)


class Pool:
    """Plays plans, and remembers the cheapest of all.

    Args:
        job: With its toe.
        watch: Told what it took, and the best plan.
        size: Plans that are remembered.
    """

    def __init__(self, job: Job, watch: Watch, size: int):
        self._job, self._watch, self._size = job, watch, size
        self._best: list[tuple[float, Decisions]] = []

    @property
    def least(self) -> float:
        """Cost of the cheapest plan so far; infinite before there is one."""
        return self._best[0][0] if self._best else math.inf

    def play(self, plans: Decisions) -> Float[np.ndarray, " k"]:
        """Costs of plans, leaves [K, N]; infinite where there is none."""
        self._watch.spend(loading=plans.position.size, way=plans.position.size)
        costs = np.asarray(outcomes(self._job, plans).cost, np.float64)
        costs = np.nan_to_num(costs, nan=np.inf, posinf=np.inf)
        for k in np.argsort(costs, kind="stable")[: self._size]:
            self.add(jax.tree.map(lambda leaf, k=k: leaf[k], plans), float(costs[k]))
        return costs

    def add(self, plan: Decisions, cost: float) -> None:
        """Remembers a plan, leaves [N], whose cost is known."""
        best = sorted([*self._best, (cost, plan)], key=lambda pair: pair[0])
        self._best = best[: self._size]
        self._watch.keep(self._best[0][1], self._best[0][0])

    def cheapest(self) -> Decisions:
        """The cheapest plans, the very best first, leaves [K, N].

        Always as many, repeats included: what plays them is compiled for it.
        """
        finite = [plan for cost, plan in self._best if math.isfinite(cost)]
        plans = finite or [plan for _, plan in self._best]
        rows = (plans[k % len(plans)] for k in range(self._size))
        together: Decisions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
        return together


def start_of(
    planner: Planner | None, job: Job, loads: int, spread: Spread, *, seed: int, watch: Watch
) -> tuple[Near, Decisions | None]:
    """Where a search begins, and the plan that none may cost more than.

    Args:
        planner: Whose plan it starts at; None: anywhere on the toe, and there is no such plan.
        job: With its toe.
        loads: Number of loadings, N.
        spread: The units near the planner's plan.
        seed: Of everything random.
        watch: Told what it took.

    Raises:
        InputError: If the planner plans fixed poses.
    """
    if planner is None:
        return Near(job, evenly_spread(job, loads), spread_of_all(job)), None
    plans = plans_to_start_at(planner, job, loads, seed=seed, watch=watch)
    plan: Decisions = jax.tree.map(lambda leaf: leaf[0], plans)
    return Near(job, plan, spread), plan


def plans_to_start_at(
    planner: Planner, job: Job, loads: int, *, seed: int, watch: Watch
) -> Decisions:
    """The plans that a planner hands over, leaves [K, N].

    Raises:
        InputError: If they are of fixed poses, near which there are no other decisions.
    """
    candidates = planner.propose(job, loads, seed=seed, progress=watch).candidates
    if not isinstance(candidates, Decisions):
        raise InputError(
            f"{planner!r} plans fixed poses: start at the plan of one that decides along the toe, "
            f"such as wlplan.planners.Greedy()."
        )
    one: Decisions = jax.tree.map(lambda leaf: leaf[None], candidates)
    return one if candidates.position.ndim == 1 else candidates


def evenly_spread(job: Job, loads: int) -> Decisions:
    """A load in the middle of each part of the toe, square to it, by the middle action."""
    dtype = job.pile.height.dtype
    return Decisions(
        position=(jnp.arange(loads, dtype=dtype) + 0.5) / loads,
        offset=jnp.zeros(loads, dtype),
        action=jnp.zeros((loads, 4), dtype),
    )


def spread_of_all(job: Job) -> Spread:
    """The spread of plans that may be anywhere: that of even distributions."""
    even = 1.0 / math.sqrt(12.0)
    # An action that is even in its box is logistic before squashing.
    return Spread(position=even * float(contour_length(job)), offset=0.6, action=1.8)
