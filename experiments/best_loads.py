"""What any order of loads could gain: plans beside the best single loads that they come across.

A bound, as far as single loads can be searched: a plan that is made of nothing but the best load
that any pile on the way of a greedy plan offers. No load takes anything away from the next.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import wlplan
from experiments._common.instances import SMOKE_JOB, Instance
from experiments._common.places import RESULTS, say
from experiments._common.results import main
from experiments.planner_benchmark import BEST, place_truck
from wlplan.io import write_bytes_atomic
from wlplan.planning.amounts import Outlook, Trucks
from wlplan.planning.job import Decisions, Job, Standing, beginning, make_job, with_toe
from wlplan.planning.load_search import LoadSearch
from wlplan.planning.playing import play_one
from wlplan.planning.search import Cusps
from wlplan.planning.stepping import next_load
from wlplan.planning.terms import CycleTime
from wlplan.planning.watch import Watch
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy

PILES = ("prism 0", "cone", "ridge", "bundled")
JOBS = (("15 loads", "fixed truck"), ("trucks", "fixed truck"), ("trucks", "free truck"))
SEARCH = LoadSearch(
    poses_per_metre=3.0,
    offsets=(-0.8, -0.4, 0.0, 0.4, 0.8),
    actions=64,
    neighbours=1,
    refined=16,
    refine_steps=40,
)
"""Five times as many looks as greedy has, a way for each pose, and twice as many refined."""
# Worth of a tonne, in what it takes at least: what is refined is quick, full, or both.
PRICES = (0.5, 1.0, 1.5, 2.0)
# A metre that touches something counts as in the objectives that ship.
_TIME = {"time": 1.0, "touching": 2.0}
_TOLERANCE = 0.05  # of a payload
_MOST_BUCKETS = 12

Loads = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
"""Costs and masses [tonne] of loads."""


def run(preset: str) -> dict[str, Any]:
    """Searches the best loads on each pile of a greedy plan, in the hybrid world."""
    smoke = preset == "smoke"
    jobs = ((SMOKE_JOB, "fixed truck"),) if smoke else JOBS
    search = LoadSearch(actions=6, refine_steps=2, poses_per_metre=0.3) if smoke else SEARCH
    known = json.loads((RESULTS / BEST).read_text())
    rows = []
    for pile in PILES[:1] if smoke else PILES:
        for job, site in jobs:
            rows.append(_row(Instance(pile, job, site), search, known))
            say(json.dumps(rows[-1]))
    return {"rows": rows}


def _row(instance: Instance, search: LoadSearch, known: Sequence[dict[str, Any]]) -> dict[str, Any]:
    pile, world = instance.load_pile(), wlplan.load_world("hybrid")
    site = instance.site_of(pile)
    receiver = place_truck(instance, 0, Path("out") / "places")
    site = site if receiver is None else site.replace(receiver=receiver)
    amount = instance.amount
    plan = wlplan.plan_loads(world, pile, amount=amount, site=site, planner="greedy")
    by_time = isinstance(amount, Trucks)
    # Of a number of loads the cost of each is asked for; of trucks the time, and the mass too.
    job = with_toe(
        make_job(
            world,
            pile,
            site=site,
            objective=_TIME if by_time else amount.objective,
            amount=wlplan.Tonnes(1e3) if by_time else amount,
        )
    )
    found = _best_of_each(job, plan.plan, search, PRICES if by_time else ())
    best = next(
        (
            one["simulator"]
            for one in known
            if (one["pile"], one["job"], one["site"])
            == (instance.pile, instance.job, instance.site)
        ),
        None,
    )
    row = {"pile": instance.pile, "job": instance.job, "site": instance.site}
    if not isinstance(amount, Trucks):
        least = len(plan.costs) * min(float(costs.min()) for costs, _ in found)
        first = len(plan.costs) * float(found[0][0].min())
        of_best = None if best is None else best["cost"]
        return row | {
            "greedy": float(plan.cost),
            "best_known": of_best,
            "first_pile": first,
            "bound": least,
        }
    waits = float(plan.transport.wait.sum())
    every = tuple(np.concatenate(parts) for parts in zip(*found, strict=True))
    seconds = plan.rollout.performance.time + plan.transport.time + plan.transport.wait
    mass = plan.rollout.performance.mass
    return row | {
        "greedy": float(seconds.sum() / mass.sum()),
        "best_known": None if best is None else best["time"] / best["mass"],
        "first_pile": _a_tonne(found[0], amount, waits),
        "bound": _a_tonne((every[0], every[1]), amount, waits),
    }


def _best_of_each(
    job: Job, plan: wlplan.LoadingPlan, search: LoadSearch, prices: Sequence[float]
) -> list[Loads]:
    """Loads on the pile before each load of a plan: all that were tried, and the best refined."""
    standing, random, watch = beginning(job), np.random.default_rng(0), Watch()
    found = []
    for number in range(len(plan.pose.x)):
        tried = search.attempt(job, standing, random, watch)
        costs, masses = [tried.costs.ravel()], [tried.masses.ravel()]
        a_tonne = float(np.min(costs[0] / np.maximum(masses[0], 1e-3)))
        for price in prices or (0.0,):
            outlook = _priced(price * a_tonne)
            best = search.best(job, standing, tried, outlook, watch)
            cost, mass = _of_refined(job, standing, best.decisions, best.cusps)
            costs.append(np.asarray(cost))
            masses.append(np.asarray(mass))
        one = np.concatenate(costs), np.concatenate(masses)
        finite = np.isfinite(one[0])
        found.append((one[0][finite], one[1][finite]))
        load = jax.tree.map(lambda leaf, number=number: np.asarray(leaf)[number], plan)
        _, played = play_one(job, standing, load.replace(truck=None))
        standing = standing.replace(pile=played.pile)
    return found


def _priced(price: float) -> Outlook:
    """An outlook in which only the worth of a tonne counts."""
    return Outlook(*(jnp.asarray(v, jnp.float32) for v in (1.0, 1.0, 1.0, 1.0, 0.0, price)))


@jax.jit
def _of_refined(
    job: Job, standing: Standing, decisions: Decisions, cusps: Cusps
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    def one(decision: Decisions, cusp: Cusps) -> tuple[Array, Array]:
        load = next_load(job, standing, decision, cusp)
        return load.cost, load.performance.mass

    costs, masses = jax.vmap(one)(decisions, cusps)
    return costs, masses


def _a_tonne(loads: Loads, amount: Trucks, waits: float) -> float:
    """Least seconds a tonne of trucks that are filled with some of the loads, each any number.

    For each number of buckets the dual of filling the payload at the least time: the best price of
    a tonne. What is loaded beyond the payload may make a tonne cheaper, so each fill is tried.
    """
    seconds, mass = loads[0] * CycleTime().reference, loads[1]
    payload, count = float(amount.payload), int(amount.count)
    dear = float(np.min(seconds / np.maximum(mass, 1e-3)))
    prices = np.linspace(0.0, 20.0 * dear, 401)
    least = np.array([(seconds - price * mass).min() for price in prices])
    best = math.inf
    for fill in np.linspace(1.0 - _TOLERANCE, 1.0 + _TOLERANCE, 11) * payload:
        for buckets in range(1, _MOST_BUCKETS + 1):
            # No number of these loads holds so much.
            if buckets * mass.max() < fill:
                continue
            whole = float((buckets * least + prices * fill).max())
            best = min(best, (count * whole + waits) / (count * fill))
    return best


def draw(folder: Path) -> None:
    """Greedy, the best plan known, and the bound, of each pile and job."""
    rows = json.loads((folder / "best_loads.json").read_text())["rows"]
    figure = new_figure(7.0, 0.28 * len(rows) + 1.3)
    panel = figure.subplots()
    places = np.arange(len(rows))
    for name, label, colour, mark in (
        ("best_known", "best plan known, in the simulator", ORANGE, "o"),
        ("first_pile", "nothing but the best load of the whole pile", BLUE, "d"),
        ("bound", "nothing but the best load of any pile on the way", GREEN, "s"),
    ):
        shown = [(k, row) for k, row in enumerate(rows) if row[name] is not None]
        less = [100.0 * (1.0 - row[name] / row["greedy"]) for _, row in shown]
        panel.plot(less, [k for k, _ in shown], mark, color=colour, ms=5, label=label)
    panel.axvline(0.0, color=FAINT, lw=0.8)
    labels = [f"{row['pile']}, {row['job']}, {row['site']}" for row in rows]
    panel.set_yticks(places, labels, fontsize=8)
    panel.invert_yaxis()
    panel.set_xlabel("less than the greedy plan, as foreseen [%]", fontsize=8)
    figure.legend(loc="outside lower center", ncols=1, fontsize=8, frameon=False)
    tidy(panel)
    write_bytes_atomic(folder / "best_loads.png", png_bytes(figure))


if __name__ == "__main__":
    main("best_loads", run, draw)
