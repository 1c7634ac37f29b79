"""Every experiment runs in its smoke preset and draws its figure."""

import importlib
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import experiments

ROOT = Path(__file__).parents[1]
# What the others share, and the recipe of a data set: neither has a result of its own.
OTHERS = {"record", "dem_cycles"}
NAMES = sorted(
    module.name
    for module in pkgutil.iter_modules(experiments.__path__)
    if module.name not in OTHERS
)


def test_there_are_experiments_and_each_can_run_and_draw():
    assert NAMES
    for name in NAMES:
        module = importlib.import_module(f"experiments.{name}")
        assert callable(module.run)
        assert callable(module.draw)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_smoke_preset_writes_numbers_and_a_picture(name, tmp_path):
    subprocess.run(
        [sys.executable, "-m", f"experiments.{name}", "--preset", "smoke", "--out", str(tmp_path)],
        check=True,
        cwd=ROOT,
        capture_output=True,
    )
    result = json.loads((tmp_path / f"{name}.json").read_text())
    assert result["preset"] == "smoke"
    assert result["conditions"]["jax"]
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", NAMES)
def test_committed_results_are_of_the_full_preset_and_can_be_drawn(name, tmp_path):
    path = ROOT / "experiments" / "results" / f"{name}.json"
    result = json.loads(path.read_text())
    assert result["preset"] == "full"
    (tmp_path / path.name).write_text(path.read_text())
    importlib.import_module(f"experiments.{name}").draw(tmp_path)
    assert (tmp_path / f"{name}.png").stat().st_size > 5000
