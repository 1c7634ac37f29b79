"""What a planner tells as it advances: how far it is, what it has used up, the best plan so far.

So one place stops any planner, by a budget or by Ctrl-C, and nothing of what was found is lost.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from wlplan.planning.job import Decisions
from wlplan.planning.proposals import Progress
from wlplan.types import LoadingPlan

GRADIENT_COST = 4.0
"""Loadings that a loading with its gradient counts for: what it takes longer, measured by
`wlplan bench`."""


class BudgetSpent(Exception):  # noqa: N818
    """A planner has used up its budget, which is no error."""


class Best(NamedTuple):
    """The best plan so far."""

    plan: Decisions | LoadingPlan  # leaves [N]
    cost: float  # in the planning world


class Watch:
    """Watches a planner. It is a `Progress` too, so that any planner may be watched.

    Args:
        progress: Told how far it is.
        budget: Most loadings that may be evaluated, a gradient counted as `GRADIENT_COST`; a
            planner ends at the first report beyond it.

    Attributes:
        spent: Loadings evaluated so far.
        best: The best plan so far; None before there is one.
        stopped: What ended the search early: "", "budget" or "interrupted".
    """

    def __init__(self, progress: Progress | None = None, budget: int | None = None):
        self._progress, self._budget = progress, budget
        self.spent = 0.0
        self.best: Best | None = None
        self.stopped = ""

    def __call__(self, stage: str, done: int, total: int, cost: float | None) -> None:
        """How far a stage is, as `Progress`."""
        if self._progress is not None:
            self._progress(stage, done, total, cost)

    @contextlib.contextmanager
    def ending(self) -> Iterator[None]:
        """A block that a budget or Ctrl-C ends early, which is then in `stopped`."""
        try:
            yield
        except BudgetSpent:
            self.stopped = "budget"
        except KeyboardInterrupt:
            self.stopped = "interrupted"

    def keep(self, plan: Decisions | LoadingPlan, cost: float) -> None:
        """Remembers a plan if it is better than those before.

        Args:
            plan: Leaves [N]; of a plan that grows load by load, what there is of it.
            cost: Of the plan in the planning world; of one that grows, minus infinity.
        """
        if np.isnan(cost) or (self.best is not None and cost >= self.best.cost > -np.inf):
            return
        self.best = Best(plan, cost)

    def spend(self, loadings: int, gradients: int = 0) -> None:
        """Counts loadings that were evaluated, and those of them whose gradient was taken too.

        Raises:
            BudgetSpent: If that is more than the budget.
        """
        self.spent += loadings - gradients + GRADIENT_COST * gradients
        if self._budget is not None and self.spent > self._budget:
            raise BudgetSpent


def watching(progress: Progress | None) -> Watch:
    """The watch that is meant by a progress: itself, if it is one."""
    return progress if isinstance(progress, Watch) else Watch(progress)
