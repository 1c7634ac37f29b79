"""A plan made once against one made anew after every scan, when scans, soil or truck are not right.

The simulator is what happens; planned is in the hybrid world, greedily. Whatever was planned, the
loader goes to the place that it was told, or it drives on along that heading until it meets the
pile, and brings the load to where the truck is.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

import wlplan
from experiments._common.results import main
from experiments._common.rows import Rows
from experiments._common.scanning import Scanner
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.planning.load_search import LoadSearch
from wlplan.planning.placement import beside, receiver_at, truck_stands_on
from wlplan.planning.plan import play
from wlplan.planning.planners import Greedy
from wlplan.planning.poses import distance_to_toe
from wlplan.planning.replanning import EXTENT, Replanner, in_map
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, INK, ORANGE, new_figure, tidy
from wlplan.site.machine import WA320
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.heightmap import to_world
from wlplan.terrain.standing import CLEARED
from wlplan.types import LoadingPlan, Pile, Pose, World

KINDS, SLOPE_DEGREES = ("conical", "triangular", "wedge"), 30.0
SEEDS = (1,)
LOADS = {"full": 40, "smoke": 2}
OBJECTIVE = "efficiency"
# All maps have these sides [m]: what is compiled for one pile serves the others.
SIDE = 24.0

RIGHT = Scanner()
# Estimate: the cells of a good scan, smooth over a cell and a half, 2 % of them missed.
NOISY = Scanner(deviation=0.03, smooth=0.15, patches=0.01, rows=0.01)
ASKEW = Scanner(shift=0.1, turn=math.radians(1.0))
NOISY_AND_ASKEW = dataclasses.replace(NOISY, shift=ASKEW.shift, turn=ASKEW.turn)
# By which the soil is not what is believed, as a part.
WRONG = 0.15
DENSER = dataclasses.replace(GRAVEL, density=(1.0 + WRONG) * GRAVEL.density)
ROUGHER = dataclasses.replace(GRAVEL, friction=math.atan((1.0 + WRONG) * math.tan(GRAVEL.friction)))
DENSER_AND_ROUGHER = dataclasses.replace(DENSER, friction=ROUGHER.friction)
# How far trucks stand off their spot [m], and the loads that each takes.
OFF, BUCKETS = 2.0, 5

# A loading that takes longer has stalled [s]; a bucket with less is empty [tonne]; way and lane go
# through so much of something before they count as touching it [m].
STALL, EMPTY, TOUCHES = 15.0, 0.8, 0.05


@dataclasses.dataclass(frozen=True)
class Condition:
    """What is not as the planner takes it to be."""

    scanner: Scanner = RIGHT
    soil: Soil = GRAVEL
    truck_is_off: bool = False
    told: bool = False  # where the truck stands


CONDITIONS = {
    "as believed": Condition(),
    "noise": Condition(NOISY),
    "askew": Condition(ASKEW),
    "denser": Condition(soil=DENSER),
    "rougher": Condition(soil=ROUGHER),
    "truck off": Condition(truck_is_off=True),
    "truck off, told": Condition(truck_is_off=True, told=True),
    "all": Condition(NOISY_AND_ASKEW, DENSER_AND_ROUGHER, truck_is_off=True, told=True),
}
"""What is wrong, by name."""

ONCE, REFEREED, TRACED = "once", "once, refereed", "once, toe traced anew"
ANEW, CAREFUL = "after every scan", "after every scan, careful"
"""How is planned. The referee knows the soil, and sets the poses on the piles that it foresees. A
greedy plan keeps to the toe of the first pile; with the toe traced anew it is what planning after
every scan comes to if the model is right. Careful has the objective of that name."""

PLACE, TOE = "to the place", "to the toe"
"""How the loader gets to a dig."""

OPEN = ((ONCE, PLACE), (ONCE, TOE), (REFEREED, PLACE), (TRACED, TOE))
WAYS = (*OPEN, (ANEW, PLACE), (CAREFUL, PLACE), (ANEW, TOE))
"""Both, as they are played."""

Told = Callable[[int, Pile], LoadingPlan]
"""What the loader is told for each load, leaves [1], when the pile is as it is."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """What a run is made with."""

    loads: int
    extent: float  # largest scan that is planned for [m]
    search: dict[str, Any]  # settings of the search of a load that are not the default


def piles(preset: str) -> dict[str, tuple[Pile, int]]:
    """Piles and seeds of everything random, by name; the first seed of all of them first."""
    kinds, seeds = (KINDS[:1], SEEDS[:1]) if preset == "smoke" else (KINDS, SEEDS)
    slope = math.radians(SLOPE_DEGREES)
    found = {}
    for seed in seeds:
        for kind in kinds:
            pile = wlplan.relax(wlplan.seed_pile(kind, slope=slope, seed=seed))
            found[f"{kind} {seed}"] = pile, seed
        if preset != "smoke":
            found[f"bundled {seed}"] = wlplan.read_pile(bundled_pile_path()), seed
    return found


def run(preset: str, rows: Path) -> dict[str, Any]:
    """Plays all plans in all conditions on all piles."""
    smoke = preset == "smoke"
    few = {"actions": 6, "refine_steps": 2, "poses_per_metre": 0.3} if smoke else {}
    setup = Setup(LOADS[preset], SIDE if smoke else EXTENT, few)
    names = ("all",) if smoke else tuple(CONDITIONS)
    kept = Rows(rows, dataclasses.asdict(setup))
    found = []
    for pile_name, (pile, seed) in piles(preset).items():
        bench = _Bench(pile, seed, setup)
        for name in names:
            condition = CONDITIONS[name]
            for plan, drive in WAYS:
                if plan == ANEW and drive == TOE and not condition.scanner.shift:
                    # The place that is told is the toe, but for the noise.
                    continue

                def made(
                    condition: Condition = condition,
                    plan: str = plan,
                    drive: str = drive,
                    bench: _Bench = bench,
                ) -> dict[str, Any]:
                    return bench.play(condition, plan, drive)

                row = kept.get(f"{pile_name} / {name} / {plan} / {drive}", made)
                of = {"pile": pile_name, "condition": name, "plan": plan, "drive": drive}
                found.append(of | row)
    per_load = ("costs", "wall", "processor")
    return {
        "loads": setup.loads,
        "extent": setup.extent,
        "objective": OBJECTIVE,
        "differences": differences(found, ANEW, OPEN),
        "careful": differences(found, CAREFUL, ((ANEW, PLACE),)),
        "seconds_a_load": {plan: _seconds(found, plan) for plan in (ANEW, CAREFUL)},
        "cumulative": _cumulative(found),
        "rows": [{key: row[key] for key in row if key not in per_load} for row in found],
    }


class _Timing(NamedTuple):
    """How long planning each load took, by the wall and in all threads [s]."""

    wall: list[float]
    processor: list[float]

    def row(self) -> dict[str, Any]:
        """Without the first load, which may compile, and with what else the machine was doing."""
        wall, processor = ([round(s, 3) for s in times[1:]] for times in self)
        return {"wall": wall, "processor": processor, "machine_load": os.getloadavg()[0]}


class _Bench:
    """A pile with a seed: all that is played there."""

    def __init__(self, pile: Pile, seed: int, setup: Setup):
        self._seed, self._setup = seed, setup
        self._hybrid = wlplan.load_world("hybrid")
        self._pile = in_map(pile, wlplan.Site(), SIDE)[0]
        self._site = beside(Site(), pile)
        self._once: dict[tuple[Scanner, bool], LoadingPlan] = {}

    def play(self, condition: Condition, plan: str, drive: str) -> dict[str, Any]:
        """One row: all loads in one condition, planned and driven in one way."""
        simulator = wlplan.load_world("simulator", soil=condition.soil)
        # The same scans, trucks and luck, however it is planned.
        trucks = self._trucks(condition, np.random.default_rng(self._seed))
        random, timing = np.random.default_rng(self._seed), _Timing([], [])
        if plan in (ANEW, CAREFUL):
            goal = "careful" if plan == CAREFUL else OBJECTIVE
            told = self._after_every_scan(condition, trucks, random, timing, goal)
        else:
            scan = condition.scanner.scan(self._pile, random)
            told = _from(self._plan(scan, condition.scanner, traced=plan == TRACED))
            if plan == REFEREED:
                told = _from(self._foreseen(simulator, scan, told, TOE))
        made = self._played(simulator, self._pile, told, trucks, drive)
        return _summary(made) | timing.row()

    def _played(
        self, world: World, pile: Pile, told: Told, trucks: list[Receiver], drive: str
    ) -> list[wlplan.PlanResult]:
        """Loads one after the other."""
        made: list[wlplan.PlanResult] = []
        for n, truck in enumerate(trucks):
            one = told(n, pile)
            if drive == TOE:
                one = one.replace(pose=_on_to_the_toe(pile, one.pose))
            site = self._site.replace(receiver=truck)
            made.append(play(world, pile, one, site=site, objective=OBJECTIVE))
            pile = made[-1].rollout.pile
        return made

    def _after_every_scan(
        self,
        condition: Condition,
        trucks: list[Receiver],
        random: np.random.Generator,
        timing: _Timing,
        objective: str = OBJECTIVE,
    ) -> Told:
        planner = Replanner(
            self._hybrid,
            site=self._site,
            objective=objective,
            search=LoadSearch(**self._setup.search),
            extent=self._setup.extent,
            seed=self._seed,
        )

        def told(n: int, pile: Pile) -> LoadingPlan:
            scan = condition.scanner.scan(pile, random)
            begun = time.perf_counter(), time.process_time()
            load = planner.next_load(scan, receiver=trucks[n] if condition.told else None)
            jax.block_until_ready(load)
            timing.wall.append(time.perf_counter() - begun[0])
            timing.processor.append(time.process_time() - begun[1])
            return _one(LoadingPlan(load.pose, load.action), None)

        return told

    def _foreseen(self, world: World, pile: Pile, told: Told, drive: str) -> LoadingPlan:
        """The plan that comes of what is told, where a world is what happens."""
        spots = [self._site.placed_receiver] * self._setup.loads
        plans = [one.plan for one in self._played(world, pile, told, spots, drive)]
        whole: LoadingPlan = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *plans)
        return whole

    def _plan(self, scan: Pile, scanner: Scanner, *, traced: bool) -> LoadingPlan:
        """The plan for all loads, made once by greedy, or with the toe traced before each."""
        key = scanner, traced
        if key not in self._once and traced:
            random = np.random.default_rng(self._seed)
            told = self._after_every_scan(Condition(), [], random, _Timing([], []))
            self._once[key] = self._foreseen(self._hybrid, scan, told, PLACE)
        elif key not in self._once:
            self._once[key] = wlplan.plan_loads(
                self._hybrid,
                scan,
                loads=self._setup.loads,
                objective=OBJECTIVE,
                planner=Greedy(**self._setup.search),
                site=self._site,
                seed=self._seed,
            ).plan
        return self._once[key]

    def _trucks(self, condition: Condition, random: np.random.Generator) -> list[Receiver]:
        """Where the truck of each load stands: at its spot, or so far off it, and on no soil."""
        spot, loads = self._site.placed_receiver, self._setup.loads
        if not condition.truck_is_off:
            return [spot] * loads
        places = np.repeat(np.array([[spot.x, spot.y, spot.heading]], float), 360, axis=0)
        bearing = np.radians(np.arange(360.0))
        places[:, :2] += OFF * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        soil = np.asarray(self._pile.height - self._pile.floor) > CLEARED
        on, _ = truck_stands_on(places, self._pile, soil, WA320)
        free = places[on <= on.min()]
        rows = random.integers(len(free), size=-(-loads // BUCKETS))
        return [receiver_at(free[rows[n // BUCKETS]], self._pile) for n in range(loads)]


def _from(plan: LoadingPlan) -> Told:
    """The loads of a plan that was made before."""
    return lambda n, pile: _one(plan, n)


def _one(plan: LoadingPlan, row: int | None) -> LoadingPlan:
    """A row of a plan, or a single load, as a plan of one load."""
    one: LoadingPlan = jax.tree.map(lambda leaf: (leaf if row is None else leaf[row])[None], plan)
    return one


@jax.jit
def _on_to_the_toe(pile: Pile, pose: Pose) -> Pose:
    """A pose, leaves [1], moved along its heading to where the pile begins."""
    one = jax.tree.map(lambda leaf: leaf[0], pose)
    distance = distance_to_toe(pile, one, width=WA320.bucket_width)
    x, y = to_world(one, distance, jnp.zeros_like(distance))
    return Pose(x[None], y[None], pose.heading)


def _summary(made: list[wlplan.PlanResult]) -> dict[str, Any]:
    """What loads came to, one result each."""

    def of_loads(values: list[Any]) -> Float[np.ndarray, " n"]:
        return np.concatenate([np.asarray(value, np.float64) for value in values])

    performance, transport = [one.rollout.performance for one in made], [m.transport for m in made]
    mass, digging, work = (
        of_loads([getattr(one, name) for one in performance]) for name in ("mass", "time", "work")
    )
    driving, hauling, touching = (
        of_loads([getattr(one, name) for one in transport]) for name in ("time", "work", "touching")
    )
    costs = of_loads([one.costs for one in made])
    sums = {
        "cost": costs,
        "mass": mass,
        "time": digging + driving,
        "energy": work + hauling,
        "digging_time": digging,
        "digging_work": work,
        "metres_touched": touching,
    }
    return {
        **{name: round(float(values.sum()), 3) for name, values in sums.items()},
        "stalls": int((digging > STALL).sum()),
        "empty": int((mass < EMPTY).sum()),
        "touching": int((touching > TOUCHES).sum()),
        "costs": [round(float(cost), 3) for cost in costs],
    }


_MEASURES: dict[str, Callable[[dict[str, Any]], float]] = {
    "cost": lambda row: row["cost"],
    "seconds_a_tonne": lambda row: row["time"] / row["mass"],
    "energy_a_tonne": lambda row: row["energy"] / row["mass"],
}


def differences(
    rows: list[dict[str, Any]], of: str, beside: Sequence[tuple[str, str]]
) -> list[dict[str, Any]]:
    """What a way to plan differs by from others, in pairs of the same pile and seed.

    Cost, seconds a tonne and kJ a tonne, each in percent of the other: means, and half the interval
    of 95 % of the mean by Student's t; None of a single pair.

    Args:
        rows: All of them.
        of: How is planned.
        beside: The others: how is planned, and how the loader gets to a dig there, as here.
    """
    by_name = {(r["pile"], r["condition"], r["plan"], r["drive"]): r for r in rows}
    names = list(dict.fromkeys(row["pile"] for row in rows))
    found = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        for plan, drive in beside:
            pairs = []
            for name in names:
                # Where the place that is told is the toe, there is one row for both.
                to_place = by_name[name, condition, of, PLACE]
                own = by_name.get((name, condition, of, drive), to_place)
                pairs.append((by_name[name, condition, plan, drive], own))
            one = {"condition": condition, "plan": plan, "drive": drive, "pairs": len(pairs)}
            for measure, value in _MEASURES.items():
                change = [100.0 * (value(own) / value(other) - 1.0) for other, own in pairs]
                one[measure] = _interval(np.array(change))
            one["cheaper"] = sum(own["cost"] < other["cost"] for other, own in pairs)
            found.append(one)
    return found


def _interval(values: Float[np.ndarray, " n"]) -> list[float | None]:
    mean, count = round(float(values.mean()), 3), len(values)
    if count < 2:
        return [mean, None]
    error = float(values.std(ddof=1)) / math.sqrt(count)
    return [mean, round(float(stats.t.ppf(0.975, count - 1)) * error, 3)]


def _seconds(rows: list[dict[str, Any]], plan: str) -> dict[str, float]:
    """How long planning a load took that way, see `_Timing`; quantiles over all loads [s]."""
    found: dict[str, float] = {}
    planned = [row for row in rows if row["plan"] == plan]
    for name in ("wall", "processor"):
        times = np.array([second for row in planned for second in row[name]])
        found |= {
            f"{name}_{word}": round(float(np.quantile(times, part)), 3)
            for word, part in (("median", 0.5), ("90", 0.9), ("largest", 1.0))
        }
        found["loads"] = len(times)
    loads = [row["machine_load"] for row in planned]
    return found | {"machine_load": round(float(np.mean(loads)), 2)}


def _cumulative(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Cost after each load, the mean over piles and seeds."""
    found = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        for plan, drive in WAYS:
            of = {"condition": condition, "plan": plan, "drive": drive}
            costs = [row["costs"] for row in rows if of.items() <= row.items()]
            if costs:
                mean = np.cumsum(np.mean(costs, axis=0))
                found.append(of | {"cost": mean.round(2).tolist()})
    return found


