"""What it is worth where the trucks stand: the default place, the planner's, one for each."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import wlplan
from experiments._common.joint import refined
from experiments._common.results import main
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.planning.amounts import Made, typical_load
from wlplan.planning.job import make_job, with_toe
from wlplan.planning.placement import not_for_trucks, truck_stands_on
from wlplan.planning.plan import choose, play
from wlplan.planning.planners import Greedy
from wlplan.planning.proposals import Proposals
from wlplan.planning.spots import at_receiver
from wlplan.planning.watch import Watch
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy
from wlplan.site.site import Site
from wlplan.types import Pile

SEED_PILES = ("conical", "triangular", "wedge")
SLOPE_DEGREES, SEEDS = 30.0, (1, 2, 3)
TRUCKS, PAYLOAD = 2, 24.0
# Enough trucks that the pile changes, on some of the piles.
MANY_TRUCKS, MANY_ON = 4, ("bundled", "conical 1", "triangular 2")
KINDS = ("default", "auto", "auto, refined", "each")
# Steps of the descent of place and digs together.
STEPS = 16


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
    """Greedy plans in the hybrid world with trucks here and there, played in the simulator."""
    rows = []
    for name, pile in piles(preset).items():
        kinds = KINDS[:3]
        rows += [one(name, pile, kind, TRUCKS, preset) for kind in kinds]
        if preset == "smoke" or name in MANY_ON:
            rows += [one(name, pile, kind, MANY_TRUCKS, preset) for kind in ("auto", "each")]
    return {"payload": PAYLOAD, "planner": "greedy", "rows": rows}


def one(name: str, pile: Pile, kind: str, trucks: int, preset: str) -> dict[str, Any]:
    """One plan, as it is foreseen and as it is played.

    Args:
        name: Of the pile.
        pile: The pile.
        kind: One of `KINDS`.
        trucks: To be filled.
        preset: Of the experiment.
    """
    planner, amount, steps = Greedy(), wlplan.Trucks(trucks, PAYLOAD), STEPS
    if preset == "smoke":
        planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3)
        amount, steps = wlplan.Trucks(trucks // 2, 5.0), 1
    hybrid, simulator = wlplan.load_world("hybrid"), wlplan.load_world("simulator")
    begun = time.perf_counter()
    truck = {"default": None, "each": "each"}.get(kind, "auto")
    plan = wlplan.plan_loads(hybrid, pile, amount=amount, planner=planner, truck=truck)
    if kind == "auto, refined":
        plan = _refined(hybrid, pile, amount, planner, plan, steps)
    site = Site(receiver=plan.receiver)
    played = play(simulator, pile, plan.plan, amount=amount, objective="delivery", site=site)
    row = {
        "pile": name,
        "truck": kind,
        "trucks": trucks,
        "loads": len(plan.costs),
        "model": _summary(plan),
        "simulator": _summary(played),
        "spent": plan.spent,
        "seconds": time.perf_counter() - begun,
        "receiver": np.stack([np.asarray(v) for v in jax.tree.leaves(plan.receiver)]).tolist(),
    }
    print(json.dumps(row), flush=True)
    return row


def _refined(
    world: wlplan.World,
    pile: Pile,
    amount: wlplan.Trucks,
    planner: Greedy,
    plan: wlplan.PlanResult,
    steps: int,
) -> wlplan.PlanResult:
    """The plan that a descent of place and digs makes of a greedy one, if it costs less."""
    site = Site(receiver=plan.receiver)
    job = with_toe(make_job(world, pile, site=site, objective="delivery", amount=amount))
    part: Any = amount.part(Made(), typical_load(job.site))
    job = job.replace(amount=part[0])
    start = jax.tree.map(lambda leaf: leaf[0], planner.propose(job, part[1], seed=0).candidates)
    blocked = not_for_trucks(pile)

    def may_stand(places: np.ndarray) -> np.ndarray:
        room: np.ndarray = truck_stands_on(places, pile, blocked, job.site.machine)[0] == 0.0
        return room

    watch = Watch()
    placed = refined(job, start, may_stand, steps=steps, watch=watch)
    found = choose(at_receiver(job, placed.receiver), Proposals(placed.plan))
    better = found if float(found.cost) < float(plan.cost) else plan
    receiver = placed.receiver if better is found else plan.receiver
    return better.replace(receiver=receiver, spent=plan.spent + watch.spent)


def _summary(outcome: wlplan.PlanResult) -> dict[str, float]:
    """Seconds a tonne without the waits for trucks, which are the same in all plans."""
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
    """Seconds a tonne in the simulator, by where the trucks stand."""
    rows = json.loads((folder / "truck_spot.json").read_text())["rows"]
    figure = new_figure(9.0, 3.4)
    left, right = figure.subplots(1, 2, width_ratios=(3.0, 1.3), sharey=True)
    colours = dict(zip(KINDS, (FAINT, BLUE, GREEN, ORANGE), strict=True))
    for panel, trucks in ((left, TRUCKS), (right, MANY_TRUCKS)):
        some = [row for row in rows if row["trucks"] == trucks]
        names = list(dict.fromkeys(row["pile"] for row in some))
        kinds = [kind for kind in KINDS if any(row["truck"] == kind for row in some)]
        width = 0.8 / max(len(kinds), 1)
        for number, kind in enumerate(kinds):
            found = [row for row in some if row["truck"] == kind]
            at = [
                names.index(row["pile"]) + (number - 0.5 * (len(kinds) - 1)) * width
                for row in found
            ]
            values = [row["simulator"]["seconds_a_tonne"] for row in found]
            panel.bar(at, values, 0.95 * width, color=colours[kind], label=kind)
        panel.set_xticks(np.arange(len(names)), names, rotation=30, ha="right", fontsize=8)
        panel.set_title(f"{trucks} trucks of {PAYLOAD:g} t", fontsize=9)
        panel.legend(frameon=False, fontsize=8, ncols=len(kinds), loc="upper right")
        tidy(panel)
    left.set_ylim(0.0, 1.2 * max(row["simulator"]["seconds_a_tonne"] for row in rows))
    left.set_ylabel("digging and driving [s/t]", fontsize=8)
    write_bytes_atomic(folder / "truck_spot.png", png_bytes(figure))


if __name__ == "__main__":
    main("truck_spot", run, draw)
