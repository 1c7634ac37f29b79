"""How much there is to win: a long local search over whole plans, in the simulator itself."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.planning.job import Decisions, contour_length, make_job, with_toe
from wlplan.planning.planners import Gradient, Greedy
from wlplan.planning.playing import outcomes
from wlplan.report.figures import png_bytes

KIND, SLOPE_DEGREES, SEED, LOADS = "conical", 30.0, 1, 10


def run(preset: str) -> dict[str, Any]:
    """Starts from the greedy plan and improves it by trial in the simulator."""
    smoke = preset == "smoke"
    loads, rounds, batch = (2, 2, 4) if smoke else (LOADS, 45, 16)
    planner = Gradient()
    if smoke:
        planner = Gradient(
            starts=2,
            iterations=2,
            candidates=3,
            start=Greedy(actions=6, refine_steps=2, poses_per_metre=0.3),
        )
    pile = wlplan.relax(wlplan.seed_pile(KIND, slope=math.radians(SLOPE_DEGREES), seed=SEED))
    job = with_toe(make_job(wlplan.load_world("low"), pile))
    simulated = job.replace(world=wlplan.load_world("simulator"))
    plans, greedy_plan = planner.propose(job, loads, seed=SEED)
    # The limit of the gradient planner is the greedy plan, which is a candidate too.
    plans = jax.tree.map(lambda all_, one: jnp.concatenate([all_, one[None]]), plans, greedy_plan)
    greedy_cost = float(outcomes(simulated, plans).cost[-1])
    costs = np.asarray(outcomes(simulated, plans).cost)
    best = jax.tree.map(lambda leaf: leaf[int(costs.argmin())], plans)
    best_cost = float(costs.min())
    rng = np.random.default_rng(SEED)
    length, spread = float(contour_length(job)), 1.0
    history = [best_cost]
    start = time.perf_counter()
    for k in range(rounds):
        trials = jax.tree.map(
            lambda *leaves: jnp.stack(leaves),
            *(_changed(best, length, spread, rng) for _ in range(batch)),
        )
        costs = np.asarray(outcomes(simulated, trials).cost)
        if costs.min() < best_cost:
            winner, best_cost = int(costs.argmin()), float(costs.min())
            best = jax.tree.map(lambda leaf, w=winner: leaf[w], trials)
            spread = min(1.3 * spread, 2.0)
        else:
            spread = max(0.93 * spread, 0.05)
        history.append(best_cost)
        if k % 10 == 0:
            say(f"{k} {best_cost:.4f} spread {spread:.2f}")
    return {
        "pile": KIND,
        "slope_degrees": SLOPE_DEGREES,
        "seed": SEED,
        "loads": loads,
        "greedy_in_simulator": greedy_cost,
        "gradient_best_in_simulator": history[0],
        "after_search": best_cost,
        "plans_played": rounds * batch,
        "seconds": time.perf_counter() - start,
        "history": history,
    }


def _changed(plan: Decisions, length: float, spread: float, rng: np.random.Generator) -> Decisions:
    """A plan with one to three loadings changed, sometimes moved anywhere or swapped."""
    position, offset = np.array(plan.position), np.array(plan.offset)
    action = np.array(plan.action)
    n = len(position)
    for k in rng.choice(n, size=rng.integers(1, min(3, n) + 1), replace=False):
        kind = rng.random()
        if kind < 0.1:
            position[k] = rng.random()
        elif kind < 0.2:
            other = rng.integers(n)
            for field in (position, offset, action):
                field[[k, other]] = field[[other, k]]
        else:
            position[k] += spread * 0.8 * rng.normal() / length
            offset[k] += spread * 0.3 * rng.normal()
            action[k] += spread * 0.7 * rng.normal(size=4)
    return Decisions(*(jnp.asarray(a, plan.position.dtype) for a in (position, offset, action)))


def draw(folder: Path) -> None:
    """Cost against plans played."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "upper_bound.json").read_text())
    figure = Figure(figsize=(5.0, 3.2), layout="constrained")
    axis = figure.subplots()
    history = result["history"]
    evaluations = np.linspace(0, result["plans_played"], len(history))
    axis.plot(evaluations, history, color="#1f5fa8", label="local search in the simulator")
    axis.axhline(result["greedy_in_simulator"], color="#888888", ls="--", label="greedy")
    axis.set_xlabel("plans played in the simulator")
    axis.set_ylabel(f"cost of {result['loads']} loads")
    axis.legend(frameon=False)
    write_bytes_atomic(folder / "upper_bound.png", png_bytes(figure))


if __name__ == "__main__":
    main("upper_bound", run, draw)
