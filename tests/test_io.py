"""Round trips of scans and plans, and one clear line for every file that cannot be used."""

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from laws import volume
from scan_files import refused, save

from wlplan import io
from wlplan.errors import InputError
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import toe_contour
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose

# Spoils a document.
Change = Callable[[dict[str, Any]], object]

SLOPE = math.radians(30.0)


@pytest.fixture
def pile() -> Pile:
    return seed_pile("conical", slope=SLOPE, height=2.0, seed=1)


@pytest.fixture
def fields(pile: Pile) -> dict[str, Any]:
    """What a valid .npz holds."""
    return {"height": np.asarray(pile.height), "cell_size": 0.1, "origin": np.asarray(pile.origin)}


# --- the bundled pile


def test_the_bundled_pile_is_read_with_its_ground() -> None:
    pile = io.read_pile(io.bundled_pile_path())
    assert pile.cell_size == 0.1
    assert pile.ground is not None
    assert pile.valid is not None
    assert pile.height.shape == pile.ground.shape == pile.valid.shape == (190, 160)
    assert (pile.ground <= pile.height).all()
    assert 130.0 < volume(pile) < 200.0
    contour = toe_contour(pile)
    assert 40.0 < contour.length < 60.0
    assert contour.accessible.sum() > 300


def test_the_bundled_pile_ships_with_its_provenance() -> None:
    page = io.bundled_pile_path().with_suffix(".md").read_text()
    assert "LeoRover/leo_simulator" in page
    assert "MIT" in page


# --- npz


def test_a_written_pile_reads_back_the_same(tmp_path: Path, pile: Pile) -> None:
    valid = np.ones(pile.height.shape, bool)
    valid[:5] = False
    pile = pile.replace(valid=jnp.asarray(valid), ground=pile.height * 0.1)
    io.write_pile(tmp_path / "pile.npz", pile)
    again = io.read_pile(tmp_path / "pile.npz")
    for name in ("height", "ground", "valid", "origin"):
        np.testing.assert_array_equal(getattr(again, name), getattr(pile, name))
    assert again.cell_size == pile.cell_size


def test_level_ground_comes_out_as_zero(tmp_path: Path, fields: dict[str, Any]) -> None:
    ground = io.read_pile(save(tmp_path / "pile.npz", fields)).ground
    assert ground is not None
    assert not ground.any()


def test_a_map_without_a_pile_is_read(tmp_path: Path, fields: dict[str, Any]) -> None:
    fields["height"] = np.zeros((60, 60))
    pile = io.read_pile(save(tmp_path / "pile.npz", fields))
    with pytest.raises(InputError, match="Nothing to dig"):
        toe_contour(pile)


def test_a_map_of_another_spacing_is_resampled(tmp_path: Path, fields: dict[str, Any]) -> None:
    fields.update(cell_size=0.25, height=2.5 * fields["height"])
    pile = io.read_pile(save(tmp_path / "pile.npz", fields))
    assert pile.cell_size == 0.1
    want = float(np.sum(fields["height"])) * 0.25**2
    assert volume(pile) == pytest.approx(want, rel=0.01)


def test_unseen_cells_may_hold_anything_and_are_filled(
    tmp_path: Path, fields: dict[str, Any]
) -> None:
    height = fields["height"]
    valid = np.ones(height.shape, bool)
    valid[20:24, 30:40] = valid[60, 60:62] = valid[5, 5] = False
    broken = height.copy()
    broken[20:24, 30:40], broken[60, 60], broken[5, 5] = np.nan, np.inf, -9999.0
    broken[60, 61] = kept = 0.5 * height.max()
    fields.update(height=broken, valid=valid)
    pile = io.read_pile(save(tmp_path / "pile.npz", fields))
    np.testing.assert_array_equal(pile.valid, valid)
    np.testing.assert_array_equal(np.asarray(pile.height)[valid], height[valid])
    assert pile.height[60, 61] == pytest.approx(kept)  # a plausible fill is kept
    np.testing.assert_allclose(pile.height, height, atol=0.7)


