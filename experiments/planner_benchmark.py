"""What looking ahead is worth: planners on the jobs that sites have, at equal budgets.

Every planner plans in the hybrid world with 1, 10 and 100 times what greedy spends there, and what
it plans is played in the simulator, where each dig is at the toe of the pile as it is by then. Each
run is a row of its own, in a file of its own: a run that was cut short goes on where it was, and
several machines share the work.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

import wlplan
from experiments._common.benchmark_tables import tables
from experiments._common.budgets import OverBudget, Within
from experiments._common.comparison import (
    IN_REFEREE,
    Case,
    best_plans,
    by_planner,
    looking_ahead,
    steps,
)
from experiments._common.instances import EACH, JOBS, PILES, SITES, SMOKE_JOB, Instance
from experiments._common.places import RESULTS, add_places, folder_of, say
from experiments._common.results import redraw, write_result
from experiments._common.row_files import (
    RowFiles,
    add_row_options,
    matching,
    part_of,
    time_is_up,
)
from experiments._common.rows import of_package
from wlplan.cli.progress import Stopwatch
from wlplan.errors import InputError
from wlplan.io import write_bytes_atomic, write_text_atomic
from wlplan.planning.amounts import Made, typical_load
from wlplan.planning.job import make_job, with_toe
from wlplan.planning.planners import (
    CmaEs,
    CrossEntropy,
    Gradient,
    Greedy,
    IteratedGreedy,
    MaxLoad,
    Nominal,
    RandomSearch,
    TreeSearch,
)
from wlplan.planning.proposals import Planner
from wlplan.planning.truck_search import best_place
from wlplan.planning.watch import EFFORTS, Watch
from wlplan.plugins import load_object
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy
from wlplan.site.receiver import Receiver

ROWS = Path("out") / "planner_benchmark"
# The best plan known of each instance, beside the results.
BEST = "planner_benchmark_best.json"
BUDGETS, SEEDS = (1, 10, 100), (0, 1, 2)
# What is run first, see `_rank`: planners, jobs and sites.
_PLANNERS = {"greedy": 0, f"greedy{IN_REFEREE}": 0, f"iterated greedy{IN_REFEREE}": 0}
_PLACES = {
    ("15 loads", "fixed truck"): 0,
    ("15 loads", "free truck"): 0,
    ("15 loads", "walls"): 1,
    ("trucks", "fixed truck"): 0,
    ("trucks", "free truck"): 0,
    ("trucks", "a place for each"): 0,
    ("trucks", "walls, free truck"): 1,
    ("tonnes", "fixed truck"): 1,
    ("empty", "fixed truck"): 1,
    ("50 loads", "fixed truck"): 2,
}
BASES = (("greedy", 1), (f"greedy{IN_REFEREE}", 1))
STEPS = (
    Case("fixed truck", "greedy", 1),
    Case("fixed truck", f"greedy{IN_REFEREE}", 1),
    Case("fixed truck", f"iterated greedy{IN_REFEREE}", 10),
    Case("free truck", "greedy", 1),
    Case("free truck", f"greedy{IN_REFEREE}", 1),
    Case("free truck", f"iterated greedy{IN_REFEREE}", 10),
    Case("a place for each", f"greedy{IN_REFEREE}", 1),
    Case("a place for each", f"iterated greedy{IN_REFEREE}", 10),
)
"""What a user may add to greedy with a fixed truck, one after another."""
# A cycle of filling that takes longer than this has stalled [s].
_STALL = 18.0


def _always(planner: Callable[[], Planner]) -> Callable[[int], Planner]:
    """Whatever the budget is: what a planner does not use up, it gets again with another seed."""
    return lambda budget: planner()


def _iterated(budget: int) -> Planner:
    """As many rounds as the budget has room for, which ends them; one makes half a plan."""
    return IteratedGreedy(starts=min(budget, 3), rounds=10 * budget)


PLANNERS: dict[str, Callable[[int], Planner]] = {
    "greedy": _always(Greedy),
    f"greedy{IN_REFEREE}": _always(Greedy),
    "nominal": _always(Nominal),
    "max load": _always(MaxLoad),
    "random search": _always(RandomSearch),
    "iterated greedy": _iterated,
    f"iterated greedy{IN_REFEREE}": _iterated,
    "gradient": _always(Gradient),
    "gradient from iterated": _always(lambda: Gradient(start=IteratedGreedy(rounds=5))),
    "tree 1": _always(lambda: TreeSearch(depth=1)),
    "tree 2": _always(lambda: TreeSearch(depth=2)),
    "tree 3": _always(lambda: TreeSearch(depth=3)),
    "tree 4": _always(lambda: TreeSearch(depth=4)),
    "tree 2, poses refined": _always(lambda: TreeSearch(depth=2, refine_poses=True)),
    "cross-entropy": _always(CrossEntropy),
    "cma-es": _always(CmaEs),
}
"""What is compared: planners for a budget, in times what greedy spends, by the name that the tables
have. One more is entered by `--planner`."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A planner on an instance."""

    instance: Instance
    planner: str
    budget: int  # in times what greedy spends
    seed: int

    @property
    def name(self) -> str:
        """As file names have it."""
        planner = self.planner.replace(",", "").replace(" ", "-").replace(":", "-")
        return f"{self.instance.name}.{planner}.{self.budget}.{self.seed}"


