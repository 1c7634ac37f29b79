"""What the page shows in three dimensions is the pile of the plan, load by load."""

import base64
import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from cones import cone, wide_cone

from wlplan.planning.piles import heights_after
from wlplan.report.headline import (
    FUEL_A_MEGAJOULE,
    foreseen,
    headline,
    key_figures,
    trucks_said,
)
from wlplan.report.scene import scene_of
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose

OFFSET = [412000.0, 5310000.0, 0.0]


def lowered(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Takes a square metre down by 10 cm, where the pose is."""
    del action
    x = pile.origin[0] + pile.cell_size * jnp.arange(pile.height.shape[0])
    y = pile.origin[1] + pile.cell_size * jnp.arange(pile.height.shape[1])
    hit = (abs(x - pose.x) < 0.5)[:, None] & (abs(y - pose.y) < 0.5)[None]
    one = jnp.ones(())
    return pile.replace(height=jnp.where(hit, pile.height - 0.1, pile.height)), Performance(
        one, one, one
    )


def plan(truck: list[int] | None = None) -> LoadingPlan:
    three = jnp.zeros(3)
    return LoadingPlan(
        pose=Pose(jnp.array([-3.0, -2.5, -2.0]), jnp.array([0.0, 0.5, 0.0]), three),
        action=Action(*(three + 0.5 for _ in range(4))),
        truck=None if truck is None else jnp.array(truck),
    )


def document(**more: Any) -> dict[str, Any]:
    poses = plan().pose
    loads = [
        {"x": float(x), "y": float(y), "heading": 0.0, "simulated": {"mass": 4.25, "time": 9.6}}
        for x, y in zip(poses.x, poses.y, strict=True)
    ]
    path = {"points": [[-8.0 - s, 0.0, 0.0, -1 if s < 2 else 1] for s in range(4)]}
    loads[1]["path"] = path
    return {
        "loads": loads,
        "receiver": {"x": -10.0, "y": -5.0, "heading": 0.5},
        "frame": {"offset": OFFSET},
        **more,
    }


def numbers(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<i2").astype(int)


def unpacked(scene: dict[str, Any]) -> list[np.ndarray]:
    """Heights before each load and after the last, as a page makes them [m]."""
    shape = len(scene["x"]), len(scene["y"])
    whole = numbers(scene["heights"]).reshape(shape).copy()
    found = [whole.copy()]
    for change in scene["changes"]:
        (i, j), (a, b) = change["at"], change["size"]
        whole[i : i + a, j : j + b] = numbers(change["heights"]).reshape(a, b)
        found.append(whole.copy())
    return [scene["lowest"] + scene["step"] * heights for heights in found]


def test_the_page_has_the_heights_of_every_load() -> None:
    pile = cone()
    heights = heights_after(lowered, pile, plan())
    scene = scene_of(pile, heights, document())
    json.dumps(scene, allow_nan=False)
    first, second = np.asarray(pile.origin)
    rows = np.rint((np.array(scene["x"]) - first) / pile.cell_size).astype(int)
    columns = np.rint((np.array(scene["y"]) - second) / pile.cell_size).astype(int)
    whole = np.concatenate([np.asarray(pile.height)[None], heights])
    for shown, truth in zip(unpacked(scene), whole, strict=True):
        np.testing.assert_allclose(shown, truth[np.ix_(rows, columns)], atol=0.5 * scene["step"])
    # Each load changes about a square metre, and no more is kept of it.
    assert all(max(change["size"]) <= 12 for change in scene["changes"])


def test_a_load_that_is_not_made_changes_nothing() -> None:
    pile = cone()
    heights = heights_after(lowered, pile, plan([0, -1, 0]))
    np.testing.assert_array_equal(heights[0], heights[1])
    assert np.abs(heights[2] - heights[1]).max() == pytest.approx(0.1, rel=1e-3)


def test_a_large_map_is_thinned_out() -> None:
    pile = wide_cone()
    far = {"x": -30.0, "y": -5.0, "heading": 0.5}
    heights = np.asarray(pile.height)[None].repeat(3, 0)
    scene = scene_of(pile, heights, document(receiver=far))
    assert max(len(scene["x"]), len(scene["y"])) <= 200
    np.testing.assert_allclose(np.diff(scene["x"]), 2.0 * pile.cell_size, atol=2e-3)


def test_loads_go_to_their_truck_and_are_said_in_the_coordinates_of_the_scan() -> None:
    pile = cone()
    places = [{"x": -10.0, "y": -5.0, "heading": 0.5}, {"x": -9.0, "y": 6.0, "heading": 0.0}]
    trucks = [{**places[0], "loads": [0]}, {**places[1], "loads": [1, 2]}]
    scene = scene_of(pile, np.asarray(pile.height)[None].repeat(3, 0), document(trucks=trucks))
    assert len(scene["trucks"]) == 2
    assert [load["truck"] for load in scene["loads"]] == [0, 1, 1]
    assert scene["said"][0] == "at 411997.0, 5310000.0; 4.2 t in 10 s"
    gears = [point[3] for point in scene["loads"][1]["path"]]
    assert gears == [-1, 1]
    assert scene["loads"][0]["path"] == []
    low, high = np.array(scene["view"])
    for truck in scene["trucks"]:
        for part in (truck["bed"], truck["cab"]):
            assert (np.array(part) > low).all()
            assert (np.array(part) < high).all()


def test_the_headline_adds_up() -> None:
    total = {
        "simulated": {"mass": 40.0, "time": 100.0, "work": 5000.0},
        "transport": {"time": 200.0, "work": 3000.0, "wait": 60.0},
    }
    found = headline({"loads": [{}] * 10, "total": total})
    parts = ("digging", "driving", "dumping", "waiting")
    assert found["time"] == sum(found[part] for part in parts) == 360.0
    assert found["rate"] == pytest.approx(400.0)
    assert found["energy"] == pytest.approx(8.0)
    # A machine of the class burns ten to twenty litres an hour.
    assert found["fuel"] == pytest.approx(8.0 * FUEL_A_MEGAJOULE)
    assert 9.0 < found["fuel"] * 10.0 < 20.0
    assert np.isnan(headline({})["mass"])


def test_what_was_foreseen_drives_and_dumps_as_long() -> None:
    total = {
        "simulated": {"mass": 40.0, "time": 100.0, "work": 5000.0},
        "predicted": {"mass": 44.0, "time": 90.0, "work": 4000.0},
        "transport": {"time": 200.0, "work": 3000.0, "wait": 60.0},
    }
    found = foreseen({"loads": [{}] * 10, "total": total})
    assert found["time"][0] == 350.0
    assert found["energy"][0] == pytest.approx(7.0)
    assert all(np.isnan(half) for _, half in found.values())
    exact = {**total, "deviation": {"mass": 0.0, "time": 0.0, "work": 0.0}}
    assert all(half == 0.0 for _, half in foreseen({"total": exact}).values())
    assert foreseen({}) == {}
    played = {name: total[name] for name in ("simulated", "transport")}
    assert foreseen({"total": played}) == {}


def test_the_key_figures_of_a_picture_are_those_of_the_page() -> None:
    total = {
        **{"simulated": {"mass": 40.0, "time": 100.0, "work": 5000.0}},
        **{"predicted": {"mass": 44.0, "time": 90.0, "work": 4000.0}},
        **{"transport": {"time": 200.0, "work": 3000.0}},
        **{"deviation": {"mass": 1.0, "time": 1.0, "work": 100.0}},
    }
    found = dict(key_figures({"loads": [{}] * 10, "total": total}))
    assert found["40.0 t"] == "in 10 loads\nforeseen 44.0 ± 2 t"
    assert "waiting" not in found["5\u00a0min 00\u00a0s"]
    assert key_figures({"loads": [{}], "total": {}})[0] == ("– t", "in 1 load")
    trucks = [{"payload": 18.0, "mass": mass} for mass in (17.9, 18.2)]
    assert key_figures({"trucks": trucks})[1] == ("2 trucks", "with 17.9 to 18.2 t\nof 18 t")


def test_trucks_are_said_with_payload_and_last_bucket() -> None:
    loads = [{"simulated": {"mass": mass}} for mass in (4.5, 4.4, 3.25)]
    trucks = [{"mass": 8.9, "payload": 9.0, "loads": [0, 1]}, {"mass": 3.25, "loads": [2]}]
    assert trucks_said({"loads": loads, "trucks": trucks}) == [
        "truck 1: 8.9 t of 9 t (99 %) in 2 loads, the last 4.4 t",
        "truck 2: 3.2 t in 1 load, the last 3.2 t",
    ]
