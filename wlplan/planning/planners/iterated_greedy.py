"""The greedy plan, taken up again in the middle and made anew from there, as long as it helps."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import numpy as np

from wlplan.planning.job import Job
from wlplan.planning.planners.greedy import Greedy, Grown, cost_by_thorough_ways, plan_of
from wlplan.planning.population import Pool
from wlplan.planning.proposals import NothingWorthIt, Progress, Proposals
from wlplan.planning.watch import watching

_GREEDY = Greedy()


@dataclasses.dataclass(frozen=True)
class IteratedGreedy:
    """Undoes the last loads of the best plan and makes them again with other trials.

    Which poses greedy tries is chance, and what it takes for a hundredth less decides what it finds
    later. So it is worth more to make a plan again than to make its loads better. Iterated greedy
    (Ruiz and Stutzle 2007) keeps what was good: the loads before a point that is drawn, earlier
    ones as often as later ones.
    """

    plays_in_referee: ClassVar[bool] = True

    # How often loads are made again.
    rounds: int = 2
    # Greedy, and how many of its plans are made from nothing before that.
    greedy: Greedy = _GREEDY
    starts: int = 2
    # Of how many plans, the best so far, one is drawn whose loads are made again.
    parents: int = 3
    # How many plans are handed on; the best alone if the referee has played them already.
    candidates: int = 8

    @classmethod
    def by_trial(cls) -> IteratedGreedy:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(rounds=4, greedy=Greedy.by_trial(), starts=1)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The cheapest plans, the very best first, leaves [K, N]; as of `Planner.propose`.

        The first plan is that of greedy with the same seed.
        """
        watch = watching(progress)
        random = np.random.default_rng(seed)
        size = self.candidates if job.referee is None else 1
        pool = Pool(job, watch, size)
        best: list[tuple[float, list[Grown]]] = []
        total = self.starts + self.rounds
        for number in range(total):
            kept: list[Grown] = []
            if number >= self.starts:
                parent = best[random.integers(len(best))][1]
                kept = parent[: random.integers(len(parent))]
            try:
                made = self.greedy.grow(job, kept, loads, random, watch, says=not best)
            except NothingWorthIt:
                # With other trials there may be something.
                if best or number + 1 < self.starts:
                    continue
                raise
            # What greedy makes of the ways is too rough to choose by.
            watch.spend(way=len(made))
            cost = cost_by_thorough_ways(job, made, loads)
            cost = cost if math.isfinite(cost) else math.inf
            pool.add(plan_of(job, made, loads), cost)
            best = sorted([*best, (cost, made)], key=lambda pair: pair[0])[: self.parents]
            watch("iterated greedy", number + 1, total, pool.least)
        return Proposals(pool.cheapest())
