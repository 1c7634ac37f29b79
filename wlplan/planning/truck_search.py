"""Where the truck stands, left to the planner: the best spot by plans, refined with their digs."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from wlplan.errors import InputError
from wlplan.planning.amounts import Tonnes
from wlplan.planning.job import Decisions, Job, can_refine
from wlplan.planning.joint import at_receiver, refined
from wlplan.planning.placement import not_for_trucks, place_of, truck_stands_on
from wlplan.planning.planners.greedy import Greedy
from wlplan.planning.playing import PlanResult, outcomes
from wlplan.planning.spots import best_spots
from wlplan.planning.truck_area import stands_inside
from wlplan.planning.watch import Watch
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.worlds.capabilities import is_differentiable


class Found(NamedTuple):
    """A place of the truck, and the plan that speaks for it."""

    receiver: Receiver
    plan: Decisions | None  # refined with it, leaves [N]; None: nothing was refined


@dataclasses.dataclass(frozen=True)
class TruckSearch:
    """How the place of the truck is searched for.

    With the place that the job has and the few that `wlplan.planning.spots` finds, greedy plans,
    and the cheapest a tonne is taken. From there place and digs are refined together. That counts
    if it is cheaper in the planning world once the ways are searched anew.
    """

    # Whether every truck may stand elsewhere, on what is left of the pile when it comes.
    each: bool = False
    # Steps of the descent; 0: nothing is refined. In a world without a derivative nothing is.
    refine_steps: int = 16

    def place(self, job: Job, site: Site, rows: int, *, seed: int, watch: Watch) -> Found:
        """Where the truck stands best.

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
        closed, area, machine = site.keep_out, site.truck_area, job.site.machine
        spots = [
            job.site.placed_receiver,
            *best_spots(job, seed=seed, watch=watch, closed=closed, area=area),
        ]
        best, plan, least = spots[0], None, math.inf
        for number, receiver in enumerate(spots):
            watch("truck", number, len(spots), None if number == 0 else least)
            at, quiet = at_receiver(job, receiver), Watch()
            candidates: Any = kind().propose(at, rows, seed=seed, progress=quiet).candidates
            watch.spend(loading=quiet.spent)
            per_tonne = _per_tonne(outcomes(at, candidates))
            if per_tonne < least:
                best, plan, least = receiver, candidates, per_tonne
        # A plan without a finite cost is for whoever plans next to complain about.
        if plan is None or not can_refine(job, self.refine_steps):
            return Found(best, None)
        if isinstance(job.amount, Tonnes):
            # Of a part of more, loads that are left out would cost nothing.
            job = job.replace(amount=job.amount.replace(price=least))
        at = at_receiver(job, best)
        blocked = not_for_trucks(job.pile, closed)
        begun, _ = truck_stands_on(place_of(best)[None], job.pile, blocked, machine)

        def may_stand(places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
            on, _ = truck_stands_on(places, job.pile, blocked, machine)
            room: np.ndarray = (on <= begun[0]) & stands_inside(places, area, machine)
            return room

        start: Decisions = jax.tree.map(lambda leaf: leaf[0], plan)
        found = refined(at, start, may_stand, steps=self.refine_steps, watch=watch)
        # The ways are searched anew: those that the descent kept may be others by now.
        row = jax.tree.map(lambda leaf: leaf[None], found.plan)
        costs = outcomes(at_receiver(job, found.receiver), row).cost, outcomes(at, plan).cost
        if not float(costs[0][0]) < float(costs[1][0]):
            return Found(best, None)
        return Found(found.receiver, found.plan)


def _per_tonne(result: PlanResult) -> float:
    """What a tonne of the only plan costs."""
    mass = np.asarray(result.rollout.performance.mass[0], np.float64)
    if result.plan.truck is not None:
        mass = np.where(np.asarray(result.plan.truck[0]) >= 0, mass, 0.0)
    return float(result.cost[0]) / max(float(mass.sum()), 1e-3)


def search_of(truck: str | TruckSearch | None) -> TruckSearch | None:
    """The search that is meant by a name; itself; or None, where the truck has its place.

    Raises:
        InputError: If the name is unknown, or the value is no search.
    """
    if truck is None or isinstance(truck, TruckSearch):
        return truck
    if truck not in TRUCKS:
        raise InputError(
            f"the truck is {truck!r}: give {' or '.join(map(repr, TRUCKS))}, or leave it out."
        )
    return TRUCKS[truck]


TRUCKS = {"auto": TruckSearch(), "each": TruckSearch(each=True)}
"""Searches by name."""