def test_the_ground_of_the_file_is_used_unless_one_is_passed(
    tmp_path: Path, fields: dict[str, Any]
) -> None:
    fields["ground"] = np.full(fields["height"].shape, -0.25)
    path = save(tmp_path / "pile.npz", fields)
    np.testing.assert_array_equal(io.read_pile(path).ground, -0.25)
    np.testing.assert_array_equal(io.read_pile(path, ground=-1.0).ground, -1.0)
    lower = fields["height"] - 0.5
    np.testing.assert_allclose(
        np.asarray(io.read_pile(path, ground=lower).ground), lower, atol=1e-6
    )
    above = io.read_pile(path, ground=1.0)
    assert above.ground is not None
    assert (above.ground <= above.height).all()


def test_survey_coordinates_keep_their_last_digits(tmp_path: Path, fields: dict[str, Any]) -> None:
    fields["origin"] = np.array([431_012.25, 6_512_503.5])
    fields["height"] = fields["height"].astype(np.float64) + 1234.5
    fields["ground"] = np.full(fields["height"].shape, 1234.5)
    pile = io.read_pile(save(tmp_path / "pile.npz", fields))
    np.testing.assert_allclose(pile.origin, [12.25, 503.5])
    assert float(pile.height.min()) == pytest.approx(34.5)
    np.testing.assert_allclose(np.asarray(pile.ground), 34.5)


def without(name: str) -> Change:
    return lambda fields: fields.pop(name)


def setting(name: str, value: object) -> Change:
    return lambda fields: fields.update({name: value})


def nan_in(name: str) -> Change:
    def change(fields: dict[str, Any]) -> None:
        fields[name] = fields.get(name, np.zeros(fields["height"].shape)).copy()
        fields[name][3, 4] = np.nan

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (without("height"), "no field `height`"),
        (without("cell_size"), "no field `cell_size`"),
        (setting("cell_size", -0.1), "positive"),
        (setting("cell_size", 0.0), "positive"),
        (setting("cell_size", np.nan), "positive"),
        (setting("cell_size", np.inf), "positive"),
        (setting("cell_size", np.array([0.1, 0.1])), "one number"),
        (setting("cell_size", "0.1"), "real numbers"),
        (setting("cell_size", 0.01), "too small for a bucket"),
        (setting("cell_size", 10.0), "may have 4000 cells"),
        (setting("height", np.zeros((3, 50))), "too small for a bucket"),
        (setting("height", np.zeros((0, 50))), "too small for a bucket"),
        (setting("height", np.zeros(100)), "2-D"),
        (setting("height", np.zeros((50, 50, 1))), "2-D"),
        (setting("height", np.zeros((4001, 41), np.int8)), "may have 4000 cells"),
        (setting("height", np.zeros((50, 50), complex)), "real numbers"),
        (setting("height", np.full((50, 50), "a")), "real numbers"),
        (setting("height", np.full((50, 50), None)), "Python objects"),  # would need pickle
        (setting("height", np.full((50, 50), np.inf)), "2500 cells that count as seen"),
        (setting("valid", np.ones((5, 5), bool)), "`valid` has shape"),
        (setting("valid", np.full((111, 111), 7)), "`valid`"),
        (setting("ground", np.zeros((5, 5))), "`ground` has shape"),
        (setting("ground", np.zeros(5)), "`ground` has shape"),
        (nan_in("ground"), "`ground` is NaN"),
        (setting("ground", np.full((139, 139), -9999.0)), "`ground` is NaN or more than 200 m"),
        (setting("height", np.eye(50) * 1e4), "no pile: check the units"),
        (setting("height", np.full((50, 50), 1e300)), "no pile: check the units"),
        (setting("origin", np.array([0.0, 1e30])), "`origin`"),
        (setting("origin", np.zeros(3)), "`origin`"),
        (setting("origin", np.array([0.0, np.nan])), "`origin`"),
        (setting("origin", np.array(["a", "b"])), "`origin`"),
    ],
)
def test_bad_fields_are_refused(
    tmp_path: Path, fields: dict[str, Any], change: Change, match: str
) -> None:
    change(fields)
    refused(save(tmp_path / "pile.npz", fields), match)


