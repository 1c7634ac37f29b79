"""The cheapest next loading, again and again: meant to be hard to beat."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import jax
import numpy as np

from wlplan.planning.amounts import Loads, Outlook
from wlplan.planning.job import Decisions, Job, Standing, beginning, padded, stacked
from wlplan.planning.load_search import LoadSearch, Memory, Tried
from wlplan.planning.proposals import NothingWorthIt, Progress, Proposals
from wlplan.planning.stepping import advance
from wlplan.planning.watch import Watch, watching


@dataclasses.dataclass(frozen=True)
class Greedy(LoadSearch):
    """Tries many poses and actions for the next loading and refines the best by gradient.

    What a loading leaves to do is judged by what loads are like now: buckets to fill the truck
    with, or tonnes. In a world without a derivative nothing is refined.
    """

    stage: ClassVar[str] = "greedy"  # as progress has it

    @classmethod
    def by_trial(cls) -> Greedy:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(poses_per_metre=1.0, actions=16, refine_steps=0)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """One plan, leaves [1, N]; arguments as of `Planner.propose`."""
        watch = watching(progress)
        random = np.random.default_rng(seed)
        standing, chosen, memory, cost = beginning(job), [], Memory(), 0.0
        for load in range(loads):
            tried, memory = self.look(job, standing, random, watch, memory)
            outlook = memory.outlook
            assert outlook is not None
            decision, score = self.choose(job, standing, tried, outlook, loads - load, watch)
            watch.spend(loading=1)
            after, truck, of_load = _advance(job, standing, decision, outlook, score)
            if not job.amount.is_worth(float(after.done.mass - standing.done.mass)):
                break
            standing = after
            chosen.append(decision.replace(truck=truck))
            cost += float(of_load)
            watch(self.stage, load + 1, loads, cost)
            watch.keep(padded(chosen, loads), -math.inf)
            if job.amount.is_done(standing.done):
                break
        if not chosen:
            raise NothingWorthIt
        watch.keep(padded(chosen, loads), cost + float(job.amount.rest(standing.done)))
        plan = stacked(chosen).replace(truck=None)
        if not isinstance(job.amount, Loads):
            plan = padded(chosen, loads)
        return Proposals(jax.tree.map(lambda leaf: leaf[None], plan))

    def choose(
        self,
        job: Job,
        standing: Standing,
        tried: Tried,
        outlook: Outlook,
        left: int,
        watch: Watch,
    ) -> tuple[Decisions, float]:
        """The next load, and its score as of `score_of_next`, to which later loads may not add.

        Args:
            job: With its toe.
            standing: Before the load.
            tried: Loads that could be made.
            outlook: What the loads after it will be like.
            left: Most loads that are to be made, this one included.
            watch: Told what it took.
        """
        del left
        found = self.best(job, standing, tried, outlook, watch)
        best = int(np.argmin(found.scores))
        decision: Decisions = jax.tree.map(lambda leaf: leaf[best], found.decisions)
        return decision, float(found.scores[best])


_advance = jax.jit(advance)
