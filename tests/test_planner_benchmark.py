"""What the benchmark of planners rests on: budgets, pairs, intervals, walls."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cones import SITE, circle, cone, spoilt_world

from experiments import planner_benchmark as benchmark
from experiments._common import comparison
from experiments._common.benchmark_tables import tables
from experiments._common.budgets import OverBudget, Within
from experiments._common.instances import Instance
from experiments._common.row_files import RowFiles, part_of
from wlplan.planning.amounts import Loads
from wlplan.planning.job import Job, make_job, with_toe
from wlplan.planning.planners import Greedy, RandomSearch
from wlplan.planning.playing import outcomes
from wlplan.planning.proposals import Planner
from wlplan.planning.watch import Watch

GREEDY = Greedy(poses_per_metre=0.5, actions=12, refined=4, refine_steps=20)
RANDOM = RandomSearch(plans=8, batch=4, candidates=2)


def job() -> Job:
    asked = make_job(spoilt_world, cone(), site=SITE, amount=Loads(2))
    return with_toe(asked, circle())


def row(
    pile: str, planner: str, budget: int, seed: int, cost: float, **more: Any
) -> dict[str, Any]:
    played = {"cost": cost, "loads": 15, "mass": 60.0, "time": 600.0, "work": 1e4}
    place = {"pile": pile, "job": "15 loads", "site": "walls"}
    of = {"planner": planner, "budget": budget, "seed": seed, "predicted": cost}
    return {**place, **of, "simulator": played, "picked": None, "plan": {"poses": []}, **more}


def test_a_budget_is_spent_and_kept() -> None:
    asked, watch = job(), Watch()
    RANDOM.propose(asked, 2, seed=0, progress=watch)
    once = watch.spent
    within = Within(RANDOM, 5.0, once / 2)
    plans = within.propose(asked, 2, seed=0)
    assert within.searches >= 5
    assert 0.98 * 5.0 * once <= within.spent <= 5.0 * once + once
    assert within.predicted == pytest.approx(float(outcomes(asked, plans.candidates).cost[0]))
    few = Within(RANDOM, 1.0, once / 2)
    few.propose(asked, 2, seed=0)
    assert within.predicted <= few.predicted


@pytest.mark.slow
def test_half_a_plan_is_none() -> None:
    asked, watch = job(), Watch()
    GREEDY.propose(asked, 2, seed=0, progress=watch)
    with pytest.raises(OverBudget):
        Within(GREEDY, 0.5, watch.spent / 2).propose(asked, 2, seed=0)


def test_pairs_are_of_one_instance_and_seed() -> None:
    rows = [
        row("cone", "greedy", 1, 0, 50.0),
        row("cone", "greedy", 1, 1, 40.0),
        row("cone", "cma-es", 10, 0, 49.0),
        row("cone", "cma-es", 10, 1, 41.0),
        row("cone", "cma-es", 10, 2, 1.0),
        row("cone", "cma-es", 1, 0, 1.0),
    ]
    found = comparison.gains(
        rows, comparison.Case("walls", "cma-es", 10), comparison.Case("walls", "greedy", 1)
    )
    assert [key[-1] for key, _ in found] == [0, 1]
    np.testing.assert_allclose([one["cost"] for _, one in found], [2.0, -2.5])
    np.testing.assert_allclose([one["seconds_a_tonne"] for _, one in found], 0.0)


def test_steps_are_of_piles_that_have_all_of_them() -> None:
    first, second = comparison.Case("walls", "greedy", 1), comparison.Case("walls", "x", 10)
    rows = [
        row("cone", "greedy", 1, 0, 50.0),
        row("cone", "x", 10, 0, 45.0),
        row("ridge", "greedy", 1, 0, 10.0),
    ]
    found = comparison.steps(rows, (first, second, comparison.Case("walls", "y", 10)))
    assert [(one["planner"], one["pairs"]) for one in found] == [("greedy", 1), ("x", 1)]
    assert [one["cost"]["mean"] for one in found] == pytest.approx([0.0, 10.0])
    assert comparison.steps(rows, (comparison.Case("walls", "y", 10), first)) == []


def test_looking_ahead_is_beside_greedy_that_has_as_much() -> None:
    marked = comparison.IN_REFEREE
    rows = [
        row("cone", "greedy", 1, 0, 50.0),
        row("cone", f"greedy{marked}", 1, 0, 45.0),
        row("cone", "tree", 10, 0, 49.0),
        row("cone", "nominal", 10, 0, 1.0),
        row("cone", f"iterated{marked}", 10, 0, 36.0),
    ]
    found = comparison.looking_ahead(rows)
    assert [(one["planner"], one["base"]) for one in found] == [
        ("tree", "greedy"),
        (f"iterated{marked}", f"greedy{marked}"),
    ]
    assert [one["cost"]["mean"] for one in found] == pytest.approx([2.0, 20.0])


def test_an_interval_is_over_piles() -> None:
    """Student's interval of the means 1, 2 and 6, whatever the number of seeds."""
    of = [
        (("a", "", 0), {"cost": 0.0}),
        (("a", "", 1), {"cost": 2.0}),
        (("b", "", 0), {"cost": 2.0}),
        (("c", "", 0), {"cost": 6.0}),
    ]
    found = comparison.interval(of, "cost")
    assert found["piles"] == 3
    assert found["mean"] == pytest.approx(3.0)
    # 4.3027 is the quantile of two degrees of freedom, the deviation of the means is sqrt(7).
    assert found["half"] == pytest.approx(4.3027 * math.sqrt(7.0 / 3.0), rel=1e-4)
    assert comparison.interval(of[:2], "cost")["half"] is None


