"""What evaluations take, beside what planners count them for: `wlplan.planning.watch.EFFORTS`."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.parallel import ParallelMap
from wlplan.planning.amounts import Loads
from wlplan.planning.job import Job, beginning, make_job, with_toe
from wlplan.planning.load_search import quick_ways
from wlplan.planning.planners import Greedy
from wlplan.planning.playing import (
    costs_and_gradients,
    cusps_of_plans,
    outcomes,
    play_candidate,
)
from wlplan.planning.watch import EFFORTS, Watch
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, ORANGE, new_figure, tidy

LOADS, PLANS, REPEATS = 15, 16, 5


def run(preset: str) -> dict[str, Any]:
    """Processor time of each kind of evaluation, in the hybrid world on a cone."""
    smoke = preset == "smoke"
    loads, plans, repeats = (2, 2, 1) if smoke else (LOADS, PLANS, REPEATS)
    planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3) if smoke else Greedy()
    pile = wlplan.relax(wlplan.seed_pile("conical", slope=math.radians(30.0), seed=1))
    job = with_toe(make_job(wlplan.load_world("hybrid"), pile, amount=Loads(loads)))
    rows: list[dict[str, Any]] = []
    for kind, seconds in _times(job, planner, loads, plans, repeats).items():
        rows.append({"kind": kind, "milliseconds": 1e3 * seconds, "counted": EFFORTS[kind]})
    one = next(row["milliseconds"] for row in rows if row["kind"] == "loading")
    for row in rows:
        row["measured"] = row["milliseconds"] / one
        say(json.dumps(row))
    return {"world": "hybrid", "pile": "cone", "loads": loads, "plans": plans, "rows": rows}


def _times(job: Job, planner: Greedy, loads: int, plans: int, repeats: int) -> dict[str, float]:
    """Processor time of one evaluation of each kind [s]."""
    one: Any = planner.propose(job, loads, seed=0).candidates
    many = jax.tree.map(lambda leaf: jnp.repeat(leaf, plans, axis=0), one)
    count = loads * plans
    cusps = cusps_of_plans(job, many)
    known = ParallelMap(lambda job, row: play_candidate(job, row[0], cusps=row[1], report=False))

    def processor(function: Callable[[], Any]) -> float:
        jax.block_until_ready(function())
        times = []
        for _ in range(repeats):
            start = time.process_time()
            jax.block_until_ready(function())
            times.append(time.process_time() - start)
        return min(times)

    loading = processor(lambda: known(job, (many, cusps)).cost) / count
    searched = processor(lambda: outcomes(job, many).cost) / count
    gradient = processor(lambda: costs_and_gradients(job, (many, cusps))) / count
    standing, watch = beginning(job), Watch()
    tried = planner.attempt(job, standing, np.random.default_rng(0), watch)
    outlook, _ = planner.outlook(job, standing, tried, watch)
    looks = processor(lambda: planner.attempt(job, standing, np.random.default_rng(1), watch).costs)
    positions = tried.poses[:: planner.neighbours * len(planner.offsets), 0]
    quick = processor(lambda: quick_ways(job, job.pile, positions)) / len(positions)
    refined = planner.refined * planner.refine_steps
    refine = processor(lambda: planner.best(job, standing, tried, outlook, watch).scores)
    return {
        "loading": loading,
        "gradient": gradient,
        "look": max(looks - len(positions) * quick, 0.0) / tried.costs.size,
        "look_gradient": refine / refined,
        "way": searched - loading,
        "quick_way": quick,
    }


def draw(folder: Path) -> None:
    """Measured beside counted."""
    rows = json.loads((folder / "efforts.json").read_text())["rows"]
    figure = new_figure(4.5, 2.6)
    panel = figure.subplots()
    places = np.arange(len(rows))
    for what, colour, mark in (("measured", BLUE, "o"), ("counted", ORANGE, "x")):
        panel.plot([row[what] for row in rows], places, mark, color=colour, label=what)
    panel.set_xscale("log")
    panel.set_yticks(places, [row["kind"].replace("_", " ") for row in rows], fontsize=8)
    panel.set_xlabel("in loadings whose pile is predicted too", fontsize=8)
    panel.legend(frameon=False, fontsize=8)
    tidy(panel)
    write_bytes_atomic(folder / "efforts.png", png_bytes(figure))


if __name__ == "__main__":
    main("efforts", run, draw)
