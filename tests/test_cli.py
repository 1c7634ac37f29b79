"""The command line: results on stdout, one line on stderr for whatever is wrong, whole files."""

import contextlib
import dataclasses
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import jax.numpy as jnp
import numpy as np
import pytest
from areas import features, square
from matplotlib.figure import Figure
from pages import Page

from wlplan import cli, dataset, io
from wlplan.cli import planning
from wlplan.errors import InputError
from wlplan.io.files import is_ours
from wlplan.io.upright import TURNS
from wlplan.planning import objective
from wlplan.planning import plan as planner
from wlplan.planning.amounts import Loads, amount_fields
from wlplan.planning.loading import Transport
from wlplan.planning.placement import place_of
from wlplan.planning.playing import PlanResult
from wlplan.planning.truck_area import stands_inside
from wlplan.report import figures as plots
from wlplan.report import page as report
from wlplan.site.frame import Frame
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.site import Site
from wlplan.site.soil import GRAVEL, SAND, Soil
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose, Rollout
from wlplan.worlds import shipped as worlds

# Exit code, stdout and stderr of words of the command line.
Run = Callable[..., tuple[int, str, str]]

FILES = ["plan.json", "plan.png", "report.html", "totals.png"]
# An older file of ours.
OLD = '{"format": "wlplan.plan/1"}'