def test_the_best_plan_known_is_kept() -> None:
    before = [row("cone", "greedy", 1, 0, 50.0), row("ridge", "greedy", 1, 0, 30.0)]
    known = comparison.best_plans(before, [])
    again = comparison.best_plans(
        [row("cone", "cma-es", 10, 0, 49.0), row("ridge", "cma-es", 10, 0, 31.0)], known
    )
    assert [(one["pile"], one["simulator"]["cost"]) for one in again] == [
        ("cone", 49.0),
        ("ridge", 30.0),
    ]
    assert comparison.best_plans([row("cone", "x", 1, 0, 1.0, plan=None)], known) == known


def test_shards_share_the_runs_out() -> None:
    runs = benchmark.runs("full", tuple(benchmark.PLANNERS))
    names = [run.name for run in runs]
    assert len(set(names)) == len(names)
    parts = [part_of(runs, (k, 3)) for k in (1, 2, 3)]
    assert sorted(run.name for part in parts for run in part) == sorted(names)
    assert runs[0].planner == "greedy"


def test_what_was_run_is_run_again_only_with_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run,) = [one for one in benchmark.runs("smoke", ("greedy",))]
    place = tmp_path / f"{run.name}.json"
    row = {"kept": True, "made_with": benchmark.made_with(run, GREEDY)}
    place.write_text(json.dumps(row))
    rows = RowFiles(tmp_path)
    of: dict[str, Callable[[int], Planner]] = {run.planner: lambda budget: GREEDY}
    benchmark.work([run], rows, of, lambda: False)
    assert json.loads(place.read_text()) == row
    other: dict[str, Callable[[int], Planner]] = {run.planner: lambda budget: RANDOM}
    monkeypatch.setattr(benchmark, "play_run", lambda *_: {"anew": True})
    benchmark.work([run], rows, other, lambda: True)
    assert json.loads(place.read_text()) == row
    benchmark.work([run], rows, other, lambda: False)
    assert json.loads(place.read_text()) == {
        "anew": True,
        "made_with": benchmark.made_with(run, RANDOM),
    }


@pytest.mark.parametrize(
    "name", ["cone", *(pytest.param(one, marks=pytest.mark.slow) for one in ("prism 0", "bundled"))]
)
def test_walls_stand_around_the_soil_and_leave_the_west_open(name: str) -> None:
    instance = Instance(name, "15 loads", "walls")
    pile = instance.load_pile()
    walls = np.asarray(instance.site_of(pile).keep_out)
    soil = np.asarray(pile.height - pile.floor) > 0.25
    assert walls.any()
    rows, columns = np.nonzero(soil)
    # East of the soil, and north and south of it, a wall is met; west of it none.
    for i, j in zip(rows[::997], columns[::997], strict=True):
        assert walls[i:, j].any()
        assert walls[i, :j].any()
        assert walls[i, j:].any()
        assert not walls[:i, j].any()
    assert not instance.is_free
    assert dataclasses.replace(instance, site="walls, free truck").is_free


def test_the_tables_have_means_over_seeds_and_a_dash_for_what_was_not_run() -> None:
    played = {"stalls": 0, "missing": 0.0, "misfit": 0.0, "touching": 0.0}
    rows = [
        row("cone", "greedy", 1, 0, 40.0, seconds=3.0),
        row("cone", "greedy", 1, 1, 44.0, seconds=5.0),
        row("ridge", "greedy", 1, 0, 50.0, seconds=4.0),
        row("cone", "iterated greedy, in the simulator", 10, 0, 39.0, seconds=30.0),
    ]
    for one in rows:
        one["spent"] = 100.0
        one["simulator"] |= played
        one["made_with"] = {"planner": repr(Greedy())}
    result = benchmark.run("full", rows)
    lines = tables(result).splitlines()
    assert "| walls | greedy | 1 | 42.00 / 42.00 | 50.00 / 50.00 | 1–2 | 4 |" in lines
    assert "| walls | iterated greedy, in the simulator * | 10 | 39.00 | – | 1 | 30 |" in lines
    assert not any("nan" in line for line in lines)
    # Greedy today; the other one never had such settings.
    assert result["runs_with_other_settings"] == 1


def test_what_was_committed_is_not_made_again(tmp_path: Path) -> None:
    (run,) = [one for one in benchmark.runs("smoke", ("greedy",))]
    of = {**dataclasses.asdict(run.instance), "planner": "greedy", "budget": 1, "seed": 0}
    rows = [{**of, "predicted": 1.0, "made_with": benchmark.made_with(run, GREEDY)}]
    result, folder = tmp_path / "result.json", tmp_path / "rows"
    result.write_text(json.dumps({"rows": rows}))
    benchmark.unpack(result, RowFiles(folder))
    found = RowFiles(folder).read(run.name, benchmark.made_with(run, GREEDY))
    assert found == {**rows[0], "plan": {}}
    # What was made since stays.
    (folder / f"{run.name}.json").write_text("{}")
    benchmark.unpack(result, RowFiles(folder))
    assert RowFiles(folder).all() == [{}]
    benchmark.unpack(tmp_path / "none.json", RowFiles(tmp_path / "none"))
    assert not (tmp_path / "none").exists()
