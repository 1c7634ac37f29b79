"""Nominal, greedy and gradient plans on the three kinds of seed pile, in model and simulator."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import jax

import wlplan
from experiments.record import main
from wlplan.io import write_bytes_atomic
from wlplan.planner import PLANNERS, GradientSettings, SearchSettings, play
from wlplan.plots import png_bytes

KINDS = ("conical", "triangular", "wedge")
SLOPE_DEGREES, SEED, LOADS = 30.0, 1, 15


def run(preset: str) -> dict[str, Any]:
    """Plans with each planner in the low world and plays the plans in the simulator."""
    smoke = preset == "smoke"
    kinds, loads = (KINDS[:1], 2) if smoke else (KINDS, LOADS)
    search = SearchSettings(actions=6, refine_steps=2, poses_per_metre=0.3, rows=2)
    quick = {
        "gradient": GradientSettings(starts=2, iterations=2, candidates=3, search=search),
        "greedy": search,
        "nominal": search,
    }
    low, simulator = wlplan.load_world("low"), wlplan.load_world("simulator")
    rows = []
    for kind in kinds:
        pile = wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(SLOPE_DEGREES), seed=SEED))
        for planner in reversed(PLANNERS):
            for referee in (None, simulator):
                start = time.perf_counter()
                plan = wlplan.plan_loads(
                    low,
                    pile,
                    loads=loads,
                    planner=planner,
                    seed=SEED,
                    referee=referee,
                    settings=quick[planner] if smoke else None,
                )
                jax.block_until_ready(plan.cost)
                seconds = time.perf_counter() - start
                simulated = plan.refereed or play(simulator, pile, plan.plan)
                rows.append(
                    {
                        "pile": kind,
                        "planner": planner + (" + referee" if referee is not None else ""),
                        "model": _summary(plan),
                        "simulator": _summary(simulated),
                        "seconds_with_compile": seconds,
                    }
                )
                print(json.dumps(rows[-1]), flush=True)
    return {
        "loads": loads,
        "objective": "efficiency",
        "slope_degrees": SLOPE_DEGREES,
        "seed": SEED,
        "rows": rows,
    }


def _summary(outcome: wlplan.PlanResult) -> dict[str, float]:
    performance = outcome.rollout.performance
    return {
        "cost": float(outcome.cost),
        "mass": float(performance.mass.sum()),
        "time": float(performance.time.sum()),
        "work": float(performance.work.sum()),
        "transport_time": float(outcome.transport_time.sum()),
        "transport_work": float(outcome.transport_work.sum()),
    }


def draw(folder: Path) -> None:
    """Cost of each plan in the model and in the simulator, beside each other."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "planners.json").read_text())
    kinds = list(dict.fromkeys(row["pile"] for row in result["rows"]))
    figure = Figure(figsize=(3.6 * len(kinds) + 0.6, 3.4), layout="constrained")
    axes = figure.subplots(1, len(kinds), squeeze=False)[0]
    for axis, kind in zip(axes, kinds, strict=True):
        rows = [row for row in result["rows"] if row["pile"] == kind]
        for offset, where, colour in ((-0.2, "model", "#1f5fa8"), (0.2, "simulator", "#d97a1f")):
            costs = [row[where]["cost"] for row in rows]
            axis.bar([k + offset for k in range(len(rows))], costs, 0.38, label=where, color=colour)
            for k, cost in enumerate(costs):
                axis.text(k + offset, cost, f"{cost:.1f}", ha="center", va="bottom", fontsize=7)
        names = [row["planner"] for row in rows]
        axis.set_xticks(range(len(rows)), names, rotation=35, ha="right", rotation_mode="anchor")
        axis.set_title(f"{kind}, {result['slope_degrees']:g}°")
        lowest = min(row[where]["cost"] for row in rows for where in ("model", "simulator"))
        axis.set_ylim(0.9 * lowest)
    axes[0].set_ylabel(f"cost of {result['loads']} loads (axis starts above 0)")
    axes[0].legend(frameon=False)
    write_bytes_atomic(folder / "planners.png", png_bytes(figure))


if __name__ == "__main__":
    main("planners", run, draw)