class FakeWorld:
    """A world of simple numbers; `fake_play` says what a whole plan does in it."""

    def __init__(self, factor: float, soil: Soil = GRAVEL) -> None:
        self.factor, self.soil = factor, soil

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile as it was."""
        mass = 2.0 * self.factor + 0.0 * pose.x
        performance = Performance(mass, 10.0 + action.k_bm, 300.0 + pose.x)
        return pile, performance


def fake_play(
    world: FakeWorld, pile: Pile, plan: LoadingPlan, site: Site | None = None, **_: object
) -> PlanResult:
    count = len(plan.pose.x)
    mass = jnp.asarray(world.factor * np.linspace(1.0, 3.0, count), jnp.float32)
    height = np.asarray(pile.height, np.float64)
    lost = float(mass.sum()) / (world.soil.density / 1000.0) / pile.cell_size**2
    after = pile.replace(height=jnp.asarray(height - lost * height / height.sum(), jnp.float32))
    performance = Performance(mass, jnp.full(count, 10.0), jnp.full(count, 300.0))
    return PlanResult(
        plan=plan,
        rollout=Rollout(performance, after),
        transport=Transport(jnp.full(count, 20.0), jnp.full(count, 100.0)),
        terms={},
        receiver=None if site is None else site.receiver,
        costs=jnp.full(count, 1.0),
        cost=jnp.asarray(float(count)) / world.factor,
    )


@pytest.fixture
def calls() -> list[dict[str, Any]]:
    """Arguments of the calls of the planner, in order."""
    return []


@pytest.fixture
def asked() -> list[tuple[str, Soil, WheelLoader]]:
    """Worlds that were asked for: name, soil, machine."""
    return []


@pytest.fixture
def real_figures() -> None:
    """Asked for by the tests that want them."""


@pytest.fixture(autouse=True)
def fakes(
    monkeypatch: pytest.MonkeyPatch,
    calls: list[dict[str, Any]],
    asked: list[tuple[str, Soil, WheelLoader]],
    request: pytest.FixtureRequest,
) -> None:
    """Stand-ins for what takes long; the pile and the files are real."""

    def plan_loads(
        world: FakeWorld,
        pile: Pile,
        *,
        amount: Any,
        progress: Callable[..., None],
        **options: Any,
    ) -> PlanResult:
        loads = int(amount.count) if isinstance(amount, Loads) else 2
        calls.append({"loads": loads, "amount": amount, **options})
        pose = edge_poses(toe_contour(pile), loads)
        plan = LoadingPlan(
            Pose(*(jnp.asarray(v, jnp.float32) for v in (pose.x, pose.y, pose.heading))),
            Action(*(jnp.full(loads, value) for value in (0.5, 2.0, 0.5, 2.0))),
        )
        for done in range(loads):
            progress("steps", done + 1, loads, 3.0)
        return fake_play(world, pile, plan, options["site"])

    def load_world(
        name: str,
        *,
        model: str | None = None,
        pile_state: str | None = None,
        soil: Soil = GRAVEL,
        machine: WheelLoader = WA320,
    ) -> FakeWorld:
        asked.append((name, soil, machine))
        if name in ("high", "low"):
            raise InputError(f"the {name} world\nis not there yet; use hybrid")
        return FakeWorld(1.0 if name == "simulator" else 1.1, soil)

    monkeypatch.setattr(planner, "plan_loads", plan_loads)
    monkeypatch.setattr(planner, "play", fake_play)
    monkeypatch.setattr(worlds, "load_world", load_world)
    if "real_figures" not in request.fixturenames:
        for name in (one for one in plots.__all__ if one.endswith("_figure")):
            monkeypatch.setattr(plots, name, lambda *_, **__: Figure(figsize=(1.0, 1.0)))


@pytest.fixture
def scan(tmp_path: Path) -> str:
    """A pile file."""
    path = tmp_path / "scan.npz"
    io.write_pile(path, seed_pile("conical", slope=math.radians(30.0), height=2.0, seed=1))
    return str(path)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command line; returns exit code, stdout and stderr."""

    def run_words(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.main([str(word) for word in words])
        return code, *capsys.readouterr()

    return run_words


def refused(result: tuple[int, str, str], *words: str) -> str:
    code, out, err = result
    assert code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    for word in words:
        assert word in err
    return err


def strict_json(text: str) -> dict[str, Any]:
    def fail(constant: str) -> NoReturn:
        raise AssertionError(f"{constant} in JSON")

    document: dict[str, Any] = json.loads(text, parse_constant=fail)
    return document


# --- plan


def test_a_plan_is_written_with_figures_and_report(
    run: Run, scan: str, tmp_path: Path, real_figures: None
) -> None:
    code, out, err = run("plan", scan, "--loads", 3, "--out", tmp_path / "out")
    assert code == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    assert "predicted" in out
    assert "simulated" in out
    assert "compiling" in out
    for unit in ("[t]", "[s]", "[kJ]", "[m]"):
        assert unit in out
    assert "report.html" in out
    assert sorted(planning._FILES) == FILES
    assert all(is_ours(tmp_path / "out" / name) for name in FILES)
    assert "error" not in err
    assert (tmp_path / "out" / "plan.png").read_bytes()[:4] == b"\x89PNG"
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_json_on_stdout_is_plan_json_and_nothing_else(run: Run, scan: str, tmp_path: Path) -> None:
    code, out, err = run("plan", scan, "--loads", 2, "--json", "--out", tmp_path / "out")
    assert code == 0
    assert out == (tmp_path / "out" / "plan.json").read_text()
    assert "steps" in err


def test_plan_json_holds_what_the_contract_says(run: Run, scan: str) -> None:
    code, out, _ = run("plan", scan, "--loads", 3, "--seed", 5, "--truck", "-12,1,30", "--json")
    document = strict_json(out)
    assert code == 0
    assert document["format"] == "wlplan.plan/1"
    assert (document["world"], document["objective"], document["seed"]) == (
        "hybrid",
        "efficiency",
        5,
    )
    assert document["pile"]["file"] == scan
    assert document["receiver"]["heading"] == pytest.approx(math.radians(30.0))
    assert len(document["loads"]) == 3
    for load in document["loads"]:
        assert set(load) == {"x", "y", "heading", "action", "predicted", "transport", "simulated"}
        assert set(load["action"]) == {"delta_bm", "k_bm", "delta_bk", "k_bk"}
        assert set(load["predicted"]) == set(load["simulated"]) == {"mass", "time", "work"}
        assert set(load["transport"]) == {"time", "work"}
    for part in ("predicted", "simulated"):
        total = document["total"][part]
        for name in ("mass", "time", "work"):
            want = sum(load[part][name] for load in document["loads"])
            assert total[name] == pytest.approx(want, rel=1e-6)
        assert math.isfinite(total["cost"])
    ledger = document["ledger"]
    lost = ledger["density"] * (ledger["volume_before"] - ledger["volume_after"])
    assert ledger["mass_removed"] == pytest.approx(lost, rel=1e-4)
    assert ledger["mass_removed"] == pytest.approx(document["total"]["simulated"]["mass"])


def test_the_options_reach_the_planner(run: Run, scan: str, calls: list[dict[str, Any]]) -> None:
    options = ("--loads", 2, "--planner", "greedy", "--objective", "energy", "--seed", 7)
    run("plan", scan, *options, "--truck", "-10,0")
    (call,) = calls
    assert (call["loads"], call["planner"], call["seed"]) == (2, "greedy", 7)
    assert call["objective"] == objective.objective_of("energy")
    receiver = call["site"].receiver
    assert float(receiver.x) == -10.0
    # Without a heading the one that suits: the truck does not stand between loader and pile.
    assert math.cos(float(receiver.heading)) < 0.9


@pytest.mark.parametrize(
    ("options", "amount", "objective_name"),
    [
        ((), {"amount": "loads", "count": 15}, "efficiency"),
        (("--tonnes", 80), {"amount": "tonnes", "mass": 80.0}, "delivery"),
        (
            ("--trucks", 2, "--payload", 24, "--exchange", 40),
            {"amount": "trucks", "count": 2, "payload": 24.0, "exchange": 40.0}
            | {"tolerance": 0.05, "limit": 1.1},
            "delivery",
        ),
        (("--empty",), {"amount": "empty", "remaining": 0.02, "least": 0.8}, "delivery"),
        (
            ("--empty", "--remaining", 10, "--objective", "energy"),
            {"amount": "empty", "remaining": 0.1, "least": 0.8},
            "energy",
        ),
    ],
)
def test_an_amount_reaches_the_planner_and_the_plan(
    run: Run,
    scan: str,
    calls: list[dict[str, Any]],
    options: tuple[Any, ...],
    amount: dict[str, Any],
    objective_name: str,
) -> None:
    code, out, _ = run("plan", scan, *options, "--json")
    assert code == 0
    assert amount_fields(calls[0]["amount"]) == amount
    document = json.loads(out)
    assert document["job"] == amount
    assert document["objective"] == objective_name


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--loads", 2, "--tonnes", 9), "--loads and --tonnes do not go together"),
        (("--trucks", 2), "--trucks K and --payload T go together"),
        (("--payload", 20), "--trucks K and --payload T go together"),
        (("--exchange", 20), "--exchange goes with --trucks"),
        (("--remaining", 20), "--remaining goes with --empty"),
        (("--tonnes", "nan"), "--tonnes"),
        (("--trucks", 0, "--payload", 9), "--trucks"),
    ],
)
def test_amounts_that_do_not_go_together_are_one_line(
    run: Run, scan: str, options: tuple[Any, ...], told: str
) -> None:
    code, out, err = run("plan", scan, *options)
    assert (code, out) == (2, "")
    assert told in err
    assert err.count("\n") == 1


def test_a_truck_may_be_left_to_the_planner(
    run: Run, scan: str, calls: list[dict[str, Any]]
) -> None:
    assert run("plan", scan, "--loads", 1, "--truck", "auto")[0] == 0
    assert run("plan", scan, "--loads", 1)[0] == 0
    assert run("plan", scan, "--trucks", 2, "--payload", 9, "--truck", "each")[0] == 0
    assert [call["truck"] for call in calls] == ["auto", None, "each"]
    refused(run("plan", scan, "--loads", 1, "--truck", "all"), "auto|each")


