"""A truck that greedy and the best planner fill, each from its own spot, in discrete elements.

Both plan in the hybrid world. The simulator and the discrete elements then play the same decisions,
each dig at the toe of the pile as they have it by then.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

import wlplan
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.planning.job import Job
from wlplan.planning.plan import choose
from wlplan.planning.planners import Gradient, Greedy, IteratedGreedy
from wlplan.planning.proposals import Planner, Progress, Proposals
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy

# Six loads.
AMOUNT = wlplan.Trucks(1, 27.0)
KINDS = ("conical", "triangular")
SEED = 1


@dataclasses.dataclass
class _Kept:
    """A planner, and what it was asked and handed over."""

    planner: Planner
    asked: list[tuple[Job, Proposals]] = dataclasses.field(default_factory=list)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The best of its plans; arguments as of `Planner.propose`."""
        proposals = self.planner.propose(job, loads, seed=seed, progress=progress)
        # The very best is the first of all that hand over several.
        best = Proposals(jax.tree.map(lambda leaf: leaf[:1], proposals.candidates))
        self.asked.append((job, best))
        return best


def run(preset: str) -> dict[str, Any]:
    """Plans two jobs and plays each plan in three worlds; the smoke preset leaves out the third."""
    smoke = preset == "smoke"
    few = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3)
    amount = wlplan.Trucks(1, 5.0) if smoke else AMOUNT
    best: Planner = few if smoke else Gradient(start=IteratedGreedy())
    cases: dict[str, tuple[Planner, Any]] = {
        "greedy, default spot": (few if smoke else Greedy(), None),
        "best planner, its own spot": (best, None if smoke else "auto"),
    }
    hybrid = wlplan.load_world("hybrid")
    referees = {"simulator": wlplan.load_world("simulator")}
    if not smoke:
        referees["discrete elements"] = wlplan.load_world("dem")
    rows = []
    for kind in KINDS[:1] if smoke else KINDS:
        pile = wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(30.0), seed=SEED))
        for name, (planner, truck) in cases.items():
            kept = _Kept(planner)
            plan = wlplan.plan_loads(
                hybrid, pile, amount=amount, planner=kept, truck=truck, seed=SEED
            )
            played = {"model": _summary(plan)}
            ((job, proposals),) = kept.asked
            for world, referee in referees.items():
                result = choose(job, proposals, referee=referee).refereed
                assert result is not None
                played[world] = _summary(result)
                print(json.dumps({"pile": kind, "plan": name, world: played[world]}), flush=True)
            rows.append({"pile": kind, "plan": name, **played})
    return {"payload": float(amount.payload), "seed": SEED, "rows": rows}


def _summary(played: wlplan.PlanResult) -> dict[str, Any]:
    performance, transport = played.rollout.performance, played.transport
    mass = np.asarray(performance.mass, float)
    return {
        "cost": float(played.cost),
        "seconds_a_tonne": float(np.sum(performance.time) + np.sum(transport.time))
        / float(mass.sum()),
        "work_a_tonne": float(np.sum(performance.work) + np.sum(transport.work))
        / float(mass.sum()),
        "mass": mass.round(3).tolist(),
        "time": np.asarray(performance.time, float).round(2).tolist(),
    }


def draw(folder: Path) -> None:
    """Seconds a tonne of each plan in each world."""
    rows = json.loads((folder / "dem_trucks.json").read_text())["rows"]
    worlds = [name for name in ("model", "simulator", "discrete elements") if name in rows[0]]
    figure = new_figure(6.0, 2.8)
    panel = figure.subplots()
    places = np.arange(len(rows))
    for shift, world, colour in zip(
        (-0.26, 0.0, 0.26), worlds, (FAINT, BLUE, ORANGE), strict=False
    ):
        values = [row[world]["seconds_a_tonne"] for row in rows]
        panel.bar(places + shift, values, 0.24, color=colour, label=world)
    panel.set_xticks(places, [f"{row['pile']},\n{row['plan']}" for row in rows], fontsize=7)
    panel.set_ylabel("digging and driving [s/t]", fontsize=8)
    panel.legend(frameon=False, fontsize=8)
    tidy(panel)
    write_bytes_atomic(folder / "dem_trucks.png", png_bytes(figure))


if __name__ == "__main__":
    main("dem_trucks", run, draw)
