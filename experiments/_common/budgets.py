"""Planners on equal terms: whatever they are, each spends the same."""

from __future__ import annotations

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np

from wlplan.planning.job import Decisions, Job, judged
from wlplan.planning.plan import choose
from wlplan.planning.playing import PlanResult, outcomes
from wlplan.planning.proposals import NothingWorthIt, Planner, Progress, Proposals
from wlplan.planning.watch import Watch
from wlplan.types import LoadingPlan, World

# Plans that a referee is shown.
_SHOWN = 16


class OverBudget(Exception):  # noqa: N818
    """The planner has no whole plan within the budget, which is no error."""


@dataclasses.dataclass
class Within:
    """A planner that plans again, with other seeds, until a budget is spent.

    Its plan is the cheapest of all in the world that it plans in. A search that the budget ends
    counts if it had a whole plan by then.
    """

    planner: Planner
    # In parts of what greedy takes for the same loads; None: once, whatever it takes.
    ratio: float | None
    # What a row of a plan takes greedy, once it is known.
    of_greedy: float | None = None
    # Who is shown the best few plans, and picks; None: nobody.
    referee: World | None = None
    # Whether the planner is given a referee, if it asks for one.
    in_referee: bool = False
    # Of all parts of a job: cost in the planning world, and what was spent.
    predicted: float = 0.0
    spent: float = 0.0
    rows: int = 0  # of plans, those that are not made included
    searches: int = 0
    # Of each part: what the referee picked, as it played it.
    picked: list[PlanResult] = dataclasses.field(default_factory=list)

    @property
    def plays_in_referee(self) -> bool:
        """Whether the planner is given the referee."""
        return self.in_referee and bool(getattr(self.planner, "plays_in_referee", False))

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The best plan, leaves [1, N]; arguments as of `Planner.propose`.

        Raises:
            OverBudget: If there is none.
        """
        del progress
        bare = job.replace(referee=None)
        budget = math.inf
        if self.ratio is not None:
            assert self.of_greedy is not None
            budget = self.ratio * self.of_greedy * loads
        found: list[tuple[float, Decisions | LoadingPlan]] = []
        left = budget
        for number in itertools.count():
            watch = Watch(budget=None if math.isinf(left) else max(1, math.ceil(left)))
            plans = None
            try:
                with watch.ending():
                    proposals = self.planner.propose(
                        job, loads, seed=seed + 1000 * number, progress=watch
                    )
                    plans = _stacked(proposals)
            except NothingWorthIt:
                if not found:
                    raise
                break
            if watch.stopped == "interrupted":
                raise KeyboardInterrupt
            if plans is None and watch.best is not None and watch.best.cost > -math.inf:
                plans = jax.tree.map(lambda leaf: leaf[None], watch.best.plan)
            if plans is not None:
                costs = np.asarray(outcomes(judged(job), plans).cost, float)
                found += [
                    (float(cost), jax.tree.map(lambda leaf, row=row: leaf[row], plans))
                    for row, cost in enumerate(costs)
                    if np.isfinite(cost)
                ]
            self.spent += watch.spent
            self.searches += 1
            left -= watch.spent
            if self.ratio is None or watch.stopped or left <= 0.02 * budget:
                break
        if not found:
            raise OverBudget
        found = sorted(found, key=lambda pair: pair[0])[:_SHOWN]
        self.predicted += found[0][0]
        self.rows += loads
        plans = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(plan for _, plan in found))
        if self.referee is not None:
            picked = choose(bare, Proposals(plans), referee=self.referee).refereed
            assert picked is not None
            self.picked.append(picked)
        return Proposals(jax.tree.map(lambda leaf: leaf[:1], plans))


def _stacked(proposals: Proposals) -> Decisions | LoadingPlan:
    """Candidates with a leading axis."""
    candidates: Decisions | LoadingPlan = proposals.candidates
    if np.ndim(jax.tree.leaves(candidates)[0]) == 1:
        candidates = jax.tree.map(lambda leaf: leaf[None], candidates)
    return candidates