def test_an_area_for_trucks_is_kept_to_and_recorded(
    run: Run, scan: str, tmp_path: Path, calls: list[dict[str, Any]], real_figures: None
) -> None:
    path = tmp_path / "trucks.geojson"
    path.write_text(features((square(-30.0, 7.0, 14.0), {})))
    area = ("--truck-area", path)
    assert run("plan", scan, "--loads", 1, *area, "--out", tmp_path / "out")[0] == 0
    place = place_of(calls[0]["site"].receiver)
    ring = np.array(square(-30.0, 7.0, 14.0))
    assert stands_inside(place[None], ((ring,),), WA320)[0]
    document = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert document["pile"]["truck_area"] == str(path)
    # Played again it is known from the plan, and holds for another place.
    again = ("simulate", scan, tmp_path / "out" / "plan.json")
    assert run(*again)[0] == 0
    elsewhere = ("--truck", "12,0,0")
    outside = run(*again, *elsewhere), run("plan", scan, *area, *elsewhere)
    path.write_text(features((square(-30.0, 7.0, 4.0), {})))
    small = run("plan", scan, *area)
    for (code, out, err), words in (
        *((told, "12.0, 0.0, heading 0°, does not stand inside the area") for told in outside),
        (small, "no truck, 7.0 m by 2.6 m, fits"),
    ):
        assert (code, out) == (2, "")
        # Notes on the scan come first.
        (line,) = [line for line in err.splitlines() if not line.startswith("note: ")]
        assert line.startswith("error: ")
        assert words in line


