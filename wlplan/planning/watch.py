"""What a planner tells as it advances: how far it is, what it has used up, the best plan so far.

So one place stops any planner, by a budget or by Ctrl-C, and nothing of what was found is lost.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from wlplan.planning.job import Decisions
from wlplan.planning.proposals import Progress
from wlplan.types import LoadingPlan

EFFORTS = {
    "loading": 1.0,
    "gradient": 4.0,
    "look": 1.0 / 150.0,
    "look_gradient": 0.25,
    "way": 0.7,
    "quick_way": 0.3,
}
"""What evaluations count, in loadings whose pile is predicted too: such a loading; the same and its
gradient; one whose pile is not, roughly foreseen at a pose where others are looked at as well; such
a one alone and its gradient; the search of a way, and that of one that need not be the best. By the
time they take, which `python -m experiments.efforts` measures."""


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
        budget: Most that may be spent; a planner ends at the first report beyond it.
        stop: Asked at each report; once it says so a planner ends, as by Ctrl-C.

    Attributes:
        spent: Evaluations so far, in loadings, see `EFFORTS`.
        best: The best plan so far; None before there is one.
        stopped: What ended the search early: "", "budget" or "interrupted".
    """

    def __init__(
        self,
        progress: Progress | None = None,
        budget: int | None = None,
        stop: Callable[[], bool] | None = None,
    ):
        self._progress, self._budget, self.stop = progress, budget, stop
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
        """Remembers a plan if it is better than those before; one that grows only before others.

        Args:
            plan: Leaves [N]; of a plan that grows load by load, what there is of it.
            cost: Of the plan in the planning world; of one that grows, minus infinity.
        """
        before = -np.inf if self.best is None else self.best.cost
        if np.isnan(cost) or (before > -np.inf and not -np.inf < cost < before):
            return
        self.best = Best(plan, cost)

    def spend(self, **evaluations: float | int) -> None:
        """Counts evaluations, by the names of `EFFORTS`.

        Raises:
            BudgetSpent: If that is more than the budget.
            KeyboardInterrupt: If it is to stop.
        """
        if self.stop is not None and self.stop():
            raise KeyboardInterrupt
        self.spent += sum(EFFORTS[kind] * count for kind, count in evaluations.items())
        if self._budget is not None and self.spent > self._budget:
            raise BudgetSpent


def watching(progress: Progress | None) -> Watch:
    """The watch that is meant by a progress: itself, if it is one."""
    return progress if isinstance(progress, Watch) else Watch(progress)
