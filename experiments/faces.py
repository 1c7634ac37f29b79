"""Plans for few and for many loads, with room to drive and without, on four piles.

Greedy plans, for three objectives: the follow-up's, which does not ask whether the loader can drive
there; with room to drive, as the named objectives have it; and with what practice asks of a face
besides. Each is played in the simulator and drives its ways there.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.planning.objectives import OBJECTIVES
from wlplan.planning.placement import beside
from wlplan.planning.plan import play
from wlplan.planning.planners import Greedy
from wlplan.report.document import paths_of
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.site.site import Site
from wlplan.types import Pile

LOADS = (10, 30, 60)
FOLLOW_UP = {name: OBJECTIVES["efficiency"][name] for name in ("mass", "time", "work")}
OF_THE_FACE = {"slot": 0.2, "oblique": 1.0, "undercut": 2.0}
ASKED = {
    "follow-up": FOLLOW_UP,
    "room to drive": OBJECTIVES["efficiency"],
    "room and face": {**OBJECTIVES["efficiency"], **OF_THE_FACE},
}
# What every plan is measured by.
MEASURED = {**OBJECTIVES["efficiency"], **OF_THE_FACE}
# Metres of way and lane through what must not be touched from which on a load stands in it.
STANDS_IN = 0.1
# An outline so deep in something has touched it: half a cell of the pile is rounding [m].
TOUCHES = 0.05


def piles() -> dict[str, Pile]:
    """A cone, a ridge, a bay between three walls, and the pile that comes with the package."""
    cone, ridge = (
        wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(30.0), height=4.0, seed=1))
        for kind in ("conical", "triangular")
    )
    return {
        "cone": cone,
        "ridge": ridge,
        "bay": bay(),
        "bundled": wlplan.read_pile(bundled_pile_path()),
    }


def bay() -> Pile:
    """Soil against the back of a bay 14 m wide, its walls 3 m high; open to -x."""
    axis = 0.1 * np.arange(321) - 16.0
    x, y = np.meshgrid(axis, axis, indexing="ij")
    inside = (np.abs(y) < 7.0) & (x < 10.0)
    walls = (x > -1.0) & (x < 10.4) & (np.abs(y) < 7.4) & ~inside
    ground = np.where(walls, 3.0, 0.0)
    soil = np.where(inside, np.clip((x - 1.0) * math.tan(math.radians(30.0)), 0.0, 2.8), 0.0)
    pile = Pile((ground + soil).astype(np.float32), 0.1, (-16.0, -16.0), ground.astype(np.float32))
    return wlplan.relax(pile)


def run(preset: str) -> dict[str, Any]:
    """Plans in the low world, played in the simulator."""
    smoke = preset == "smoke"
    planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3) if smoke else Greedy()
    chosen = {"cone": piles()["cone"]} if smoke else piles()
    objectives = {"follow-up": FOLLOW_UP} if smoke else ASKED
    counts = (2,) if smoke else LOADS
    low, simulator = wlplan.load_world("low"), wlplan.load_world("simulator")
    rows = []
    for name, pile in chosen.items():
        site = beside(Site(), pile)
        for asked, objective in objectives.items():
            plan = wlplan.plan_loads(
                low,
                pile,
                loads=max(counts),
                planner=planner,
                site=site,
                objective=objective,
                seed=1,
            )
            played = play(simulator, pile, plan.plan, site=site, objective=MEASURED)
            foreseen, clear = (
                np.array([path["clearance"] for path in paths_of(pile, result, site)])
                for result in (plan, played)
            )
            # A greedy plan for few loads is the beginning of one for many.
            for loads in counts:
                row: dict[str, Any] = {"pile": name, "loads": loads, "objective": asked}
                row["foreseen_not_clear"] = int((foreseen[:loads] < -TOUCHES).sum())
                rows.append({**row, **_summary(played, clear, loads)})
                say(json.dumps(rows[-1]))
    return {"rows": rows}


def _summary(
    played: wlplan.PlanResult, clear: Float[np.ndarray, " n"], loads: int
) -> dict[str, Any]:
    """What the first loads come to, and how the loader drives there.

    Args:
        played: A plan of at least so many loads, with the terms of `MEASURED`.
        clear: Least distance of each load to anything [m].
        loads: How many of them.
    """
    first = jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float64)[:loads],
        (played.terms, played.rollout.performance, played.transport),
    )
    sums, performance, transport = jax.tree.map(lambda leaf: float(leaf.sum()), first)
    clear = clear[:loads]
    return {
        "mass": performance.mass,
        "time": performance.time + transport.time,
        "cost": sum(weight * sums[name] for name, weight in FOLLOW_UP.items()),
        "touching": transport.touching,
        "stand_in_soil": int((first[2].touching > STANDS_IN).sum()),
        "not_clear": int((clear < -TOUCHES).sum()),
        "worst_clearance": float(clear.min()),
        **{name: sums[name] for name in OF_THE_FACE},
    }


def draw(folder: Path) -> None:
    """The part of the loads that is not clear, and the cost, of each pile and number of loads."""
    rows = json.loads((folder / "faces.json").read_text())["rows"]
    names = list(dict.fromkeys(row["pile"] for row in rows))
    figure = new_figure(2.2 * len(names) + 1.2, 4.6)
    panels = figure.subplots(2, len(names), sharex=True, sharey="row", squeeze=False)
    colours = dict(zip(ASKED, (FAINT, BLUE, ORANGE), strict=True))
    for (above, below), name in zip(panels.T, names, strict=True):
        for asked, colour in colours.items():
            of = [row for row in rows if row["pile"] == name and row["objective"] == asked]
            loads = [row["loads"] for row in of]
            part = [100.0 * row["not_clear"] / row["loads"] for row in of]
            above.plot(loads, part, "o-", ms=4, color=colour, lw=1.2, label=asked)
            cost = [row["cost"] / row["loads"] for row in of]
            below.plot(loads, cost, "o-", ms=4, color=colour, lw=1.2)
        above.set_title(name, fontsize=9)
        below.set_xlabel("loads", fontsize=8)
        tidy(above)
        tidy(below)
    panels[0, 0].set_ylabel("loads that touch [%]", fontsize=8)
    panels[1, 0].set_ylabel("cost a load, follow-up's", fontsize=8)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    write_bytes_atomic(folder / "faces.png", png_bytes(figure))


if __name__ == "__main__":
    main("faces", run, draw)