def test_an_interrupted_search_is_shown_written_and_told(
    run: Run, scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = planner.plan_loads
    monkeypatch.setattr(
        planner, "plan_loads", lambda *a, **o: whole(*a, **o).replace(stopped="interrupted")
    )
    code, out, err = run("plan", scan, "--loads", 2, "--out", tmp_path / "out")
    assert code == 130
    assert "2 loads from" in out
    assert "note: the search was ended early, by hand: this is the best by then" in err
    assert (tmp_path / "out" / "plan.json").exists()


def test_without_a_pile_the_bundled_one_is_planned(run: Run) -> None:
    code, out, _ = run("plan", "--loads", 1, "--json")
    assert code == 0
    assert "bundled" in json.loads(out)["pile"]["file"]


def test_a_plan_in_the_simulator_predicts_what_is_simulated(run: Run, scan: str) -> None:
    _, out, _ = run("plan", scan, "--loads", 2, "--world", "simulator", "--json")
    for load in json.loads(out)["loads"]:
        assert load["predicted"] == load["simulated"]


def test_other_files_in_the_folder_stay(run: Run, scan: str, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    (folder / "plan.json").write_text(OLD)
    assert run("plan", scan, "--loads", 1, "--out", folder)[0] == 0
    assert sorted(path.name for path in folder.iterdir()) == sorted([*FILES, "notes.txt"])
    assert (folder / "notes.txt").read_text() == "mine"
    assert "loads" in json.loads((folder / "plan.json").read_text())


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("command", ["plan", "simulate"])
def test_a_file_of_somebody_else_is_not_replaced(
    run: Run, scan: str, tmp_path: Path, command: str, name: str
) -> None:
    """Nor is anything else written beside it; and that is told before anything is computed."""
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / name).write_text("mine")
    words = (scan,) if command == "plan" else (scan, tmp_path / "none.json")
    refused(run(command, *words, "--out", folder), name, "not from wlplan")
    assert [path.name for path in folder.iterdir()] == [name]
    assert (folder / name).read_text() == "mine"


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize(
    ("stop", "code"), [(KeyboardInterrupt(), 130), (OSError(28, "No space left on device"), 2)]
)
def test_a_run_that_is_cut_short_leaves_nothing(
    run: Run,
    scan: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    exists: bool,
    stop: BaseException,
    code: int,
) -> None:
    folder = tmp_path / "out"
    if exists:
        folder.mkdir()
        (folder / "plan.json").write_text(OLD)

    def write_report(*_: object, **__: object) -> None:
        raise stop

    monkeypatch.setattr(report, "write_report", write_report)
    got, out, err = run("plan", scan, "--loads", 1, "--out", folder)
    assert got == code
    assert out == ""
    assert err.splitlines()[-1].startswith("error: ")
    if exists:
        assert [path.name for path in folder.iterdir()] == ["plan.json"]
        assert (folder / "plan.json").read_text() == OLD
    else:
        assert not folder.exists()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["scan.npz"]


def test_numbers_that_are_not_finite_are_refused(
    run: Run, scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: Any, **options: Any) -> PlanResult:
        result = fake_play(*arguments, **options)
        return result.replace(cost=jnp.asarray(jnp.nan))

    monkeypatch.setattr(planner, "play", broken)
    code, out, err = run("plan", scan, "--loads", 1, "--json", "--out", tmp_path / "out")
    assert code == 2
    assert out == ""
    assert "not finite" in err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_a_ledger_that_does_not_close_is_told(
    run: Run, scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def leaky(world: FakeWorld, pile: Pile, plan: LoadingPlan, **options: Any) -> PlanResult:
        result = fake_play(world, pile, plan, **options)
        return result.replace(rollout=Rollout(result.rollout.performance, pile))

    monkeypatch.setattr(planner, "play", leaky)
    code, _, err = run("plan", scan, "--loads", 1, "--out", tmp_path / "out")
    assert code == 0
    assert "note: the ledger" in err
    assert "does not close" in (tmp_path / "out" / "report.html").read_text()


def test_a_fault_of_ours_is_one_line_too(
    run: Run, scan: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def plan_loads(*_: object, **__: object) -> None:
        raise ZeroDivisionError("what\nelse")

    monkeypatch.setattr(planner, "plan_loads", plan_loads)
    code, out, err = run("plan", scan)
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert "what else" in err


# --- simulate


def test_a_written_plan_is_played_again(run: Run, scan: str, tmp_path: Path) -> None:
    run("plan", scan, "--loads", 3, "--truck", "-12,1,30", "--out", tmp_path / "out")
    path = tmp_path / "out" / "plan.json"
    code, out, _ = run("simulate", scan, path)
    assert code == 0
    assert "predicted" in out
    again, planned = (
        json.loads(run("simulate", scan, path, "--json")[1]),
        json.loads(path.read_text()),
    )
    assert again["receiver"] == pytest.approx(planned["receiver"])
    assert again["ledger"] == planned["ledger"]
    for part in ("predicted", "simulated"):
        assert again["total"][part] == pytest.approx(planned["total"][part])
        for one, two in zip(again["loads"], planned["loads"], strict=True):
            assert one[part] == pytest.approx(two[part])


def test_a_bare_plan_is_played_too(run: Run, scan: str, tmp_path: Path) -> None:
    action = {"delta_bm": 0.5, "k_bm": 2, "delta_bk": 0.5, "k_bk": 2}
    load = {"x": 3.0, "y": 0.0, "heading": 3.1, "action": action}
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({"format": "wlplan.plan/1", "loads": [load]}))
    code, out, _ = run("simulate", scan, path)
    assert code == 0
    assert "predicted" not in out
    document = strict_json(run("simulate", scan, path, "--json")[1])
    assert "predicted" not in document["total"]
    assert document["total"]["simulated"]["mass"] > 0.0


def test_a_plan_for_another_pile_is_told(run: Run, scan: str, tmp_path: Path) -> None:
    run("plan", "--loads", 1, "--out", tmp_path / "out")
    code, _, err = run("simulate", scan, tmp_path / "out" / "plan.json")
    assert code == 0
    assert "another pile" in err


def test_trucks_with_places_of_their_own_are_played_there(
    run: Run, scan: str, tmp_path: Path
) -> None:
    run("plan", scan, "--loads", 3, "--truck", "-12,1,30", "--out", tmp_path / "out")
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    places = [{"x": -12.0, "y": 1.0, "heading": 0.5}, {"x": 11.0, "y": -3.0, "heading": 3.0}]

    def played(trucks: list[dict[str, Any]]) -> tuple[dict[str, Any], str]:
        (tmp_path / "plan.json").write_text(json.dumps({**plan, "trucks": trucks}))
        code, out, _ = run("simulate", scan, tmp_path / "plan.json")
        assert code == 0
        return json.loads(run("simulate", scan, tmp_path / "plan.json", "--json")[1]), out

    document, out = played([{**places[0], "loads": [0, 1]}, {**places[1], "loads": [2]}])
    found = [{name: truck[name] for name in places[0]} for truck in document["trucks"]]
    for truck, place in zip(found, places, strict=True):
        assert truck == pytest.approx(place, abs=1e-5)
    assert document["receiver"] == pytest.approx(places[0], abs=1e-5)
    assert "truck 1: the loader dumps at -12.0, 1.0, heading 29°" in out
    assert "truck 2: the loader dumps at 11.0, -3.0, heading 172°" in out
    # Trucks without places stand at that of the plan.
    document, out = played([{"loads": [0, 1]}, {"loads": [2]}])
    assert {truck["x"] for truck in document["trucks"]} == {plan["receiver"]["x"]}
    assert "truck: the loader dumps at -12.0, 1.0, heading 30°" in out


def survey(folder: Path, name: str, west: float) -> Path:
    """A scan of one and the same cone at 355,998 east and 5,200,010 north, from `west` on."""
    x, y = np.meshgrid(west + 0.2 * np.arange(150), 5.2e6 + 0.2 * np.arange(110), indexing="ij")
    height = np.maximum(3.0 - 0.6 * np.hypot(x - 355_998.0, y - 5_200_010.0), 0.0)
    path = folder / name
    np.savez(path, height=height + 431.0, cell_size=0.2, origin=np.array([west, 5.2e6]))
    return path


def test_a_plan_lies_where_the_scan_does(run: Run, tmp_path: Path) -> None:
    """Two scans of a site whose local frames are a kilometre apart."""
    monday = survey(tmp_path, "monday.npz", 355_980.0)
    tuesday = survey(tmp_path, "tuesday.npz", 355_990.0)
    truck = ("--truck", "355980,5200007,30")
    code, out, _ = run("plan", monday, "--loads", 2, *truck, "--out", tmp_path / "out")
    assert code == 0
    assert "355" in out
    path = tmp_path / "out" / "plan.json"
    plan = json.loads(path.read_text())
    assert plan["frame"] == {"offset": [355_000.0, 5_200_000.0, 400.0], "crs": None}
    assert plan["receiver"]["x"] == pytest.approx(980.0)
    again = json.loads(run("simulate", tuesday, path, "--json")[1])
    assert again["frame"]["offset"] == [356_000.0, 5_200_000.0, 400.0]

    def places(document: Any) -> list[float]:
        return [part["x"] + document["frame"]["offset"][0] for part in document["loads"]]

    assert places(again) == pytest.approx(places(plan), abs=1e-3)
    assert again["receiver"]["x"] == pytest.approx(-20.0, abs=1e-3)
    html = (tmp_path / "out" / "report.html").read_text()
    assert "x 355980.00 m, y 5200007.00 m" in html
    assert f"{places(plan)[0]:.2f}" in html


def test_shortened_truck_coordinates_are_told(run: Run, tmp_path: Path) -> None:
    scan = survey(tmp_path, "a.npz", 355_980.0)
    code, out, err = run("plan", scan, "--loads", 1, "--truck", "980,7,30", "--json")
    assert code == 0
    assert "355980.0, 5200007.0" in err
    assert json.loads(out)["receiver"]["x"] == pytest.approx(980.0)


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ({"offset": [0, 0], "crs": None}, "three numbers"),
        ({"offset": [0, 0, 0], "crs": 4}, "three numbers"),
        ({"offset": [0, 0, 1e300], "crs": None}, "three numbers"),
        ([], "three numbers"),
    ],
)
def test_a_frame_that_is_none_is_refused(
    run: Run, scan: str, tmp_path: Path, frame: Any, words: str
) -> None:
    run("plan", scan, "--loads", 1, "--out", tmp_path / "out")
    path = tmp_path / "out" / "plan.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "frame": frame}))
    refused(run("simulate", scan, path), words)


