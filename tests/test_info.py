"""What a scan holds: volumes as far off as they say, piles, structures; without JAX."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import wlplan
from wlplan.cli import main
from wlplan.io import bundled_pile_path

X, Y = np.meshgrid(np.arange(0.1, 30.0, 0.2), np.arange(0.1, 24.0, 0.2), indexing="ij")
SLOPE = np.tan(np.radians(32.0))
KEYS = {
    *("volume", "volume_deviation", "piles", "structures", "steepest_slope_deg"),
    *("crs", "offset", "cells", "cell_size", "notes"),
}


def cone(x: float, y: float, top: float) -> np.ndarray:
    height: np.ndarray = np.maximum(0.0, top - np.hypot(X - x, Y - y) * SLOPE)
    return height


def save(path: Path, height: np.ndarray, west: float = 0.0) -> Path:
    np.savez(path, height=height, cell_size=0.2, origin=np.array([west + 0.1, 0.1]))
    return path


@pytest.mark.parametrize(("scatter", "width"), [(0.03, 0.0), (0.05, 0.0), (0.03, 2.5)])
def test_the_deviation_is_what_volumes_scatter_by(
    tmp_path: Path, scatter: float, width: float
) -> None:
    """Noise of known size, white and correlated [cells]: within a factor of two or so."""
    truth = float(cone(15.0, 12.0, 3.5).sum()) * 0.04
    errors, deviations = [], []
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0.0, 1.0, X.shape)
        if width:
            noise = ndimage.gaussian_filter(noise, width)
        noise *= scatter / noise.std()
        found = wlplan.info(save(tmp_path / "a.npz", cone(15.0, 12.0, 3.5) + noise))
        errors.append(found["volume"] - truth)
        deviations.append(found["volume_deviation"])
    spread, stated = float(np.std(errors)), float(np.mean(deviations))
    assert 0.4 < spread / stated < 2.5
    # The toe of noise is a little wider than that of the pile.
    assert abs(np.mean(errors)) < 0.01 * truth


def test_what_was_not_seen_makes_it_less_certain(tmp_path: Path) -> None:
    height = cone(15.0, 12.0, 3.5)
    whole = wlplan.info(save(tmp_path / "a.npz", height))
    height[np.hypot(X - 15.0, Y - 12.0) < 1.2] = np.nan
    holed = wlplan.info(save(tmp_path / "b.npz", height))
    assert whole["volume_deviation_parts"]["unseen"] == 0.0
    assert holed["volume_deviation_parts"]["unseen"] > 0.2
    assert abs(holed["volume"] - whole["volume"]) < 3.0 * holed["volume_deviation"]


def test_piles_and_slopes_in_the_coordinates_of_the_scan(tmp_path: Path) -> None:
    height = np.maximum(cone(8.0, 12.0, 2.6), cone(22.0, 12.0, 2.9))
    found = wlplan.info(save(tmp_path / "a.npz", height, west=500_000.0))
    assert set(found) >= KEYS
    assert found["offset"] == [500_000.0, 0.0, 0.0]
    first, second = found["piles"]
    assert (first["x"], first["y"]) == pytest.approx((500_022.0, 12.0), abs=0.1)
    assert second["x"] == pytest.approx(500_008.0, abs=0.1)
    assert first["planned"]
    assert not second["planned"]
    for pile, top in ((first, 2.9), (second, 2.6)):
        assert pile["volume"] == pytest.approx(np.pi * top**3 / (3 * SLOPE**2), rel=0.02)
        # Steps of cells make a round outline 6 % longer.
        expected = 2 * np.pi * (top - 0.15) / SLOPE
        assert pile["toe_length"] == pytest.approx(expected, rel=0.08)
    assert found["volume"] == pytest.approx(first["volume"] + second["volume"])
    assert found["median_slope_deg"] == pytest.approx(32.0, abs=1.0)
    assert any("2 piles" in note for note in found["notes"])


def test_structures_are_named_and_are_no_volume(tmp_path: Path) -> None:
    height = cone(20.0, 12.0, 3.0)
    box = (X > 4.0) & (X < 10.0) & (Y > 4.0) & (Y < 6.5)
    found = wlplan.info(save(tmp_path / "a.npz", np.where(box, 2.6, height)))
    (one,) = found["structures"]
    assert (one["x"], one["y"]) == pytest.approx((7.0, 5.25), abs=0.2)
    assert one["kind"] == "block"
    assert found["volume"] == pytest.approx(float(height.sum()) * 0.04, rel=0.02)
    assert found["steepest_slope_deg"] < 40.0


def test_a_pile_steeper_than_its_soil_is_said_to_be_with_a_choice(tmp_path: Path) -> None:
    steep = save(tmp_path / "a.npz", np.maximum(3.0 - np.hypot(X - 12.0, Y - 12.0), 0.0))
    found = wlplan.info(steep)
    assert found["steepest_slope_deg"] == pytest.approx(45.0, abs=1.0)
    (note,) = (note for note in found["notes"] if "degrees" in note)
    choice = note.rpartition("NAME@")[2].split()[0]
    assert float(choice) == pytest.approx(45.0, abs=1.0)
    at_rest = wlplan.info(steep, soil=wlplan.soil_named(f"gravel@{choice}"))
    assert not any("degrees" in note for note in at_rest["notes"])


def test_the_command_needs_no_jax() -> None:
    code = (
        "import sys; from wlplan.cli import main; code = main(['info', '--json']); "
        "print([m for m in ('jax', 'flax') if m in sys.modules], file=sys.stderr); sys.exit(code)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert run.stderr.strip() == "[]"
    found = json.loads(run.stdout)
    assert set(found) >= KEYS
    assert found["cells"] == [190, 160]
    assert found["volume"] == pytest.approx(164.4, abs=2.0)


def test_in_words(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["info", str(bundled_pile_path()), "--soil", "sand"]) == 0
    out = capsys.readouterr().out
    assert "m³ ±" in out
    assert "sand rests at" in out
    flat = save(tmp_path / "flat.npz", np.zeros_like(X))
    assert main(["info", str(flat)]) == 0
    assert "volume 0.0 m³" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "none.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
