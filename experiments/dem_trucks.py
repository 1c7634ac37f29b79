"""A truck that greedy and the best planner fill, in discrete elements.

All plan in the hybrid world, the best planner load by load on the pile as the simulator has it. The
simulator and the discrete elements then play the same decisions, each dig at the toe of the pile as
they have it by then.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from experiments._common.rows import Rows
from wlplan.io import write_bytes_atomic
from wlplan.planning.job import Job
from wlplan.planning.plan import choose
from wlplan.planning.planners import Greedy, IteratedGreedy
from wlplan.planning.proposals import Planner, Progress, Proposals
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy

# Six loads.
AMOUNT = wlplan.Trucks(1, 27.0)
KINDS = ("conical", "triangular")
SEED = 1
ROWS = Path("out") / "dem_trucks.jsonl"
# Presets that play in discrete elements: `python -m experiments all` leaves them out without it.
ENGINE = ("full",)


@dataclasses.dataclass(frozen=True)
class _Case:
    """How a plan is made."""

    planner: Planner
    truck: Literal["auto"] | None = None
    # Whether it is planned load by load on the pile as the simulator has it.
    in_referee: bool = False


@dataclasses.dataclass
class _Kept:
    """A planner, and what it was asked and handed over."""

    planner: Planner
    plays_in_referee: bool
    asked: list[tuple[Job, Proposals]] = dataclasses.field(default_factory=list)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The best of its plans; arguments as of `Planner.propose`."""
        proposals = self.planner.propose(job, loads, seed=seed, progress=progress)
        # The very best is the first of all that hand over several.
        best = Proposals(jax.tree.map(lambda leaf: leaf[:1], proposals.candidates))
        self.asked.append((job.replace(referee=None), best))
        return best


def run(preset: str) -> dict[str, Any]:
    """Plans jobs and plays each plan in three worlds; the smoke preset leaves out the third."""
    smoke = preset == "smoke"
    few = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3)
    amount = wlplan.Trucks(1, 5.0) if smoke else AMOUNT
    greedy, best = (few, few) if smoke else (Greedy(), IteratedGreedy())
    own: Literal["auto"] | None = None if smoke else "auto"
    worlds = ("simulator",) if smoke else ("simulator", "discrete elements")
    cases = {
        "greedy, default spot": _Case(greedy),
        "greedy, its own spot": _Case(greedy, truck=own),
        "best planner, its own spot": _Case(best, truck=own, in_referee=True),
    }
    made_with = {"amount": repr(amount), "cases": repr(cases)}
    kept = None if smoke else Rows(ROWS, made_with)
    rows = []
    for kind, name in itertools.product(KINDS[:1] if smoke else KINDS, cases):
        make = functools.partial(_played, kind, cases[name], amount, worlds)
        played = make() if kept is None else kept.get(f"{kind}, {name}", make)
        rows.append({"pile": kind, "plan": name, **played})
    return {"payload": float(amount.payload), "seed": SEED, "rows": rows}


def _played(
    kind: str, case: _Case, amount: wlplan.Trucks, worlds: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """One plan, in the world that planned it and in others."""
    pile = wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(30.0), seed=SEED))
    simulator = wlplan.load_world("simulator")
    kept = _Kept(case.planner, case.in_referee)
    plan = wlplan.plan_loads(
        wlplan.load_world("hybrid"),
        pile,
        amount=amount,
        planner=kept,
        truck=case.truck,
        seed=SEED,
        referee=simulator if case.in_referee else None,
        mend=False,
    )
    played = {"model": _summary(plan)}
    ((job, proposals),) = kept.asked
    for name in worlds:
        world = simulator if name == "simulator" else wlplan.load_world("dem")
        result = choose(job, proposals, referee=world, mend=False).refereed
        assert result is not None
        played[name] = _summary(result)
        say(json.dumps({name: played[name]}))
    return played


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
    figure = new_figure(8.0, 3.2)
    panel = figure.subplots()
    places = np.arange(len(rows))
    for shift, world, colour in zip(
        (-0.26, 0.0, 0.26), worlds, (FAINT, BLUE, ORANGE), strict=False
    ):
        values = [row[world]["seconds_a_tonne"] for row in rows]
        panel.bar(places + shift, values, 0.24, color=colour, label=world)
    names = [",\n".join([row["pile"], *row["plan"].split(", ")]) for row in rows]
    panel.set_xticks(places, names, fontsize=7)
    panel.set_ylabel("digging and driving [s/t]", fontsize=8)
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=8)
    tidy(panel)
    write_bytes_atomic(folder / "dem_trucks.png", png_bytes(figure))


if __name__ == "__main__":
    main("dem_trucks", run, draw)