def test_systems_that_differ_are_refused() -> None:
    frame = Frame(crs="EPSG:25832")
    with pytest.raises(InputError, match="EPSG:25833"):
        frame.shift_from(Frame(crs="EPSG:25833"))
    assert frame.shift_from(Frame((1000.0, 0.0, 0.0))) == (1000.0, 0.0)


def test_the_same_file_is_read_as_the_plan_was(run: Run, tmp_path: Path) -> None:
    scan = survey(tmp_path, "a.npz", 355_980.0)
    crop = "355985,5200001,356006,5200019"
    run("plan", scan, "--loads", 1, "--crop", crop, "--out", tmp_path / "out")
    path = tmp_path / "out" / "plan.json"
    code, out, err = run("simulate", scan, path, "--json")
    assert code == 0
    assert "as the plan was made, with its --crop" in err
    assert json.loads(out)["pile"]["cells"] == json.loads(path.read_text())["pile"]["cells"]


def test_what_was_foreseen_keeps_its_deviation_when_it_is_played_again(
    run: Run, scan: str, tmp_path: Path
) -> None:
    run("plan", scan, "--loads", 2, "--out", tmp_path / "out")
    path = tmp_path / "out" / "plan.json"
    document = json.loads(path.read_text())
    assert "deviation" not in document["total"]
    for load in document["loads"]:
        load["deviation"] = {"mass": 0.03, "time": 0.4, "work": 5.0}
    path.write_text(json.dumps(document))
    code, _, _ = run("simulate", scan, path, "--out", tmp_path / "again")
    assert code == 0
    again = json.loads((tmp_path / "again" / "plan.json").read_text())
    assert again["loads"][1]["deviation"] == pytest.approx(document["loads"][1]["deviation"])
    assert again["total"]["deviation"]["time"] == pytest.approx(2.0 * 0.4)
    assert "± 1 s" in (tmp_path / "again" / "report.html").read_text()
    # Half of a deviation is none.
    del document["loads"][1]["deviation"]["time"]
    path.write_text(json.dumps(document))
    assert "deviation" not in json.loads(run("simulate", scan, path, "--json")[1])["total"]


def test_a_plan_that_is_none_is_refused(run: Run, scan: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text("{}")
    refused(run("simulate", scan, path), str(path))
    refused(run("simulate", scan, tmp_path / "none.json"), "no such plan")
    refused(run("simulate", scan), "PLAN.json")


# --- diggability


def test_a_map_is_written(
    run: Run, scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, real_figures: None
) -> None:
    monkeypatch.setattr(worlds, "load_world", lambda name, **_: FakeWorld(1.0).__call__)
    words = ("diggability", scan, "--locations", 20, "--action", "0.1,2,0.3,4")
    code, out, _ = run(*words, "--out", tmp_path / "out")
    assert code == 0
    assert "median" in out
    assert "mass [t]" in out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "diggability.json",
        "diggability.png",
        "report.html",
    ]
    page = Page((tmp_path / "out" / "report.html").read_text())
    assert "20 places" in page.text
    assert len(page.links) == 4
    document = strict_json((tmp_path / "out" / "diggability.json").read_text())
    assert document["action"] == {"delta_bm": 0.1, "k_bm": 2.0, "delta_bk": 0.3, "k_bk": 4.0}
    assert len(document["locations"]) == 20
    assert {load["time"] for load in document["locations"]} == {12.0}
    assert strict_json(run(*words, "--json")[1]) == document


def test_an_optimised_map_is_written(
    run: Run, scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, real_figures: None
) -> None:
    monkeypatch.setattr(worlds, "load_world", lambda name, **_: FakeWorld(1.0).__call__)
    out = tmp_path / "out"
    words = ("diggability", scan, "--locations", 4, "--optimise")
    code, said, _ = run(*words, "--out", out)
    assert code == 0
    assert "t/h instead of" in said
    document = strict_json((out / "diggability.json").read_text())
    assert document["objective"] == "rate"
    assert [pile["locations"] for pile in document["piles"]] == [4]
    for place in document["locations"]:
        # The less the boom's gain, the less time.
        assert place["action"]["k_bm"] < 0.3
        assert place["time"] < place["fixed"]["time"] == pytest.approx(14.51)
        assert place["gain"] > 40.0
    assert "best of each place" in Page((out / "report.html").read_text()).text
    refused(run("diggability", scan, "--objective", "rate"), "--optimise or --truck")
    refused(run(*words, "--objective", "none"), "'none' is no objective")


# --- models


@pytest.mark.parametrize("command", [("plan", "--loads", 1), ("diggability", "--locations", 2)])
def test_the_high_world_takes_both_of_its_models(
    run: Run, scan: str, monkeypatch: pytest.MonkeyPatch, command: tuple[object, ...]
) -> None:
    asked: list[tuple[str, str | None, str | None]] = []

    def load_world(name: str, **options: Any) -> FakeWorld:
        asked.append((name, options.get("model"), options.get("pile_state")))
        return FakeWorld(1.0, options["soil"])

    monkeypatch.setattr(worlds, "load_world", load_world)
    given = {kind: str(worlds.pretrained_path(kind)) for kind in ("psi_high", "phi")}
    words = (command[0], scan, *command[1:], "--json", "--world", "high")
    code, out, _ = run(*words, "--model", given["psi_high"], "--pile-state", given["phi"])
    assert code == 0
    assert asked[0] == ("high", given["psi_high"], given["phi"])
    document = strict_json(out)
    assert (document["model"], document["pile_state"]) == (given["psi_high"], given["phi"])
    asked.clear()
    code, out, _ = run(*words)
    first, *_ = asked
    assert first == ("high", None, None)
    assert not {"model", "pile_state"} & set(strict_json(out))


