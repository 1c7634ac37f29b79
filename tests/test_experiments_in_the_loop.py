"""What the experiment on planning after every scan rests on: scans, rows, and pairs."""

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from cones import cone

from experiments import closed_loop
from experiments._common.rows import Rows
from experiments._common.scanning import Scanner
from wlplan.types import Pile, Pose

# --- scans


def plane(valid: np.ndarray | None = None) -> Pile:
    """A plane of another slope along each axis, over a floor far below."""
    i, j = np.indices((80, 60))
    height = (0.03 * i - 0.02 * j).astype(np.float32)
    return Pile(height, 0.1, (-4.0, 2.0), ground=np.full_like(height, -9.0), valid=valid)


def test_a_scanner_that_is_right_sees_what_is_there() -> None:
    pile = plane()
    scan = Scanner().scan(pile, np.random.default_rng(0))
    np.testing.assert_array_equal(scan.height, pile.height)
    assert scan.valid is None


def test_a_map_that_is_askew_is_the_pile_moved_and_turned() -> None:
    pile, turn = plane(), math.radians(5.0)
    scan = Scanner(shift=0.3, turn=turn).scan(pile, np.random.default_rng(3))
    seen = np.asarray(scan.valid)
    assert 0.85 < seen.mean() < 0.99
    # A plane stays one, whose slopes are turned; that is one of both ways.
    i, j = np.nonzero(seen)
    values = np.asarray(scan.height, np.float64)[seen]
    columns = np.stack([i, j, np.ones_like(i)], axis=-1)
    found, residual, _, _ = np.linalg.lstsq(columns, values, rcond=None)
    assert float(residual[0]) < 1e-6
    turned = complex(0.03, -0.02) * np.exp(np.array([1j, -1j]) * turn)
    slopes = complex(found[0], found[1])
    assert np.abs(slopes - turned).min() == pytest.approx(0.0, abs=1e-6)
    # The middle is where it was but for the shift: along the slope by at most that.
    middle = float(found @ [39.5, 29.5, 1.0]) - (0.03 * 39.5 - 0.02 * 29.5)
    assert 0.0 < abs(middle) <= 3.0 * math.hypot(0.03, 0.02)
    np.testing.assert_array_equal(scan.floor, pile.floor)


def test_every_scan_is_askew_in_another_direction() -> None:
    random = np.random.default_rng(0)
    scanner = Scanner(shift=0.2)
    first, second = (np.asarray(scanner.scan(cone(), random).height) for _ in range(2))
    assert np.abs(first - second).max() > 0.01


def test_noise_has_its_deviation_and_its_length() -> None:
    pile = Pile(np.zeros((400, 300), np.float32), 0.1)
    scanner = Scanner(deviation=0.03, smooth=0.15)
    noise = np.asarray(scanner.scan(pile, np.random.default_rng(1)).height - pile.height)
    assert noise.std() == pytest.approx(0.03, rel=1e-3)
    # White noise under a Gaussian of length s is correlated by exp(-d^2 / 4 s^2).
    for cells in (1, 2, 4):
        found = (noise[cells:] * noise[:-cells]).mean() / noise.var()
        assert found == pytest.approx(math.exp(-((0.1 * cells) ** 2) / (4 * 0.15**2)), abs=0.05)


def test_what_is_missed_is_marked_and_filled() -> None:
    known = np.ones((80, 60), bool)
    known[:10] = False
    pile = plane(known)
    scan = Scanner(patches=0.03, rows=0.05).scan(pile, np.random.default_rng(2))
    seen = np.asarray(scan.valid)
    assert not seen[:10].any()
    missed = known & ~seen
    assert 0.04 < missed.mean() < 0.09
    # Of the 80 lines along x or the 60 along y, a twentieth, beside those that were unseen before.
    columns, lines = (int(np.sum(~seen.any(axis=axis))) for axis in (0, 1))
    assert columns == 3 or lines - 10 >= 2
    assert np.isfinite(np.asarray(scan.height)).all()
    np.testing.assert_allclose(
        np.asarray(scan.height)[seen], np.asarray(pile.height)[seen], rtol=1e-6
    )


# --- rows


def test_rows_are_made_once_and_anew_where_the_setup_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "there" / "rows.jsonl"
    made: list[int] = []

    def make() -> dict[str, int]:
        made.append(len(made))
        return {"number": made[-1]}

    first = Rows(path, {"loads": 2})
    assert first.get("a", make) == {"number": 0}
    assert first.get("a", make) == {"number": 0}
    again = Rows(path, {"loads": 2})
    assert again.get("a", make) == {"number": 0}
    assert again.get("b", make) == {"number": 1}
    assert Rows(path, {"loads": 3}).get("a", make) == {"number": 2}
    # The models that ship were trained anew.
    monkeypatch.setattr("experiments._common.rows.of_package", lambda: {"weights": "other"})
    assert Rows(path, {"loads": 3}).get("a", make) == {"number": 3}
    assert made == [0, 1, 2, 3]


# --- what is compared


def row(pile: str, plan: str, drive: str, cost: float) -> dict[str, object]:
    sums = {"cost": cost, "mass": 2.0, "time": 10.0, "energy": 5.0}
    return {"pile": pile, "condition": "noise", "plan": plan, "drive": drive, **sums}


def test_pairs_are_of_the_same_pile_and_the_interval_is_students() -> None:
    once = {"a": 100.0, "b": 200.0, "c": 50.0}
    change = {"a": 0.9, "b": 1.0, "c": 0.95}
    rows = [
        row(name, plan, drive, cost * (change[name] if plan == closed_loop.ANEW else 1.0))
        for name, cost in once.items()
        for plan, drive in closed_loop.WAYS[:-1]
    ]
    for found in closed_loop.differences(rows, closed_loop.ANEW, closed_loop.OPEN):
        assert found["cost"] == pytest.approx([-5.0, 4.303 * 5.0 / math.sqrt(3.0)], rel=1e-3)
        assert (found["pairs"], found["cheaper"]) == (3, 2)
        assert found["seconds_a_tonne"] == [0.0, 0.0]
    # Careful costs here what planning once does, on one pile as much as after every scan.
    beside = ((closed_loop.ANEW, closed_loop.PLACE),)
    (found,) = closed_loop.differences(rows, closed_loop.CAREFUL, beside)
    assert found["cost"][0] == pytest.approx(100.0 * (1.0 / 0.9 + 1.0 / 0.95 - 2.0) / 3.0, rel=1e-3)
    assert (found["condition"], found["pairs"], found["cheaper"]) == ("noise", 3, 0)


def test_driving_on_ends_at_the_toe_of_the_pile_as_it_is() -> None:
    pile = cone()
    before = Pose(*(jnp.asarray([v], jnp.float32) for v in (-6.0, 0.0, 0.0)))
    at = closed_loop._on_to_the_toe(pile, before)
    further = closed_loop._on_to_the_toe(pile, at)
    assert float(at.x[0]) > -6.0
    np.testing.assert_allclose(further.x, at.x, atol=0.02)
    assert float(at.y[0]) == 0.0
