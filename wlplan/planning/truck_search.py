"""Where the truck stands, left to the planner: the best spot by plans made for it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from wlplan.planning.job import Job
from wlplan.planning.planners.greedy import Greedy
from wlplan.planning.playing import PlanResult, outcomes
from wlplan.planning.spots import at_receiver, best_spots
from wlplan.planning.watch import Watch
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.worlds.capabilities import is_differentiable

TRUCKS = ("auto", "each")
"""What is left to the planner: one place for all trucks, or one for each of them."""


def best_place(job: Job, site: Site, rows: int, *, seed: int, watch: Watch) -> Receiver:
    """Of the job's own place and the best few spots that with which greedy costs least a tonne.

    Args:
        job: With its toe and a receiver.
        site: What of it is closed, and where trucks may stand.
        rows: Of a plan.
        seed: Of everything random.
        watch: Told what it took.

    Raises:
        InputError: If there is no room in the area for trucks.
    """
    kind = Greedy.by_trial if is_differentiable(job.world) is False else Greedy
    best, least = job.site.placed_receiver, math.inf
    closed, area = site.keep_out, site.truck_area
    spots = [best, *best_spots(job, seed=seed, watch=watch, closed=closed, area=area)]
    for number, receiver in enumerate(spots):
        watch("truck", number, len(spots), None if number == 0 else least)
        at, quiet = at_receiver(job, receiver), Watch(stop=watch.stop)
        candidates: Any = kind().propose(at, rows, seed=seed, progress=quiet).candidates
        watch.spend(loading=quiet.spent)
        cost = _per_tonne(outcomes(at, candidates))
        if cost < least:
            best, least = receiver, cost
    return best


def _per_tonne(result: PlanResult) -> float:
    """What a tonne of the only plan costs."""
    mass = np.asarray(result.rollout.performance.mass[0], np.float64)
    if result.plan.truck is not None:
        mass = np.where(np.asarray(result.plan.truck[0]) >= 0, mass, 0.0)
    return float(result.cost[0]) / max(float(mass.sum()), 1e-3)
