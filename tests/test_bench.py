"""The benchmark: the automata that others would write are the same, and every item comes out."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import volume

from wlplan import cli
from wlplan.errors import InputError
from wlplan.studies import bench
from wlplan.studies.bench import automata
from wlplan.studies.bench.baselines import (
    Sweeps,
    aeolis_rest,
    numba_sweeps,
    numpy_sweeps,
    rest,
    steepest_rise,
)
from wlplan.studies.bench.digs import random_digs
from wlplan.studies.bench.items import ITEMS
from wlplan.studies.bench.rollouts import measure_rollouts
from wlplan.studies.bench.setup import Item, Measured, Setup
from wlplan.studies.bench.timing import Timing, compiled, timed
from wlplan.terrain.automaton import converged, steepest_slope, sweeps
from wlplan.types import Pile

# Exit code, stdout and stderr of words of the command line.
Run = Callable[..., tuple[int, str, str]]

REPOSE = math.radians(32.0)
DROP = 0.1 * math.tan(REPOSE)
NUMBERS = {"cell_size": 0.1, "repose_angle": REPOSE, "tolerance": math.radians(1.0)}


def random_surface(seed: int, shape: tuple[int, int] = (17, 12)) -> np.ndarray:
    """A surface too steep almost everywhere, its border included."""
    return np.random.default_rng(seed).random(shape)


def cliff(seed: int) -> np.ndarray:
    """A block on uneven ground, 2 m high."""
    height = 0.1 * random_surface(seed, (40, 33))
    height[10:22, 12:20] += 2.0
    return height


# --- the automata of others


@pytest.fixture(params=["numpy", "numba"])
def automaton(request: pytest.FixtureRequest) -> Sweeps:
    """Sweeps as others would write them."""
    if request.param == "numba":
        pytest.importorskip("numba")
    return {"numpy": numpy_sweeps, "numba": numba_sweeps}[request.param]


def test_a_baseline_is_the_automaton_sweep_by_sweep(automaton: Sweeps) -> None:
    with jax.enable_x64(True):
        theirs = ours = random_surface(0)
        for _ in range(40):
            theirs = automaton(theirs, DROP, 1)
            ours = np.asarray(sweeps(jnp.asarray(ours), DROP, None, 1))
            np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_a_baseline_makes_as_many_sweeps_as_it_is_asked_for(automaton: Sweeps, count: int) -> None:
    with jax.enable_x64(True):
        before = random_surface(1)
        kept = before.copy()
        found = automaton(before, DROP, count)
        expected = sweeps(jnp.asarray(before), DROP, None, count)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-14)
        np.testing.assert_array_equal(before, kept)


def test_a_baseline_works_in_the_precision_of_its_surface(automaton: Sweeps) -> None:
    before = random_surface(2).astype(np.float32)
    found = automaton(before, DROP, 25)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, sweeps(jnp.asarray(before), DROP, None, 25), atol=1e-5)


def test_a_baseline_comes_to_rest_where_the_reference_does(automaton: Sweeps) -> None:
    with jax.enable_x64(True):
        before = cliff(3)
        found = rest(automaton, before, **NUMBERS)
        reference = converged(Pile(jnp.asarray(before), 0.1), tolerance=NUMBERS["tolerance"])
        np.testing.assert_allclose(found.height, reference.height, rtol=0.0, atol=1e-12)
        assert found.sweeps is not None
        assert found.sweeps > 100
        assert math.degrees(steepest_slope(reference)) <= 33.0


def test_a_surface_at_rest_is_left_alone(automaton: Sweeps) -> None:
    before = 0.01 * random_surface(4)
    found = rest(automaton, before, **NUMBERS)
    assert found.sweeps == 0
    np.testing.assert_array_equal(found.height, before)


def test_the_steepest_rise_is_the_steepest_slope() -> None:
    before = random_surface(5)
    slope = float(steepest_slope(Pile(jnp.asarray(before, jnp.float32), 0.1)))
    assert math.atan(steepest_rise(before) / 0.1) == pytest.approx(slope, rel=1e-6)


def test_aeolis_comes_to_rest_and_keeps_the_volume() -> None:
    pytest.importorskip("aeolis")
    before = cliff(6)
    found = aeolis_rest(before, **NUMBERS)
    assert found.sweeps is not None
    assert found.sweeps > 0
    assert found.height.sum() == pytest.approx(before.sum(), rel=1e-12)
    assert math.degrees(math.atan(steepest_rise(np.asarray(found.height)) / 0.1)) <= 36.0


# --- the cases


def test_digs_take_a_load_and_follow_from_the_seed() -> None:
    digs, again = random_digs(7, 3), random_digs(7, 3)
    taken = [float(volume(dig.before) - volume(dig.dug)) for dig in digs]
    assert all(0.3 <= load <= 3.0 + 1e-3 for load in taken), taken
    assert len({dig.pile.height.shape for dig in digs}) == 1
    for one, two in zip(digs, again, strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, two)
        i, j = one.start
        n, m = one.before.height.shape
        np.testing.assert_array_equal(one.pile.height[i : i + n, j : j + m], one.before.height)
    # The seventh is on the pile of the first, which has slid since.
    assert (digs[6].pile.height != digs[0].pile.height).any()
    expected = float(volume(digs[0].pile)) - taken[0]
    assert float(volume(digs[6].pile)) == pytest.approx(expected, rel=1e-5)


# --- timing


def test_functions_are_timed_in_turn_on_every_case() -> None:
    calls = []

    def double(n: int) -> int:
        calls.append(("double", n))
        return 2 * n

    def negative(n: int) -> int:
        calls.append(("negative", n))
        return -n

    first, second = timed([double, negative], [(1,), (2,)], seconds=0.0, least=2)
    one_pass = [("double", 1), ("negative", 1), ("double", 2), ("negative", 2)]
    assert calls == [("double", 1), ("negative", 1), *one_pass, *one_pass]
    assert (first.results, second.results) == ([2, 4], [-1, -2])
    assert first.timing.repeats == second.timing.repeats == 4
    assert 0.0 < first.timing.low <= first.timing.median <= first.timing.high


def test_no_more_passes_are_made_than_asked_for() -> None:
    calls: list[int] = []
    timed([calls.append], [(1,)], seconds=60.0, most=3, warm=True)
    assert len(calls) == 3


def test_spread_is_from_the_10th_to_the_90th_percentile() -> None:
    found = Timing.of([float(n) for n in range(101)])
    assert (found.low, found.median, found.high, found.repeats) == (10.0, 50.0, 90.0, 101)


def test_compiling_gives_the_function_and_its_time() -> None:
    run, seconds = compiled(lambda x: x + 1.0, jnp.float32(2.0))
    assert run(jnp.float32(3.0)) == 4.0
    assert seconds > 0.0


# --- the items


def test_the_names_offered_are_those_that_exist() -> None:
    assert tuple(ITEMS) == cli.benchmark.ITEMS


def test_a_target_is_met_within_its_limits() -> None:
    def item(**limits: Any) -> Item:
        return Item("a", "b", lambda _: Measured(), "c", **limits)

    measured = Measured(None, Timing(2.0, 1.0, 3.0, 5), {"ratio": 4.0})
    assert item(most={"run": 2.0, "ratio": 4.0}).met(measured) is True
    assert item(most={"run": 2.0, "ratio": 3.9}).met(measured) is False
    assert item(least={"ratio": 4.0}).met(measured) is True
    assert item(least={"ratio": 4.1}).met(measured) is False
    assert item().met(measured) is None
    assert item(most={"run": 2.0}).met(Measured(note="not here")) is None


def test_an_item_that_needs_what_is_not_there_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(automata, "find_spec", lambda name: None)
    document = bench.run_bench(["numba", "aeolis"], quick=True)
    numba, aeolis = document["items"]
    assert "pip install wlplan[bench]" in numba["note"]
    assert "pip install aeolis" in aeolis["note"]
    assert numba["run"] is numba["compile"] is numba["met"] is None


def test_an_unknown_item_is_refused() -> None:
    with pytest.raises(InputError, match="avalanche"):
        bench.run_bench(["no-such-item"])


@pytest.mark.slow
def test_rollouts_of_a_gpu_can_be_counted_anywhere() -> None:
    measured = measure_rollouts(Setup(seed=0, quick=True), 2)
    assert measured.run is not None
    expected = 2 * 40 / measured.run.median
    assert measured.figures["loads_per_second"] == pytest.approx(expected)


# --- the command


def strict_json(text: str) -> dict[str, Any]:
    def fail(constant: str) -> NoReturn:
        raise AssertionError(f"{constant} in JSON")

    document: dict[str, Any] = json.loads(text, parse_constant=fail)
    return document


def numbers(value: Any) -> list[float]:
    """All numbers of a JSON document but truth values."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for part in value for number in numbers(part)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def check_record(record: dict[str, Any]) -> None:
    assert record["title"]
    if record["run"] is None:
        assert record["note"]
        return
    run = record["run"]
    assert run["repeats"] >= 1
    assert 0.0 < run["p10"] <= run["median"] <= run["p90"]
    assert all(number >= 0.0 for number in numbers([record["compile"], record["figures"]]))
    assert (record["met"] is None) == (record["target"] is None)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command line; returns exit code, stdout and stderr."""

    def run_words(*words: object) -> tuple[int, str, str]:
        code = cli.main([str(word) for word in words])
        return code, *capsys.readouterr()

    return run_words


def test_an_unknown_name_is_one_line(run: Run) -> None:
    code, out, err = run("bench", "--only", "no-such-item")
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert "no-such-item" in err


def test_one_item_as_a_file_and_as_json(run: Run, tmp_path: Path) -> None:
    words = ("bench", "--quick", "--only", "psi-low", "--only", "plan", "--only", "gpu-rollouts")
    code, out, _ = run(*words, "--json", "--out", tmp_path / "out")
    assert code == 0
    assert out == (tmp_path / "out" / "bench.json").read_text()
    document = strict_json(out)
    assert document["format"] == "wlplan.bench/1"
    assert document["device"]["cores"] >= 1
    assert document["versions"]["jax"] == jax.__version__
    assert [record["name"] for record in document["items"]] == ["psi-low", "gpu-rollouts", "plan"]
    for record in document["items"]:
        check_record(record)
    assert document["items"][0]["run"]["median"] > 0.0
    assert "--quick" in document["items"][2]["note"]


def test_the_table_shows_found_beside_target(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    records = {
        "avalanche": Measured(
            12.3,
            Timing(0.00123, 0.001, 0.002, 60),
            {"steepest_slope_degrees": 32.5, "relative_volume_change": 2e-7},
        ),
        "aeolis": Measured(note="not here"),
    }
    for name, measured in records.items():
        changed = {**vars(ITEMS[name]), "measure": lambda _, found=measured: found}
        monkeypatch.setitem(ITEMS, name, Item(**changed))
    code, out, err = run("bench", "--only", "avalanche", "--only", "aeolis")
    assert code == 0
    for text in ("12.3 s", "1.23 ms", "1.00 ms", "60", "32.50°", "2e-07", "≤ 2 ms", "yes", "1.1 s"):
        assert text in out
    assert "not here" in out
    assert "avalanche 0/2" in err


@pytest.mark.slow
def test_everything_quickly(run: Run) -> None:
    code, out, _ = run("bench", "--quick", "--json")
    assert code == 0
    document = strict_json(out)
    assert [record["name"] for record in document["items"]] == list(ITEMS)
    assert all(math.isfinite(number) for number in numbers(document))
    for record in document["items"]:
        check_record(record)
        figures = set(record["figures"]) - set(cli.benchmark._FIGURES)
        assert not figures
    skipped = {record["name"] for record in document["items"] if record["run"] is None}
    assert skipped <= {"gpu-rollouts", "plan", "first-load", "next-load", "numba", "aeolis"}
