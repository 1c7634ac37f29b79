"""The fullest next loading, again and again: the follow-up's maximum loading strategy."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.planning.job import Job
from wlplan.planning.loading import Loading
from wlplan.planning.objective import Objective
from wlplan.planning.planners.greedy import Greedy
from wlplan.planning.proposals import Progress, Proposals

# What the objective counts beside the mass: enough to tell loads of one mass apart.
_TIES = 1e-3


@dataclasses.dataclass(frozen=True)
class MaxLoad(Greedy):
    """Always takes the load that yields most mass, whatever time and work it takes.

    The follow-up (arXiv 2501.06583) compares with it. Here it is the greedy planner with another
    objective: M0/M, weighted as the named objectives have it, and of the job's own objective only
    what must not be, `touching` and constraints, so that it does not dig where it cannot drive.
    Loads of one mass are told apart by their cost.

    A truck is filled with as few buckets as it takes, the fullest there are, and the last ones fit
    the payload: of amounts in tonnes the rest is judged as the greedy planner does it.
    """

    stage: ClassVar[str] = "max load"

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """One plan, leaves [1, N]; arguments as of `Planner.propose`."""
        heavy = Objective(
            {
                "mass": 2.0,
                "forbidden": _Forbidden(job.objective),
                "ties": (_TIES, job.objective),
            }
        )
        return super().propose(job.replace(objective=heavy), loads, seed=seed, progress=progress)


@dataclasses.dataclass(frozen=True)
class _Forbidden:
    """What an objective charges for what must not be."""

    objective: Objective

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        values = self.objective.values(loading)
        names = {"touching", *self.objective.constraints}
        return self.objective.cost(
            {
                name: value if name in names else jnp.zeros_like(value)
                for name, value in values.items()
            }
        )