@pytest.mark.parametrize("command", ["plan", "diggability", "gradcheck"])
def test_a_scan_cropped_to_the_pile_is_refused_in_one_line(
    run: Run, tmp_path: Path, command: str
) -> None:
    """No bucket can start on a toe that lies outside the map."""
    x, y = np.meshgrid(*(0.1 * np.arange(100) - 5.0,) * 2, indexing="ij")
    pile = Pile((4.0 - 0.6 * np.hypot(x, y)).astype(np.float32), 0.1, (-5.0, -5.0))
    io.write_pile(tmp_path / "a.npz", pile)
    refused(run(command, tmp_path / "a.npz"), "start nowhere on the toe", "wider area")


# --- soil and machine


def test_the_soil_of_the_options_is_in_every_world_and_the_ledger(
    run: Run, scan: str, asked: list[tuple[str, Soil, WheelLoader]]
) -> None:
    code, out, err = run("plan", scan, "--loads", 1, "--soil", "sand", "--json")
    assert code == 0
    assert asked == [("hybrid", SAND, WA320), ("simulator", SAND, WA320)]
    document = strict_json(out)
    assert document["ledger"]["density"] == pytest.approx(SAND.density / 1000.0)
    assert document["soil"] == {"name": "sand", "parameters": dataclasses.asdict(SAND)}
    assert document["machine"] == {"name": "wa320", "parameters": dataclasses.asdict(WA320)}
    assert "trained for gravel and the WA320, not for sand:" in err


def test_a_plan_is_played_with_its_own_soil_and_machine(
    run: Run, scan: str, asked: list[tuple[str, Soil, WheelLoader]], tmp_path: Path
) -> None:
    given = tmp_path / "narrow.toml"
    given.write_text("bucket_width = 2.0\ntilt_speed_deg = 30\n")
    narrow = dataclasses.replace(WA320, bucket_width=2.0, tilt_speed=math.radians(30.0))
    words = ("--soil", "sand", "--machine", given, "--out", tmp_path / "out")
    assert run("plan", scan, "--loads", 1, *words)[0] == 0
    given.unlink()  # the plan holds all values
    path = tmp_path / "out" / "plan.json"
    asked.clear()
    code, out, err = run("simulate", scan, path, "--json")
    assert code == 0
    assert "another soil" not in err
    assert asked == [("simulator", SAND, narrow)]
    again, planned = strict_json(out), json.loads(path.read_text())
    for part in ("soil", "machine", "ledger"):
        assert again[part] == planned[part]
    _, out, err = run("simulate", scan, path, "--soil", "gravel", "--json")
    assert asked[1:] == [("simulator", GRAVEL, narrow)]
    assert "another soil" in err
    assert json.loads(out)["ledger"]["density"] == pytest.approx(GRAVEL.density / 1000.0)


def test_without_options_it_is_gravel_and_the_wa320_and_nothing_is_told(
    run: Run, scan: str, asked: list[tuple[str, Soil, WheelLoader]]
) -> None:
    _, out, err = run("plan", scan, "--loads", 1, "--json")
    assert {entry[1:] for entry in asked} == {(GRAVEL, WA320)}
    assert "trained for" not in err
    assert json.loads(out)["soil"]["name"] == "gravel"
    # The simulator was trained for nothing.
    assert (
        "trained for"
        not in run("plan", scan, "--loads", 1, "--world", "simulator", "--soil", "clay")[2]
    )


@pytest.mark.parametrize(
    ("record", "word"),
    [
        ("sand", "soil has no name"),
        ({"name": "sand"}, "no parameters"),
        ({"name": "sand", "parameters": {"density": -1.0}}, "density is -1"),
        ({"name": "sand", "parameters": {"densty": 1.0}}, "densty"),
    ],
)
def test_a_plan_with_a_soil_that_cannot_be_is_refused(
    run: Run, scan: str, tmp_path: Path, record: object, word: str
) -> None:
    run("plan", scan, "--loads", 1, "--out", tmp_path / "out")
    path = tmp_path / "out" / "plan.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "soil": record}))
    refused(run("simulate", scan, path), str(path), word)


def test_a_map_has_its_soil_and_machine(
    run: Run, scan: str, asked: list[tuple[str, Soil, WheelLoader]]
) -> None:
    code, out, err = run("diggability", scan, "--locations", 3, "--soil", "clay", "--json")
    assert code == 0
    assert "trained for gravel" in err
    assert asked[0][1].cohesion > 0.0
    assert json.loads(out)["soil"]["name"] == "clay"


@pytest.mark.parametrize("command", ["plan", "simulate", "diggability", "gradcheck"])
@pytest.mark.parametrize(
    ("option", "text", "told"),
    [
        ("--soil", "density = -1", "density is -1 kg/m³"),
        ("--soil", "friction_deg = 95", "friction_deg is 95°"),
        ("--machine", "bucket_width = 6", "bucket_width is 6 m"),
        ("--machine", "mass = nan", "mass is not finite"),
    ],
)
def test_a_soil_or_machine_that_cannot_be_is_one_line(
    run: Run,
    tmp_path: Path,
    asked: list[tuple[str, Soil, WheelLoader]],
    command: str,
    option: str,
    text: str,
    told: str,
) -> None:
    (tmp_path / "given.toml").write_text(text)
    piles = ("bundled", "plan.json") if command == "simulate" else ("bundled",)
    refused(run(command, *piles, option, tmp_path / "given.toml"), "given.toml", told)
    refused(run(command, *piles, option, "moon"), "'moon'", "no such")
    assert asked == []