def runs(preset: str, planners: Sequence[str]) -> list[Run]:
    """All runs of a preset, those that tell most first: any part of them is a fair picture."""
    if preset == "smoke":
        return [
            Run(Instance("prism 0", SMOKE_JOB, SITES[0]), planner, 1, 0) for planner in planners
        ]
    places = itertools.product(PILES, JOBS, SITES, planners, BUDGETS, SEEDS)
    found = [
        Run(Instance(pile, job, site), planner, budget, seed)
        for pile, job, site, planner, budget, seed in places
        if job == "trucks" or site != EACH
    ]
    return sorted(found, key=_rank)


def _rank(run: Run) -> int:
    """How little a run adds to what those of lower rank tell."""
    pile, place = run.instance.pile, (run.instance.job, run.instance.site)
    of_pile = 2 * int(pile.split()[1]) if pile.startswith("prism") else int(pile == "wedge")
    of_place = _PLACES.get(place, 6)
    of_planner = _PLANNERS.get(run.planner, 2)
    # What greedy spends is too little for most that look ahead.
    first = 1 if run.planner.startswith("greedy") else 10
    of_budget = 0 if run.budget == first else {1: 2, 10: 2, 100: 6}[run.budget]
    return of_pile + of_place + of_planner + of_budget + 3 * run.seed


def place_truck(instance: Instance, seed: int, folder: Path) -> Receiver | None:
    """Where the truck stands if it is free: at one place for all planners; None if it is not.

    Args:
        instance: Pile, job and site.
        seed: Of the search.
        folder: Where places are kept.
    """
    if not instance.is_free:
        return None
    path = folder / f"{instance.name}.{seed}.json"
    pile = instance.load_pile()
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        site = instance.site_of(pile)
        amount = instance.amount.of(pile, site.soil)
        first = amount.part(Made(), typical_load(site))
        assert first is not None
        job = make_job(
            wlplan.load_world("hybrid"),
            pile,
            site=site,
            objective=amount.objective,
            amount=first[0],
        )
        found = best_place(with_toe(job), site, first[1], seed=seed, watch=Watch())
        place = [float(value) for value in jax.tree.leaves(found)]
        write_text_atomic(path, json.dumps(place))
    return Receiver(*(jnp.asarray(v, pile.height.dtype) for v in json.loads(path.read_text())))


def made_with(run: Run, planner: Planner) -> dict[str, str]:
    """What a row hangs on; one that was made with anything else is made anew."""
    return {
        **of_package(),
        "planner": repr(planner),
        "amount": repr(run.instance.amount),
        "efforts": json.dumps(EFFORTS),
    }


