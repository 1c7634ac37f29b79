"""What planners and the rest of the package agree on."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from wlplan.planning.job import Decisions, Job
from wlplan.types import LoadingPlan

Progress = Callable[[str, int, int, float | None], None]
"""`progress(stage, done, total, cost)`, called as a planner advances."""


class NothingWorthIt(Exception):  # noqa: N818
    """No load that is left is worth making, which is no error."""


class Proposals(NamedTuple):
    """The plans that a planner hands over, for the world or a referee to pick from.

    A plan is of `Decisions`, which follow the toe of whatever pile they are played on, or a
    `LoadingPlan`, whose poses are fixed.
    """

    candidates: Decisions | LoadingPlan  # leaves [K, N], or [N] of a single plan
    # A plan like them, leaves [N], that may be picked too; what costs more in the planning world
    # is out. None: nothing is.
    limit: Decisions | LoadingPlan | None = None


@runtime_checkable
class Planner(Protocol):
    """A planner: a value whose fields are its settings. Any object with this method is one.

    One that has an attribute `plays_in_referee` that is true is given the referee too, as
    `job.referee`.
    """

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """Plans for the next loadings.

        Args:
            job: World, pile, site and objective, and the toe to dig along.
            loads: Number of loadings, N.
            seed: Of everything random.
            progress: Called as the planner advances.
        """
        ...