# --- errors


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["dig"], "dig"),
        (["plan", "--lods", "3"], "--loads"),
        (["plan", "--loads", "0"], "--loads"),
        (["plan", "--loads", "many"], "--loads"),
        (["plan", "--loads"], "--loads"),
        (["plan", "--world", "moon"], "simulator"),
        (["plan", "--planner", "magic"], "gradient"),
        (["plan", "--objective", "fun"], "efficiency"),
        (["plan", "--truck", "here"], "X,Y"),
        (["plan", "--truck", "1"], "X,Y"),
        (["plan", "--truck", "1,nan"], "finite"),
        (["plan", "--truck", "1,2,3,4"], "X,Y"),
        (["plan", "--seed", "-1"], "--seed"),
        (["plan", "--seed", "0.5"], "--seed"),
        (["plan", "a.npz", "b.npz"], "b.npz"),
        (["plan", "missing.npz"], "no such pile"),
        (["plan", "."], "folder"),
        (["plan", "--out", ""], "empty"),
        (["plan", "--model", "missing"], "no such model"),
        (["plan", "--model", ".", "--world", "simulator"], "--model"),
        (["plan", "--model", ".", "--world", "high"], "not there yet"),
        (["plan", "--pile-state", ".", "--world", "simulator"], "--pile-state does not go with"),
        (["diggability", "--pile-state", ".", "--world", "a.b:c"], "--pile-state"),
        (["plan", "--planner", "no_such_module:Planner"], "cannot be imported"),
        (["plan", "--world", "math:no_such_name"], "has no no_such_name"),
        (["plan", "--objective", "not a name"], "efficiency"),
        (["gradcheck", "--pile-state", "missing", "--world", "high"], "no such model"),
        (["simulate", "bundled"], "PLAN.json"),
        (["diggability", "--locations", "-3"], "--locations"),
        (["diggability", "--action", "0.68,4.51,0.17"], "DELTA_BM"),
        (["diggability", "--action", "0.9,4,0.1,4"], "delta_bm is 0.9"),
        (["diggability", "--action", "0.6,4,0.1,-4"], "k_bk is -4"),
        (["collect", "--out", "x.zarr", "--cycles", "0"], "--cycles"),
        (["collect"], "--out"),
        (["collect", "--out", "x.zarr", "--shard", "0/3"], "I/N"),
        (["collect", "--out", "x.zarr", "--shard", "4/3"], "I/N"),
        (["collect", "--out", "x.zarr", "--shard", "1"], "I/N"),
        (["collect", "--out", "x.zarr", "--shard", "1/7"], "at most 6"),
        (["collect", "--out", "x.zarr", "a.zarr"], "--merge"),
        (["collect", "--out", "x.zarr", "--merge"], "name all of them"),
        (["collect", "--merge", "a.zarr"], "--out"),
        (["collect", "--out", "x.zarr", "--merge", "a.zarr"], "no such shard"),
        (["collect", "--out", "x.zarr", "--merge", "a.zarr", "--shard", "1/2"], "--shard"),
        (["collect", "--out", "x.zarr", "--merge", "a.zarr", "--cycles", "10800"], "--cycles"),
        (["collect", "--out", "x.zarr", "--merge", "a.zarr", "--seed", "0"], "--seed"),
        (["train"], "MODEL"),
        (["train", "psi-nothing", "--data", "a", "--out", "b"], "psi-low"),
        (["collect", "--out", "x.zarr", "--merge", "a.zarr", "--soil", "sand"], "--soil"),
        (["collect", "--out", "x.zarr", "--soil", "snad"], "sand"),
        (["train", "psi-low", "--data", "missing", "--out", "b"], "wlplan collect"),
        (["train", "psi-low", "--data", ".", "--out", "b", "--hidden", "8,0"], "8,0"),
        (["train", "psi-low", "--data", ".", "--out", "b", "--hidden", "8;9"], "N[,N...]"),
        (["train", "psi-low", "--data", ".", "--out", "b", "--dropout", "1"], "--dropout"),
        (["train", "psi-low", "--data", ".", "--out", "b", "--encoder", "principal"], "--encoder"),
        (["train", "psi-high", "--data", ".", "--out", "b", "--encoder", "magic"], "principal"),
        (["train", "phi", "--data", ".", "--out", "b", "--members", "5"], "--members"),
        (["train", "psi-low", "--data", ".", "--out", "b", "--members", "0"], "--members"),
        (["train", "all", "--data", "a", "--out", "b", "--hidden", "8"], "--hidden"),
        (["train", "all", "--out", "b"], "--data"),
        (["evaluate"], "--data"),
        (["evaluate", "--data", "missing"], "no such data set"),
    ],
)
def test_bad_usage_is_one_line(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(run(*words), told)
    assert list(tmp_path.iterdir()) == []


def test_bad_input_is_one_line(run: Run, scan: str, tmp_path: Path) -> None:
    (tmp_path / "bad.npz").write_text("no pile")
    (tmp_path / "pile.doc").write_text("no pile")
    (tmp_path / "file").write_text("mine")
    refused(run("plan", tmp_path / "bad.npz"), "bad.npz")
    refused(run("plan", tmp_path / "pile.doc"), ".laz")
    refused(run("plan", scan, "--out", tmp_path / "file"), "is a file")
    refused(run("plan", scan, "--out", tmp_path / "file" / "below"), "is a file")
    refused(run("plan", scan, "--world", "low"), "not there yet")
    refused(run("plan", scan, "--truck", "0,0"), "on the pile")
    refused(run("plan", scan, "--truck", "4000,0"), "coordinates of the scan")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that nobody can write")
def test_a_folder_that_cannot_be_written_is_refused_before_anything_runs(
    run: Run, scan: str, calls: list[dict[str, Any]]
) -> None:
    refused(run("plan", scan, "--out", "/proc/out"), "cannot be written")
    assert calls == []


def test_a_folder_in_the_way_of_a_file_is_told(run: Run, scan: str, tmp_path: Path) -> None:
    (tmp_path / "out" / "plan.png").mkdir(parents=True)
    code, out, err = run("plan", scan, "--loads", 1, "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert "plan.png" in err.splitlines()[-1]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["plan.png"]


def test_a_place_for_data_that_cannot_be_written_is_refused_and_nothing_left(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset, "collect", lambda *_, **__: pytest.fail("has begun"))
    (tmp_path / "file").write_text("mine")
    refused(run("collect", "--out", tmp_path / "file"), "is a file")
    refused(run("collect", "--out", tmp_path / "file" / "below" / "x.zarr"), "is a file")
    if os.path.isdir("/proc/self"):
        refused(run("collect", "--out", "/proc/out/x.zarr"), "cannot be written")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_collect_takes_soil_and_machine(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "narrow.toml").write_text("bucket_width = 2.0\n")
    simulators = []
    monkeypatch.setattr(
        dataset, "collect", lambda *_, simulator, **__: simulators.append(simulator)
    )
    words = ("collect", "--out", tmp_path / "x.zarr", "--soil", "sand")
    code, out, _ = run(*words, "--machine", tmp_path / "narrow.toml")
    assert code == 0
    assert "cycles in" in out
    assert simulators[0].soil == SAND
    assert simulators[0].machine == dataclasses.replace(WA320, bucket_width=2.0)


# --- help, names, report


@pytest.mark.parametrize("command", sorted(cli.wlplan.commands))
def test_every_command_explains_itself_and_has_the_common_options(run: Run, command: str) -> None:
    code, out, err = run(command, "--help")
    assert (code, err) == (0, "")
    # A service gets seeds, and gives JSON, request by request.
    common = ("--quiet", "--help") if command == "serve" else ("--seed", "--json", "--help")
    for option in common:
        assert option in out


def test_no_command_shows_the_help(run: Run) -> None:
    code, out, err = run()
    assert (code, err) == (0, "")
    assert "diggability" in out


def test_the_names_offered_are_those_that_exist() -> None:
    assert tuple(dataset.PROTOCOLS) == cli.options.PROTOCOLS
    assert set(cli.options.UPS) == set(TURNS)


def test_what_is_exported_needs_a_folder(run: Run) -> None:
    code, _, err = run("plan", "--also", "dxf")
    assert code == 2
    assert "--out DIR" in err


def test_discrete_elements_make_no_film(run: Run, tmp_path: Path) -> None:
    words = ("--engine", "dem", "--also", "gif", "--out", tmp_path / "out")
    code, _, err = run("simulate", "bundled", tmp_path / "plan.json", *words)
    assert code == 2
    assert "leave out --also gif" in err


def test_the_report_stands_alone_and_escapes_names(run: Run, tmp_path: Path) -> None:
    name = "<b>&'x\".npz"
    path = tmp_path / name
    io.write_pile(path, seed_pile("conical", slope=math.radians(30.0), height=2.0, seed=1))
    run("plan", path, "--loads", 1, "--out", tmp_path / "out", "--also", "geojson")
    assert (tmp_path / "out" / "plan.geojson").exists()
    source = (tmp_path / "out" / "report.html").read_text()
    assert "<b>&'x" not in source
    page = Page(source)
    assert name in page.text
    # Two maps, and six charts.
    assert len(page.links) == len(page.alts) == 8
    assert all((link or "").startswith("data:image/png;base64,") for link in page.links)
    # Ours: what is drawn, what draws, and what steers it.
    assert page.tags.count("script") == 3
    assert len(source) < 6_000_000


def test_progress_tells_rate_and_remaining_time(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 30.0, 41.0, 60.0, 71.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    with cli.progress.Progress() as progress:
        # 100 were there; the first 10 took 30 s, compiling included, and do not count.
        for done in (100, 110, 132, 170, 192):
            progress("cycles", done, 1000, None)
    assert capsys.readouterr().err.splitlines() == [
        "cycles 100/1000",
        "cycles 110/1000",
        "cycles 132/1000, 2 a second, 7 min 14 s left",
        "cycles 170/1000, 2 a second, 6 min 55 s left",
        "cycles 192/1000, 2 a second, 6 min 44 s left",
    ]


def test_compiling_inside_of_tracing_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = cli.progress.Stopwatch()
    with watch:
        now = time.perf_counter()
        spans = [(now, now + 2.0), (now + 1.0, now + 2.0)]
        monkeypatch.setattr(cli.progress, "_compilations", spans)
        watch._first = 0
    assert watch.compiling == pytest.approx(2.0)


# --- as a process


def process(*words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "wlplan", *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        **options,
    )


def test_help_is_quick_and_imports_nothing_heavy() -> None:
    code = (
        "import sys, wlplan.cli; "
        "heavy = ('jax', 'matplotlib', 'scipy', 'numpy', 'jinja2'); "
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


def test_an_unknown_ending_is_refused_before_anything_heavy_is_imported(tmp_path: Path) -> None:
    (tmp_path / "pile.abc").write_text("1 2 3")
    code = (
        "import sys, wlplan.cli; code = wlplan.cli.main(['plan', 'pile.abc']); "
        "print(code, [name for name in ('jax', 'matplotlib', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=tmp_path,
    )
    assert done.stdout.strip() == "2 []"
    assert done.stderr.startswith("error: pile.abc: unknown kind of pile file")
    assert done.stderr.count("\n") == 1


def test_bad_usage_as_a_process(tmp_path: Path) -> None:
    done = process("plan", "--loads", "0", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_bad_input_as_a_process(tmp_path: Path) -> None:
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04")
    done = process("plan", "bad.npz", "--out", "out", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: bad.npz")
    assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["bad.npz"]


@pytest.mark.parametrize("on_a_terminal", [True, False])
def test_the_plan_is_seen_before_it_is_drawn_where_someone_waits(
    run: Run, scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_a_terminal: bool
) -> None:
    """Into a pipe it goes when all is written: a pipe may break."""

    @contextlib.contextmanager
    def no_room(*_: object, **__: object) -> Iterator[Path]:
        raise InputError("no space left on the disk")
        yield tmp_path

    monkeypatch.setattr(io.files, "atomic_folder", no_room)
    monkeypatch.setattr("sys.stdout.isatty", lambda: on_a_terminal, raising=False)
    code, out, err = run("plan", scan, "--loads", 1, "--out", tmp_path / "out")
    assert code == 2
    assert err.splitlines()[-1] == "error: no space left on the disk"
    assert ("ledger:" in out) == on_a_terminal