def test_a_map_that_was_not_seen_is_refused(tmp_path: Path, fields: dict[str, Any]) -> None:
    fields["valid"] = np.zeros(fields["height"].shape, bool)
    refused(save(tmp_path / "pile.npz", fields), "no cell counts as seen")


def test_valid_may_be_zeros_and_ones(tmp_path: Path, fields: dict[str, Any]) -> None:
    fields["valid"] = np.ones(fields["height"].shape, np.uint8)
    fields["valid"][0, 0] = 0
    valid = io.read_pile(save(tmp_path / "pile.npz", fields)).valid
    assert valid is not None
    assert not valid[0, 0]


def test_missing_files_folders_and_strange_names_are_refused(tmp_path: Path) -> None:
    refused(tmp_path / "none.npz", "no such pile file")
    (tmp_path / "folder.npz").mkdir()
    refused(tmp_path / "folder.npz", "is a folder")
    refused(tmp_path / ("n" * 300 + ".npz"), "no such pile file")
    for name in ("pile.doc", "pile"):
        (tmp_path / name).write_text("x")
        refused(tmp_path / name, "unknown kind of pile file")


# --- plans


@pytest.fixture
def plan() -> LoadingPlan:
    pose = Pose(*(jnp.asarray(values) for values in ([0.0, 1.0], [2.0, 3.0], [0.5, -0.5])))
    action = Action(*(jnp.asarray(v) for v in ([0.7, 0.1], [5.0, 4.5], [0.0, 0.2], [2.5, 0.0])))
    return LoadingPlan(pose=pose, action=action)


@pytest.fixture
def document(plan: LoadingPlan) -> dict[str, Any]:
    performance = Performance(*(jnp.asarray([a, a + 1.0]) for a in (3.0, 11.0, 400.0)))
    transport = {"time": jnp.asarray([5.0, 6.0]), "work": np.zeros(2)}
    return io.plan_to_dict(plan, predicted=performance, transport=transport, world="low", seed=3)


def test_a_plan_reads_back_the_same(
    tmp_path: Path, plan: LoadingPlan, document: dict[str, Any]
) -> None:
    io.write_plan(tmp_path / "plan.json", document)
    again, data = io.read_plan(tmp_path / "plan.json")
    for part in ("pose", "action"):
        for name, values in vars(getattr(plan, part)).items():
            np.testing.assert_array_equal(getattr(getattr(again, part), name), values)
    assert data["format"] == "wlplan.plan/1"
    assert data["seed"] == 3
    load = data["loads"][1]
    assert load["predicted"] == {"mass": 4.0, "time": 12.0, "work": 401.0}
    assert load["transport"] == {"time": 6.0, "work": 0.0}
    assert "simulated" not in load


def test_numbers_of_numpy_and_jax_are_written(tmp_path: Path, document: dict[str, Any]) -> None:
    document.update(seed=np.int64(4), total={"mass": jnp.asarray(1.5), "all": np.ones(2)})
    io.write_plan(tmp_path / "plan.json", document)
    _, data = io.read_plan(tmp_path / "plan.json")
    assert (data["seed"], data["total"]) == (4, {"mass": 1.5, "all": [1.0, 1.0]})


