"""CMA-ES over all loadings at once, by the library pycma."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from wlplan.planning.job import Job
from wlplan.planning.planners.greedy import Greedy
from wlplan.planning.population import PER_LOAD, Pool, Spread, start_of
from wlplan.planning.proposals import Planner, Progress, Proposals
from wlplan.planning.watch import watching

_GREEDY = Greedy()
# Shorter than the others': it takes hundreds of plans to shorten its steps.
_SPREAD = Spread(position=0.2, offset=0.05, action=0.1)
# What a plan without a finite cost counts: pycma ranks numbers only.
_WORST = 1e12


@dataclasses.dataclass(frozen=True)
class CmaEs:
    """Evolves a normal distribution of plans: mean, step length and covariance.

    pycma (Hansen, Akimoto and Baudis 2019, DOI 10.5281/zenodo.2559634) draws the plans and is told
    their costs. Trucks are those of the plan that it starts at.
    """

    plays_in_referee: ClassVar[bool] = True  # the plan that it starts at

    # Plans drawn in an iteration, and iterations.
    population: int = 16
    iterations: int = 32
    # Whether the covariance is held diagonal: that has less to learn, but no ties between loads.
    diagonal: bool = False
    # Whose plan it starts at, and the first deviation there. None: anywhere on the toe.
    start: Planner | None = _GREEDY
    spread: Spread = _SPREAD
    # How many plans are handed on.
    candidates: int = 16

    @classmethod
    def by_trial(cls) -> CmaEs:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(population=12, iterations=8, start=Greedy.by_trial())

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The cheapest plans, leaves [K, N]; arguments as of `Planner.propose`.

        The limit is the plan that it starts at, if another planner made that.

        Raises:
            InputError: If that planner plans fixed poses.
        """
        # Its import takes a second.
        import cma

        watch = watching(progress)
        near, limit = start_of(self.start, job, loads, self.spread, seed=seed, watch=watch)
        job = job.replace(referee=None)
        pool = Pool(job, watch, self.candidates)
        random = np.random.default_rng([seed, 1])
        strategy = cma.CMAEvolutionStrategy(
            np.zeros(near.loads * PER_LOAD),
            1.0,
            {
                "popsize": self.population,
                "CMA_diagonal": self.diagonal,
                # Random numbers of its own, and nothing printed or written.
                "seed": np.nan,
                "randn": lambda *shape: random.standard_normal(shape),
                "verbose": -9,
                "verb_log": 0,
                "verb_disp": 0,
            },
        )
        for number in range(self.iterations):
            drawn = strategy.ask()
            # The mean is better than most of them: with it they are played, and not told of it.
            numbers = np.reshape([strategy.mean, *drawn], (-1, near.loads, PER_LOAD))
            costs = pool.play(near.plans(numbers))[1:]
            strategy.tell(drawn, np.minimum(costs, _WORST).tolist())
            watch("cma-es", number + 1, self.iterations, pool.least)
        return Proposals(pool.cheapest(), limit=limit)