def play_run(
    run: Run, planner: Planner, of_greedy: float | None, receiver: Receiver | None = None
) -> dict[str, Any]:
    """Plans and plays one run.

    Args:
        run: Which one.
        planner: Its planner.
        of_greedy: What a row of a plan takes greedy; None: this is greedy's own.
        receiver: Where the loader dumps, if the truck is free.

    Returns:
        The row; `plan` is None where the budget does not suffice for one.
    """
    pile = run.instance.load_pile()
    site = run.instance.site_of(pile)
    if receiver is not None:
        site = site.replace(receiver=receiver)
    row: dict[str, Any] = {**dataclasses.asdict(run.instance), "planner": run.planner}
    row |= {"budget": run.budget, "seed": run.seed}
    hybrid, simulator = wlplan.load_world("hybrid"), wlplan.load_world("simulator")
    ratio = None if of_greedy is None else float(run.budget)
    in_referee = run.planner.endswith(IN_REFEREE)
    within = Within(planner, ratio, of_greedy, referee=simulator, in_referee=in_referee)
    try:
        with Stopwatch() as planning:
            result = wlplan.plan_loads(
                hybrid,
                pile,
                amount=run.instance.amount,
                site=site,
                planner=within,
                truck="each" if run.instance.site == EACH else None,
                seed=run.seed,
                referee=simulator,
                mend=False,
            )
            jax.block_until_ready(result.cost)
    except OverBudget:
        return {**row, "plan": None}
    assert result.refereed is not None
    assert result.receiver is not None
    row |= {"spent": within.spent, "searches": within.searches, "rows": within.rows}
    row["seconds"] = planning.seconds - planning.compiling
    # What was planned in the referee is foreseen by the world that planned it only afterwards.
    row["predicted"] = float(result.cost) if in_referee else within.predicted
    row["simulator"] = _summary(result.refereed)
    # What the simulator would have picked of the best few plans; of a job of one part.
    row["picked"] = _summary(within.picked[0]) if len(within.picked) == 1 else None
    row["plan"] = {
        "poses": np.stack(jax.tree.leaves(result.plan.pose), axis=-1).round(4).tolist(),
        "actions": np.stack(jax.tree.leaves(result.plan.action), axis=-1).round(5).tolist(),
        "trucks": None if result.plan.truck is None else np.asarray(result.plan.truck).tolist(),
        "receiver": [np.round(v, 4).tolist() for v in jax.tree.leaves(result.receiver)],
    }
    return row


def _summary(played: wlplan.PlanResult) -> dict[str, float]:
    performance, transport = jax.tree.map(
        lambda leaf: np.asarray(leaf, float), (played.rollout.performance, played.transport)
    )
    return {
        "cost": float(played.cost),
        "loads": len(performance.mass),
        "mass": float(performance.mass.sum()),
        "time": float((performance.time + transport.time + transport.wait).sum()),
        "work": float((performance.work + transport.work).sum()),
        "stalls": int((performance.time > _STALL).sum()),
        "touching": float(transport.touching.sum()),
        "misfit": float(np.sum(played.misfit)),
        "missing": float(played.missing),
    }


def work(
    todo: Sequence[Run],
    rows: RowFiles,
    planners: dict[str, Callable[[int], Planner]],
    is_up: Callable[[], bool],
) -> None:
    """Makes the rows that are not there yet, and that no other process is making.

    Args:
        todo: Runs in order.
        rows: Of the runs.
        planners: By name.
        is_up: Whether no further run is to be begun.
    """
    pile = None
    for number, run in enumerate(todo):
        if is_up():
            return
        # Maps of other extents have programs of their own, which would add up to many gigabytes.
        if run.instance.pile != pile:
            jax.clear_caches()
            pile = run.instance.pile
        planner = planners[run.planner](run.budget)
        if rows.read(run.name, made_with(run, planner)) is not None:
            continue
        of_greedy = None
        # What greedy takes is the unit, in the simulator too: there it takes a little more.
        if (run.planner, run.budget) not in BASES:
            base = dataclasses.replace(run, planner="greedy", budget=1)
            work([base], rows, planners, is_up)
            made = made_with(base, planners[base.planner](base.budget))
            if (row := rows.read(base.name, made)) is None:
                # The time is up, or another process is at it.
                continue
            of_greedy = row["spent"] / row["rows"]

        def make(
            run: Run = run, planner: Planner = planner, of_greedy: float | None = of_greedy
        ) -> dict[str, Any]:
            receiver = place_truck(run.instance, run.seed, rows.folder / "places")
            return play_run(run, planner, of_greedy, receiver)

        if (row := rows.get(run.name, made_with(run, planner), make)) is not None:
            said = {name: value for name, value in row.items() if name != "plan"}
            say(f"{number + 1}/{len(todo)} {json.dumps(said)}")