def refused_plan(path: Path, match: str) -> None:
    with pytest.raises(InputError, match=match) as error:
        io.read_plan(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def in_load(name: str, value: object) -> Change:
    return lambda data: data["loads"][1].update({name: value})


def in_action(name: str, value: object) -> Change:
    return lambda data: data["loads"][1]["action"].update({name: value})


BAD_PLANS = [
    (setting("format", "wlplan.plan/2"), "has format"),
    (without("format"), "has format"),
    (without("loads"), "no loads"),
    (setting("loads", []), "no loads"),
    (setting("loads", {}), "no loads"),
    (setting("loads", [3]), "load 1: `x` is missing"),
    (lambda data: data["loads"][1].pop("heading"), "load 2: `heading` is missing"),
    (lambda data: data["loads"][1].pop("action"), "load 2: `action` is missing"),
    (lambda data: data["loads"][1]["action"].pop("k_bm"), "load 2, action: `k_bm` is missing"),
    (in_load("action", 7), "load 2, action: `delta_bm` is missing"),
    (in_load("x", "east"), "load 2: `x` is 'east', not a finite number"),
    (in_load("x", None), "not a finite number"),
    (in_load("x", True), "not a finite number"),
    (in_load("x", 10**400), "not a finite number"),
    (in_load("x", math.nan), "holds NaN"),
    (in_load("predicted", {"mass": math.inf}), "holds Infinity"),
    (in_action("delta_bm", 0.8), "load 2: delta_bm is 0.8, outside its range 0 to 0.7"),
    (in_action("k_bk", -0.1), "load 2: k_bk is -0.1, outside its range 0 to 5"),
]


@pytest.mark.parametrize(("change", "match"), BAD_PLANS)
def test_bad_plans_are_neither_read_nor_written(
    tmp_path: Path, document: dict[str, Any], change: Change, match: str
) -> None:
    path = tmp_path / "plan.json"
    change(document)
    path.write_text(json.dumps(document))
    refused_plan(path, match)
    path.unlink()
    with pytest.raises(InputError, match=match):
        io.write_plan(path, document)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "3", "null", "[" * 100_000, "\x00", '{"format": "wlplan.plan/1"', "1e999"],
)
def test_files_that_are_no_plans_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "plan.json").write_text(text)
    refused_plan(tmp_path / "plan.json", "plan")


def test_plans_that_are_no_text_or_no_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_bytes(b"\xff\xfe\x00")
    refused_plan(tmp_path / "plan.json", "cannot be read")
    refused_plan(tmp_path / "none.json", "no such plan file")
    refused_plan(tmp_path, "is a folder")


def test_actions_that_went_through_float32_are_put_back_into_the_box(
    tmp_path: Path, document: dict[str, Any]
) -> None:
    document["loads"][0]["action"].update(delta_bm=0.7 + 1e-8, k_bm=-1e-8)
    io.write_plan(tmp_path / "plan.json", document)
    plan, _ = io.read_plan(tmp_path / "plan.json")
    assert plan.action.k_bm[0] == 0.0


# --- writing in one piece


def test_files_are_replaced_in_one_piece(tmp_path: Path) -> None:
    path = tmp_path / "note.txt"
    io.write_text_atomic(path, "ä")
    io.write_text_atomic(path, "ö")
    assert path.read_text(encoding="utf-8") == "ö"
    assert [entry.name for entry in tmp_path.iterdir()] == ["note.txt"]


@pytest.mark.parametrize("failure", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    path = tmp_path / "note.txt"
    path.write_text("old")

    def fail(*_: object) -> None:
        raise failure

    monkeypatch.setattr(os, "replace", fail)
    expected = InputError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        io.write_text_atomic(path, "new")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["note.txt"]


def test_places_that_cannot_be_written_are_refused(tmp_path: Path, pile: Pile) -> None:
    for path in (tmp_path / "none" / "pile.npz", tmp_path / ("n" * 300 + ".npz")):
        with pytest.raises(InputError, match="cannot be written") as error:
            io.write_pile(path, pile)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"\.npz"):
        io.write_pile(tmp_path / "pile.tif", pile)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        io.write_text_atomic(tmp_path / "folder", "text")
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]
