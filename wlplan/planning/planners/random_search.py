"""Plans at random: what any other planner has to beat with as many trials."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from wlplan.actions import spread_actions
from wlplan.planning.job import Decisions, Job
from wlplan.planning.population import Pool
from wlplan.planning.proposals import Progress, Proposals
from wlplan.planning.watch import watching


@dataclasses.dataclass(frozen=True)
class RandomSearch:
    """Plays plans that are drawn at random, and hands over the cheapest.

    Positions are even along the toe, headings even in their range, actions a Latin hypercube of
    their box, all loads independent. It knows nothing of trucks: they are filled as loads come.
    """

    # Plans that are played, in whole batches, and how many side by side.
    plans: int = 512
    batch: int = 16
    # How many plans are handed on.
    candidates: int = 16

    @classmethod
    def by_trial(cls) -> RandomSearch:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(plans=96)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The cheapest plans, leaves [K, N]; arguments as of `Planner.propose`."""
        watch = watching(progress)
        random = np.random.default_rng(seed)
        pool = Pool(job, watch, self.candidates)
        batches = -(-self.plans // self.batch)
        for number in range(batches):
            pool.play(self._draw(job, loads, random))
            watch("random", number + 1, batches, pool.least)
        return Proposals(pool.cheapest())

    def _draw(self, job: Job, loads: int, random: np.random.Generator) -> Decisions:
        dtype, shape = job.pile.height.dtype, (self.batch, loads)
        actions = spread_actions(self.batch * loads, random, dtype)
        return Decisions(
            position=jnp.asarray(random.random(shape), dtype),
            # Squashing takes the hyperbolic tangent.
            offset=jnp.asarray(np.arctanh(random.uniform(-0.99, 0.99, shape)), dtype),
            action=actions.reshape(*shape, 4),
        )