def draw(folder: Path) -> None:
    """What planning anew saves, by condition; and the cost by load where all is wrong."""
    result = json.loads((folder / "closed_loop.json").read_text())
    figure = new_figure(9.0, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.4, 1.0))
    conditions = list(dict.fromkeys(row["condition"] for row in result["differences"]))
    looks = ((ORANGE, "o"), (BLUE, "o"), (FAINT, "s"), (GREEN, "^"))
    styles = dict(zip(OPEN, looks, strict=True))
    shifts = (-0.24, -0.08, 0.08, 0.24)
    for shift, (way, (colour, mark)) in zip(shifts, styles.items(), strict=True):
        of = [row for row in result["differences"] if (row["plan"], row["drive"]) == way]
        means = [row["cost"][0] for row in of]
        errors = [row["cost"][1] or 0.0 for row in of]
        places = np.arange(len(of)) + shift
        left.errorbar(means, places, xerr=errors, fmt=mark, ms=4, color=colour, lw=1.0)
    left.axvline(0.0, color=FAINT, lw=1.0)
    left.set_yticks(range(len(conditions)), conditions, fontsize=8)
    left.invert_yaxis()
    left.set_xlabel(f"cost of planning {ANEW} against planning once [%]", fontsize=8)
    for row in result["cumulative"]:
        if row["condition"] == conditions[-1]:
            way = row["plan"], row["drive"]
            loads = np.arange(1, len(row["cost"]) + 1)
            colour = styles[way][0] if way in styles else INK
            dash = {(ANEW, TOE): "--", (CAREFUL, PLACE): ":"}.get(way, "-")
            cost = np.array(row["cost"]) / loads
            right.plot(loads, cost, dash, color=colour, lw=1.3, label=", ".join(way))
    right.set_xlabel("loads", fontsize=8)
    right.set_ylabel(f"cost a load so far; wrong: {conditions[-1]}", fontsize=8)
    handles, labels = right.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    for panel in (left, right):
        tidy(panel)
    write_bytes_atomic(folder / "closed_loop.png", png_bytes(figure))


if __name__ == "__main__":
    main("closed_loop", run, draw)