def run(preset: str, rows: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """The result that rows come to.

    Args:
        preset: Of which they are a part.
        rows: Of the runs that were made.
    """
    compared = [row for row in rows if row["plan"] is not None]
    total = sum(1 for _ in runs(preset, tuple(PLANNERS)))
    return {
        "runs": len(rows),
        "runs_of_the_preset": total,
        "runs_with_other_settings": sum(not _of_today(row) for row in rows),
        "without_a_plan": sorted(
            {f"{row['planner']} at {row['budget']}" for row in rows if row["plan"] is None}
        ),
        "steps": steps(compared, STEPS),
        "looking_ahead": looking_ahead(compared),
        "planners": by_planner(compared),
        "rows": [
            {k: v for k, v in row.items() if k != "plan"} | {"of_today": _of_today(row)}
            for row in compared
        ],
    }


def unpack(result: Path, made: RowFiles) -> None:
    """Lays the rows of a committed result where rows are kept, so that none is made twice.

    Their plans are not kept, but for the best, see `BEST`.

    Args:
        result: JSON that `run` came to; nothing is done if it is not there.
        made: The rows; what is there is left as it is.
    """
    if not result.exists():
        return
    rows = {}
    for row in json.loads(result.read_text())["rows"]:
        instance = Instance(row["pile"], row["job"], row["site"])
        rows[Run(instance, row["planner"], row["budget"], row["seed"]).name] = {**row, "plan": {}}
    made.lay(rows)


def _of_today(row: dict[str, Any]) -> bool:
    """Whether a row was made with the settings that its planner has today."""
    planner = PLANNERS.get(row["planner"])
    return planner is None or row["made_with"]["planner"] == repr(planner(row["budget"]))


def draw(folder: Path) -> None:
    """Gain of each planner against what it evaluates and against the time that takes."""
    table = json.loads((folder / "planner_benchmark.json").read_text())["planners"]
    jobs = [job for job in JOBS if any(row["job"] == job for row in table)] or [SMOKE_JOB]
    figure = new_figure(2.6 * len(jobs) + 1.2, 5.4)
    panels = figure.subplots(2, len(jobs), sharey="col", squeeze=False)
    names = list(dict.fromkeys(row["planner"] for row in table if row["planner"] != "greedy"))
    colours = {
        name: ORANGE if name.endswith(IN_REFEREE) else GREEN if "tree" in name else BLUE
        for name in names
    }
    marks = {name: "osD^vP*Xdph<>8"[k % 14] for k, name in enumerate(names)}
    for column, job in zip(panels.T, jobs, strict=True):
        # Of trucks and tonnes a cost is mostly what is missing: time says more.
        what = "cost" if "loads" in job else "seconds_a_tonne"
        of_job = [row for row in table if row["job"] == job and row["planner"] != "greedy"]
        for panel, measure in zip(column, ("spent", "search"), strict=True):
            for row in of_job:
                if row[measure] is not None:
                    panel.plot(
                        row[measure],
                        row[what]["mean"],
                        marker=marks[row["planner"]],
                        ms=5,
                        color=colours[row["planner"]],
                        # Empty where the truck stands where the planner wants it.
                        fillstyle="full" if row["site"] in ("fixed truck", "walls") else "none",
                    )
            panel.axhline(0.0, color=FAINT, lw=0.8)
            panel.set_xscale("log")
            panel.xaxis.set_major_locator(LogLocator(10.0, (1.0, 3.0)))
            panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
            panel.xaxis.set_minor_formatter(NullFormatter())
            low, high = panel.get_ylim()
            panel.set_ylim(max(low, -12.0), min(high, 30.0))
            tidy(panel)
            panel.tick_params(labelsize=7)
        column[0].set_title(job, fontsize=9)
        less = "cost" if what == "cost" else "time a tonne"
        column[0].set_ylabel(f"{less}, less than greedy's [%]", fontsize=8)
        column[1].set_ylabel(f"{less}, less than greedy's [%]", fontsize=8)
        column[0].set_xlabel("evaluations, in loadings", fontsize=8)
        column[1].set_xlabel("search, without compiling [s]", fontsize=8)
    handles = [panels[0, 0].plot([], [], marks[n], color=colours[n], ms=5)[0] for n in names]
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    write_bytes_atomic(folder / "planner_benchmark.png", png_bytes(figure))


def main() -> None:
    """Command line: plan and play, join what was played, or draw."""
    parser = argparse.ArgumentParser(prog="python -m experiments.planner_benchmark")
    add_places(parser)
    add_row_options(parser, ROWS)
    parser.add_argument("--planner", action="append", default=[], metavar="MODULE:NAME")
    options = parser.parse_args()
    try:
        folder = folder_of(options)
        if options.draw:
            redraw("planner_benchmark", draw, folder)
        else:
            _make(options, folder)
            draw(folder)
    except InputError as error:
        say(f"error: {error}")
        raise SystemExit(2) from error


def _make(options: argparse.Namespace, folder: Path) -> None:
    """Makes the runs that are asked for, and joins all that are there."""
    made = RowFiles(options.rows or (folder / ROWS.name if options.preset == "smoke" else ROWS))
    say(f"planner_benchmark: runs in {made.folder}; the result goes to {folder}")
    if options.preset != "smoke":
        unpack(RESULTS / "planner_benchmark.json", made)
    planners = PLANNERS | {name: _always(load_object(name)) for name in options.planner}
    chosen = tuple(SMOKE if options.preset == "smoke" else planners)
    if not options.join:
        todo = matching(runs(options.preset, chosen), options.only)
        shown = SMOKE if options.preset == "smoke" else planners
        # All of an instance go to one machine, which then has what they are compared with.
        places = list(dict.fromkeys((run.instance, run.seed) for run in todo))
        mine = set(part_of(places, options.shard))
        mine_alone = [r for r in todo if (r.instance, r.seed) in mine]
        work(mine_alone, made, shown, time_is_up(options))
    rows = [row for row in made.all() if of_package().items() <= row["made_with"].items()]
    # The best plans known so far: those in the folder, or else the committed ones.
    committed = [] if options.preset == "smoke" else [RESULTS / BEST]
    known = next((path for path in (folder / BEST, *committed) if path.exists()), None)
    lines = ",\n".join(
        json.dumps(one)
        for one in best_plans(rows, [] if known is None else json.loads(known.read_text()))
    )
    write_text_atomic(folder / BEST, f"[{lines}]\n")
    result = run(options.preset, rows)
    write_result("planner_benchmark", options.preset, result, folder)
    write_text_atomic(folder / "planner_benchmark.md", tables(result))


# Few trials each: whether all goes through, and not what it comes to.
_FEW = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3)
SMOKE: dict[str, Callable[[int], Planner]] = {
    "greedy": _always(lambda: _FEW),
    "tree 1": _always(lambda: TreeSearch(depth=1, actions=6, refine_steps=2, poses_per_metre=0.3)),
    "gradient": _always(lambda: Gradient(iterations=1, starts=2, start=_FEW)),
}

if __name__ == "__main__":
    main()
