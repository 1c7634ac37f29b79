"""What it is worth where the trucks stand: the default place, the planner's, one for each."""

from __future__ import annotations

import functools
import json
import math
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import wlplan
from experiments._common.joint import refined
from experiments._common.places import say
from experiments._common.results import main
from experiments._common.rows import Rows
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.planning.amounts import Amount, Made, typical_load
from wlplan.planning.job import make_job, with_toe
from wlplan.planning.placement import not_for_trucks, truck_stands_on
from wlplan.planning.plan import choose, play
from wlplan.planning.planners import Greedy
from wlplan.planning.proposals import Proposals
from wlplan.planning.spots import at_receiver
from wlplan.planning.watch import Watch
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, INK, ORANGE, new_figure, tidy
from wlplan.site.site import Site
from wlplan.types import Pile

SEED_PILES = ("conical", "triangular", "wedge")
SLOPE_DEGREES, SEEDS = 30.0, (1, 2, 3)
TRUCKS, PAYLOAD = 2, 24.0
# Enough trucks that the pile changes, on some of the piles.
MANY_TRUCKS, MANY_ON = 4, ("bundled", "conical 1", "triangular 2")
KINDS = ("default", "auto", "auto, refined", "auto, one by one", "each")
# Steps of the descent of place and digs together, and where it is made.
STEPS, REFINED_ON = 16, ("conical 1", "triangular 2")
ROWS = Path("out") / "truck_spot.jsonl"


class _OneByOne(wlplan.Trucks):
    """Trucks that are planned one after another, and not some of them together."""

    def part(self, made: Made, typical: float) -> tuple[Amount, int] | None:
        """The next truck."""
        return self.next_truck(made, typical)


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
    smoke = preset == "smoke"
    planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3) if smoke else Greedy()
    asked: list[tuple[str, str, int]] = []
    for name in piles(preset):
        kinds = KINDS[:3] if smoke or name in REFINED_ON else KINDS[:2]
        asked += [(name, kind, TRUCKS) for kind in kinds]
        if smoke or name in MANY_ON:
            asked += [(name, kind, MANY_TRUCKS) for kind in ("auto", "auto, one by one", "each")]
    made_with = {"planner": repr(planner), "payload": PAYLOAD}
    kept = None if smoke else Rows(ROWS, made_with)
    rows = []
    for name, kind, trucks in asked:
        make = functools.partial(one, name, piles(preset)[name], kind, trucks, preset)
        rows.append(make() if kept is None else kept.get(f"{name}, {kind}, {trucks}", make))
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
    if kind == "auto, one by one":
        there, one_by_one = Site(receiver=plan.receiver), _OneByOne(amount.count, amount.payload)
        plan = wlplan.plan_loads(hybrid, pile, amount=one_by_one, planner=planner, site=there)
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
    say(json.dumps(row))
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
    colours = dict(zip(KINDS, (FAINT, BLUE, GREEN, INK, ORANGE), strict=True))
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
