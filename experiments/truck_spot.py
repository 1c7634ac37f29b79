"""What it is worth where the truck stands: the default place and the planner's, for two trucks."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

import wlplan
from experiments._common.results import main
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.planning.plan import play
from wlplan.planning.planners import Greedy
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, new_figure, tidy
from wlplan.site.site import Site
from wlplan.types import Pile

SEED_PILES = ("conical", "triangular", "wedge")
SLOPE_DEGREES, SEEDS = 30.0, (1, 2, 3)
TRUCKS, PAYLOAD = 2, 24.0


def piles(preset: str) -> dict[str, Pile]:
    """The piles by name: the bundled one, and three of each kind of seed pile."""
    if preset == "smoke":
        return {"conical 1": _seed_pile("conical", 1)}
    found = {"bundled": wlplan.read_pile(bundled_pile_path())}
    for kind in SEED_PILES:
        found |= {f"{kind} {seed}": _seed_pile(kind, seed) for seed in SEEDS}
    return found


def _seed_pile(kind: str, seed: int) -> Pile:
    return wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(SLOPE_DEGREES), seed=seed))


def run(preset: str) -> dict[str, Any]:
    """Greedy plans in the hybrid world with either truck, played in the simulator."""
    smoke = preset == "smoke"
    planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3) if smoke else Greedy()
    amount = wlplan.Trucks(1 if smoke else TRUCKS, 10.0 if smoke else PAYLOAD)
    hybrid, simulator = wlplan.load_world("hybrid"), wlplan.load_world("simulator")
    rows = []
    for name, pile in piles(preset).items():
        for truck in (None, "auto"):
            plan = wlplan.plan_loads(
                hybrid, pile, amount=amount, planner=planner, truck="auto" if truck else None
            )
            site = Site(receiver=plan.receiver)
            played = play(
                simulator, pile, plan.plan, amount=amount, objective="delivery", site=site
            )
            rows.append(
                {
                    "pile": name,
                    "truck": truck or "default",
                    "loads": len(plan.costs),
                    "model": _summary(plan),
                    "simulator": _summary(played),
                    "spent": plan.spent,
                }
            )
            print(json.dumps(rows[-1]), flush=True)
    return {"trucks": TRUCKS, "payload": PAYLOAD, "planner": "greedy", "rows": rows}


def _summary(outcome: wlplan.PlanResult) -> dict[str, float]:
    """Seconds a tonne without the wait for the second truck, which is the same in all plans."""
    performance, transport = outcome.rollout.performance, outcome.transport
    mass = float(np.sum(performance.mass))
    digging, driving = float(np.sum(performance.time)), float(np.sum(transport.time))
    return {
        "cost": float(outcome.cost),
        "mass": mass,
        "seconds_a_tonne": (digging + driving) / mass,
        "seconds_of_transport_a_load": driving / len(outcome.costs),
        "misfit": float(np.sum(outcome.misfit)),
    }


def draw(folder: Path) -> None:
    """Seconds a tonne in the simulator, default beside chosen."""
    rows = json.loads((folder / "truck_spot.json").read_text())["rows"]
    names = [row["pile"] for row in rows if row["truck"] == "default"]
    figure = new_figure(7.0, 3.2)
    panel = figure.subplots()
    place = np.arange(len(names))
    for shift, truck, colour in ((-0.2, "default", FAINT), (0.2, "auto", BLUE)):
        values = [row["simulator"]["seconds_a_tonne"] for row in rows if row["truck"] == truck]
        panel.bar(place + shift, values, 0.38, color=colour, label=truck)
    panel.set_xticks(place, names, rotation=30, ha="right", fontsize=8)
    panel.set_ylabel("digging and driving [s/t]", fontsize=8)
    panel.legend(frameon=False, fontsize=8, title="truck", title_fontsize=8)
    tidy(panel)
    write_bytes_atomic(folder / "truck_spot.png", png_bytes(figure))


if __name__ == "__main__":
    main("truck_spot", run, draw)
