"""Plans of four planners on the three kinds of seed pile, in model and simulator."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import jax

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.planning.plan import play
from wlplan.planning.planners import Gradient, Greedy, IteratedGreedy, Nominal
from wlplan.planning.proposals import Planner
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy

_NAMES = {
    "Nominal": "nominal",
    "Greedy": "greedy",
    "Gradient": "gradient",
    "IteratedGreedy": "iterated greedy",
}
KINDS = ("conical", "triangular", "wedge")
SLOPE_DEGREES, SEED, LOADS = 30.0, 1, 15


def run(preset: str) -> dict[str, Any]:
    """Plans with each planner in the low world and plays the plans in the simulator."""
    smoke = preset == "smoke"
    kinds, loads = (KINDS[:1], 2) if smoke else (KINDS, LOADS)
    planners: tuple[Planner, ...] = (Nominal(), Greedy(), Gradient(), IteratedGreedy())
    if smoke:
        greedy = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3)
        nominal = Nominal(actions=6, refine_steps=2, rows=2)
        few = Gradient(starts=2, iterations=2, candidates=3, start=greedy)
        iterated = IteratedGreedy(rounds=1, starts=1, greedy=greedy, candidates=2)
        planners = (nominal, greedy, few, iterated)
    low, simulator = wlplan.load_world("low"), wlplan.load_world("simulator")
    rows = []
    for kind in kinds:
        pile = wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(SLOPE_DEGREES), seed=SEED))
        for planner in planners:
            for referee in (None, simulator):
                start = time.perf_counter()
                plan = wlplan.plan_loads(
                    low,
                    pile,
                    loads=loads,
                    planner=planner,
                    seed=SEED,
                    referee=referee,
                )
                jax.block_until_ready(plan.cost)
                seconds = time.perf_counter() - start
                simulated = plan.refereed or play(simulator, pile, plan.plan)
                rows.append(
                    {
                        "pile": kind,
                        "planner": _NAMES[type(planner).__name__]
                        + (" + referee" if referee is not None else ""),
                        "model": _summary(plan),
                        "simulator": _summary(simulated),
                        "seconds_with_compile": seconds,
                    }
                )
                say(json.dumps(rows[-1]))
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
        "transport_time": float(outcome.transport.time.sum()),
        "transport_work": float(outcome.transport.work.sum()),
    }


def draw(folder: Path) -> None:
    """Cost of each plan in the model and in the simulator, in one row each."""
    result = json.loads((folder / "planners.json").read_text())
    kinds = list(dict.fromkeys(row["pile"] for row in result["rows"]))
    figure = new_figure(3.0 * len(kinds) + 1.2, 2.9)
    panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
    for panel, kind in zip(panels, kinds, strict=True):
        rows = [row for row in result["rows"] if row["pile"] == kind]
        costs = {where: [row[where]["cost"] for row in rows] for where in ("model", "simulator")}
        places = range(len(rows))
        panel.hlines(places, costs["model"], costs["simulator"], color=FAINT, lw=1.0)
        panel.plot(costs["model"], places, "o", ms=5, mfc="white", color=BLUE, label="model")
        panel.plot(costs["simulator"], places, "o", ms=5, color=ORANGE, label="simulator")
        for place, pair in zip(places, zip(*costs.values(), strict=True), strict=True):
            label = ", ".join(f"{cost:.1f}" for cost in pair)
            panel.annotate(
                label, (max(pair), place), (6, 0), textcoords="offset points", va="center", size=7
            )
        # Room for what is written beside the last point.
        panel.set_xmargin(0.1)
        low, high = panel.get_xlim()
        panel.set_xlim(low, high + 0.25 * (high - low))
        panel.set_yticks(places, [row["planner"] for row in rows], fontsize=8)
        panel.set_title(f"{kind}, {result['slope_degrees']:g}°", fontsize=9)
        panel.set_xlabel(f"cost of {result['loads']} loads; written: model, simulator", fontsize=8)
        tidy(panel)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    write_bytes_atomic(folder / "planners.png", png_bytes(figure))


if __name__ == "__main__":
    main("planners", run, draw)
