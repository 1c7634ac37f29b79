"""Every experiment runs in its smoke preset and draws its figure."""

import importlib
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import action_landscape, dataset_overview, simulator_gradients
from experiments._common import catalogue
from experiments._common import results as record
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.types import LocalHeightmap

ROOT = Path(__file__).parents[1]
NAMES = [one.name for one in catalogue.experiments()]


def test_there_are_experiments_and_each_can_run_and_draw() -> None:
    assert NAMES
    for name in NAMES:
        module = importlib.import_module(f"experiments.{name}")
        assert callable(module.run)
        assert callable(module.draw)


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Data set and models that the smoke presets collect and train once, not each its own."""
    folder = tmp_path_factory.mktemp("experiments")
    return {"data": folder / "cycles.zarr", "models": folder / "models"}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_smoke_preset_writes_numbers_and_a_picture(
    name: str, tmp_path: Path, shared: dict[str, Path]
) -> None:
    needs = inspect.signature(importlib.import_module(f"experiments.{name}").run).parameters
    places = [[f"--{what}", str(place)] for what, place in shared.items() if what in needs]
    # Each is a process; what one has traced serves the next.
    traces = ROOT / ".pytest_cache" / "traces"
    traces.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        [
            *(sys.executable, "-m", f"experiments.{name}", "--preset", "smoke"),
            *("--out", str(tmp_path)),
            *(word for words in places for word in words),
        ],
        check=True,
        cwd=ROOT,
        capture_output=True,
        env=os.environ | {"WLPLAN_TRACES": str(traces)},
    )
    result = json.loads((tmp_path / f"{name}.json").read_text())
    assert result["preset"] == "smoke"
    assert result["conditions"]["jax"]
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_every_experiment_has_a_result() -> None:
    committed = {path.stem for path in (ROOT / "experiments" / "results").glob("*.json")}
    assert set(NAMES) <= committed


@pytest.mark.parametrize("name", NAMES)
def test_committed_results_are_of_the_full_preset(name: str) -> None:
    result = json.loads((ROOT / "experiments" / "results" / f"{name}.json").read_text())
    assert result["preset"] == "full"


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_committed_results_can_be_drawn(name: str, tmp_path: Path) -> None:
    path = ROOT / "experiments" / "results" / f"{name}.json"
    (tmp_path / path.name).write_text(path.read_text())
    importlib.import_module(f"experiments.{name}").draw(tmp_path)
    assert (tmp_path / f"{name}.png").stat().st_size > 5000


# --- What the figures rest on.


def test_partial_rank_correlations_see_through_a_confounder() -> None:
    random = np.random.default_rng(0)
    columns = random.normal(size=(4000, 13))
    # The second characteristic only goes with the first; the outcomes with the first alone.
    columns[:, 1] += 2.0 * columns[:, 0]
    columns[:, 8:] = np.exp(columns[:, :1]) + 0.3 * random.normal(size=(4000, 5))
    plain, partial = dataset_overview._rank_correlations(columns)
    assert plain.shape == partial.shape == (5, 4)
    assert (plain[:, 1] > 0.7).all()
    assert (np.abs(partial[:, 1:]) < 0.06).all()
    assert (partial[:, 0] > 0.5).all()


@pytest.mark.parametrize("name", action_landscape.SHAPES)
def test_the_shapes_have_the_characteristics_they_are_named_for(name: str) -> None:
    slope, incidence, *curvatures = action_landscape.SHAPES[name]
    height = action_landscape.surface(slope, incidence, *curvatures)
    local = LocalHeightmap(jnp.asarray(height[10:46, 8:44], jnp.float32), 0.1, 0.0)
    found = np.asarray(as_vector(characteristics(local)))
    np.testing.assert_allclose(np.degrees(found[:2]), (slope, incidence), atol=3.0)
    if incidence == 0.0:
        np.testing.assert_allclose(found[2:], curvatures, atol=0.01)


def test_the_summary_of_gradients_can_fail() -> None:
    random = np.random.default_rng(1)
    central = random.normal(size=(50, 4))
    same = simulator_gradients._summary(central, central)
    assert same["least"] == pytest.approx(1.0)
    assert same["median_relative_error"] == 0.0
    reverse = central.copy()
    reverse[:10] *= -1.0
    reverse[10] = central[10] = 0.0
    some = simulator_gradients._summary(reverse, central)
    assert some["cycles"] == 49
    assert some["p10"] == pytest.approx(-1.0)
    assert some["median"] == pytest.approx(1.0)


def test_what_is_no_data_set_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "note.txt").write_text("keep me")
    arguments = ["--data", str(tmp_path / "note.txt"), "--out", str(tmp_path / "results")]
    monkeypatch.setattr(sys, "argv", ["dataset_overview", *arguments])
    with pytest.raises(SystemExit) as ended:
        record.main("dataset_overview", dataset_overview.run, dataset_overview.draw)
    assert ended.value.code == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("error: ")
    assert "not a data set" in said[-1]
    assert (tmp_path / "note.txt").read_text() == "keep me"
