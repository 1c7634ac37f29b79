"""A planner that has a plan and searches on without end, for tests of what stops it."""

import time

import jax.numpy as jnp
import numpy as np

from wlplan.planning.job import Decisions, Job
from wlplan.planning.proposals import Progress, Proposals
from wlplan.planning.watch import watching


class Waits:
    """It says "searching" once it has its plan."""

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """Does not return."""
        del job, seed
        watch = watching(progress)
        row = np.linspace(0.1, 0.2, loads, dtype=np.float32)
        leaves = map(jnp.asarray, (row, 0.0 * row, np.zeros((loads, 4), np.float32)))
        watch.keep(Decisions(*leaves), 1.0)
        print("searching", flush=True)
        while True:
            time.sleep(0.01)
