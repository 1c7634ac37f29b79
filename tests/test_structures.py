"""What is not soil: found where it stands, left standing, and no way through it."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from areas import features, square
from laws import assert_volume_kept, volume

import wlplan
from wlplan.errors import InputError
from wlplan.io import read_scan
from wlplan.site.frame import LOCAL
from wlplan.terrain.automaton import (
    DEFAULT_SCHEDULE,
    Schedule,
    converged,
    relax,
    settle,
    settle_dug,
)
from wlplan.terrain.excavation import excavate
from wlplan.terrain.heightmap import add_local_change
from wlplan.terrain.standing import lower_envelope, standing
from wlplan.terrain.structures import find_structures
from wlplan.terrain.toe import toe_contour
from wlplan.types import Action, Pile, Pose

CELL = 0.1
SLOPE = np.tan(np.radians(32.0))


def plane(x1: float = 30.0, y1: float = 24.0, cell: float = CELL) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(
        np.arange(0.5 * cell, x1, cell), np.arange(0.5 * cell, y1, cell), indexing="ij"
    )
    return x, y


def cone(x: np.ndarray, y: np.ndarray, at: tuple[float, float] = (18.0, 10.0)) -> np.ndarray:
    height: np.ndarray = np.maximum(0.0, 3.5 - np.hypot(x - at[0], y - at[1]) * SLOPE)
    return height


def turned(
    x: np.ndarray, y: np.ndarray, at: tuple[float, float], angle: float, sides: tuple[float, float]
) -> np.ndarray:
    """Cells of a rectangle."""
    u = (x - at[0]) * np.cos(angle) + (y - at[1]) * np.sin(angle)
    v = (y - at[1]) * np.cos(angle) - (x - at[0]) * np.sin(angle)
    inside: np.ndarray = (np.abs(u) <= 0.5 * sides[0]) & (np.abs(v) <= 0.5 * sides[1])
    return inside


def save(path: Path, height: np.ndarray, cell: float = CELL, **more: Any) -> Path:
    np.savez(path, height=height, cell_size=cell, **more)
    return path


def rough(height: np.ndarray, scatter: float = 0.02, seed: int = 3) -> np.ndarray:
    noisy: np.ndarray = height + np.random.default_rng(seed).normal(0.0, scatter, height.shape)
    return noisy


# --- finding


@pytest.mark.parametrize("cell", [0.1, 0.2])
def test_walls_boxes_and_buildings_are_found_at_any_angle(cell: float) -> None:
    """Random things beside a pile: each is found, and the pile keeps its volume."""
    random = np.random.default_rng(1)
    x, y = plane(cell=cell)
    pile = cone(x, y)
    for number in range(12):
        kind = number % 4
        sides = ((8.0, 0.4), (6.0, 2.4), (2.0, 1.6), (7.0, 5.0))[kind]
        tall = (2.5, 2.6, 1.8, 4.0)[kind]
        at = (random.uniform(4.0, 8.0), random.uniform(5.0, 19.0))
        cells = turned(x, y, at, random.uniform(0.0, np.pi), sides)
        height = rough(np.where(cells, tall, pile), seed=number)
        labels, found = find_structures(height, cell, np.array([0.5 * cell] * 2))
        assert len(found) == 1, (number, found)
        assert np.hypot(found[0].x - at[0], found[0].y - at[1]) < 0.5
        assert found[0].length == pytest.approx(sides[0], abs=0.5 + 2 * cell)
        assert found[0].height == pytest.approx(tall, abs=0.15)
        # All of it, and next to nothing else.
        assert (labels[cells] > 0).mean() > 0.97
        outside = (labels > 0) & ~cells
        assert outside.sum() * cell**2 < 2.5 * cell * 2.0 * sum(sides)


def test_piles_are_no_structures() -> None:
    """Noise, fresh faces of 50 degrees, ridges, single spikes."""
    x, y = plane()
    steep = np.clip((9.0 - np.abs(x - 15.0)) * np.tan(np.radians(50.0)), 0.0, 3.0)
    spiked = rough(cone(x, y), 0.03)
    spiked[40, 40] += 3.0
    for height in (rough(cone(x, y), 0.03), rough(steep, 0.02), spiked):
        labels, found = find_structures(height, CELL, np.zeros(2))
        assert not found
        assert not labels.any()


def test_a_pile_that_leans_on_a_building_is_soil() -> None:
    x, y = plane()
    height = rough(np.where(x < 10.0, 6.0, cone(x, y, (10.0, 12.0))))
    labels, (building,) = find_structures(height, CELL, np.zeros(2))
    assert building.kind == "block"
    assert (labels[x < 9.9] > 0).all()
    # But for the first decimetre, whose slope is the wall's.
    assert not (labels[x > 10.2] > 0).any()


def test_a_wall_in_a_scan_that_hardly_saw_anything_is_found() -> None:
    """Further from all that was seen than anything stands high, there is nothing to compare."""
    cell, cells = 0.1, 400
    height = np.zeros((cells, 40), np.float32)
    height[20:24, 10:30] = 3.0
    valid = np.zeros(height.shape, bool)
    valid[:40] = True
    labels, found = find_structures(height, cell, np.zeros(2), valid)
    assert len(found) == 1
    assert labels[22, 20] == 1
    assert not labels[40:].any()


def test_what_stands_over_a_sloping_floor() -> None:
    slope = 0.15 * CELL * np.arange(200)[:, None] * np.ones((1, 160))
    assert not standing(slope, CELL).any()
    slope[80:90, 60:70] += 1.0
    found = standing(slope, CELL)
    assert found[80:90, 60:70].all()
    assert found.sum() < 300


def test_the_envelope_is_the_cone_below() -> None:
    height = np.full((41, 41), 5.0)
    height[20, 20] = 0.0
    low = lower_envelope(height, 0.5, 40)
    assert low[20, 28] == pytest.approx(4.0)
    assert low[23, 23] == pytest.approx(0.5 * 3 * np.sqrt(2.0))
    assert low[0, 0] == 5.0


# --- a scan with them


def bay() -> np.ndarray:
    """Three walls 3 m high, open to the south, with soil almost as high."""
    x, y = plane()
    y = y + 4.0
    inside = (x > 10.8) & (x < 19.2) & (y < 22)
    soil = np.where(inside, np.clip(3.0 - 0.62 * np.maximum(0, 17 - y), 0, 2.8), 0.0)
    wall = (y > 22) & (y < 22.8) & (x > 10) & (x < 20)
    for side in (10.0, 19.2):
        wall |= (x > side) & (x < side + 0.8) & (y > 14) & (y < 22.8)
    return rough(np.where(wall, 3.0, soil))


def test_a_bay_is_dug_from_its_open_side(tmp_path: Path) -> None:
    scan = read_scan(save(tmp_path / "bay.npz", bay(), origin=np.array([500_000.05, 0.05])))
    (wall,) = scan.contents.structures
    assert wall.kind == "wall"
    (note,) = [note for note in scan.notes if "left standing" in note]
    assert "3.1 m high" in note
    assert "50001" in note
    x, y = plane()
    y = y + 4.0
    inside = (x > 10.8) & (x < 19.2) & (y < 22)
    soil = np.where(inside, np.clip(3.0 - 0.62 * np.maximum(0, 17 - y), 0, 2.8), 0.0)
    # The first decimetre along the walls counts as wall.
    assert float(volume(scan.pile)) == pytest.approx(float(soil.sum()) * CELL**2, rel=0.05)
    contour = toe_contour(scan.pile)
    points, heading = contour.points[contour.accessible], contour.heading[contour.accessible]
    assert len(points) > 40
    assert (np.abs(points[:, 0] - 15.0) < 4.3).all()
    # At the walls the toe turns along them, and with it the normal of its chord.
    assert (np.sin(heading) > 0.5).all()
    assert np.median(np.sin(heading)) > 0.99


def test_what_was_taken_out_can_be_put_back(tmp_path: Path) -> None:
    path = save(tmp_path / "bay.npz", bay())
    soil = read_scan(path, include=(10.4, 15.0))
    assert not soil.contents.structures
    assert float(volume(soil.pile)) > float(volume(read_scan(path).pile)) + 50.0
    with pytest.raises(InputError, match="nothing stands at 2"):
        read_scan(path, include=(2.0, 2.0))


def test_areas_that_people_draw(tmp_path: Path) -> None:
    x, y = plane()
    path = save(tmp_path / "a.npz", cone(x, y), origin=np.array([500_000.05, 0.05]))
    drawn = tmp_path / "areas.geojson"
    drawn.write_text(
        features(
            (square(500_002.0, 2.0, 3.0), {"height": 2.0}),
            (square(500_017.0, 9.0, 2.0), {"kind": "no-dig"}),
            (square(500_026.0, 2.0, 2.0), {"kind": "no-go"}),
        )
    )
    plain, scan = read_scan(path), read_scan(path, keep_out=str(drawn))
    height, ground = np.asarray(scan.pile.height), np.asarray(scan.pile.floor)
    box = (x > 2.0) & (x < 5.0) & (y > 2.0) & (y < 5.0)
    np.testing.assert_allclose(ground[box], 2.0, atol=1e-5)
    np.testing.assert_allclose(height[box], 2.0, atol=1e-5)
    kept = (x > 17.0) & (x < 19.0) & (y > 9.0) & (y < 11.0)
    np.testing.assert_array_equal(ground[kept], height[kept])
    lost = float(volume(plain.pile)) - float(volume(scan.pile))
    assert lost == pytest.approx(float(cone(x, y)[kept].sum()) * CELL**2, rel=0.01)
    assert scan.contents.closed is not None
    assert scan.contents.closed.sum() == 400
    assert [note for note in scan.notes if "no-go" in note]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not GeoJSON"),
        ("[]", "no features"),
        ('{"type": "FeatureCollection", "features": []}', "no polygon"),
        ('{"type": "Point", "coordinates": [1, 2]}', "no polygon"),
        ('{"type": "Polygon", "coordinates": [[[1, 2], [3, 4]]]}', "three corners"),
        ('{"type": "Polygon", "coordinates": [[["a", 2], [3, 4], [5, 6]]]}', "three corners"),
        (features((square(1.0, 1.0, 2.0), {"kind": "lake"})), "of kind 'lake'"),
        (features((square(1.0, 1.0, 2.0), {"height": -1})), "height is -1"),
        (features((square(900.0, 1.0, 2.0), {})), "no area lies in the scan"),
    ],
)
def test_areas_that_are_none_are_refused(tmp_path: Path, text: str, words: str) -> None:
    x, y = plane()
    path = save(tmp_path / "a.npz", cone(x, y))
    (tmp_path / "areas.geojson").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_scan(path, keep_out=str(tmp_path / "areas.geojson"))
    assert "\n" not in str(caught.value)


def test_the_pile_that_is_meant(tmp_path: Path) -> None:
    x, y = plane()
    two = np.maximum(0.8 * cone(x, y, (7.0, 12.0)), cone(x, y, (22.0, 12.0)))
    path = save(tmp_path / "two.npz", two)
    both, western = read_scan(path), read_scan(path, pile=(8.0, 12.0))
    (note,) = [note for note in both.notes if "2 piles" in note]
    assert "(planned), " in note
    assert "--pile X,Y, else long jobs go on to the next" in note
    (note,) = [note for note in western.contents.notes if "2 piles" in note]
    assert note.endswith("--pile X,Y")
    assert western.contents.planned is not None
    assert western.contents.planned.x == pytest.approx(7.0, abs=0.1)
    assert float(volume(western.pile)) == pytest.approx(both.contents.piles[1].volume, rel=0.02)
    assert toe_contour(western.pile).points[:, 0].max() < 14.0
    with pytest.raises(InputError, match="no pile at 15, 2: 2 piles in the scan"):
        read_scan(path, pile=(15.0, 2.0))
    assert LOCAL.local(1.0, 2.0) == (1.0, 2.0)


# --- laws


def walled(diagonal: bool) -> Pile:
    """Soil much steeper than it stands on one side of a wall of one cell, nothing on the other."""
    i, j = np.meshgrid(np.arange(120), np.arange(120), indexing="ij")
    # A diagonal whose cells touch at their sides.
    wall = np.abs(i + j - 120) <= 1 if diagonal else i == 60
    left = (i + j < 119) if diagonal else (i < 60)
    near = (119 - i - j if diagonal else 60 - i) < 20
    height = np.where(wall, 2.5, np.where(left & near, 2.0, 0.0)).astype(np.float32)
    ground = np.where(wall, 2.5, 0.0).astype(np.float32)
    return Pile(height, CELL, ground=ground)


@pytest.mark.parametrize("diagonal", [False, True])
def test_soil_does_not_pass_a_wall(diagonal: bool) -> None:
    before = walled(diagonal)
    after = relax(before, repose_angle=0.6)
    i, j = np.meshgrid(np.arange(120), np.arange(120), indexing="ij")
    beyond = (i + j > 121) if diagonal else (i > 60)
    above = np.asarray(after.height - after.floor, np.float64)
    assert above[beyond].sum() == 0.0
    assert above.sum() == pytest.approx(
        float(np.asarray(before.height - before.floor, np.float64).sum()), rel=1e-5
    )
    assert (np.asarray(after.height) >= np.asarray(after.floor) - 1e-6).all()
    assert not np.array_equal(np.asarray(after.height), np.asarray(before.height))


def parted(kind: str, shape: tuple[int, int] = (64, 72)) -> tuple[Pile, np.ndarray, np.ndarray]:
    """Soil much steeper than it stands on both sides of a wall of one cell; the cells of each side.

    It leans on the wall and slides on a floor that falls away from it. The "open" wall has an end,
    which the soil does not come near.
    """
    i, j = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    away = (i + j - 70) / np.sqrt(2.0) if kind == "diagonal" else i - 31.0
    along = (i - j) / np.sqrt(2.0) if kind == "diagonal" else j - 24.0
    # Cells of a diagonal touch at their sides.
    wall = (away > -0.1) & (away < 0.8) & ((kind != "open") | (along < 38))
    slope = np.tan(np.radians(28.0))
    floor = CELL * slope * np.clip(25 - np.abs(away), 0, None)
    ground = np.where(wall, 4.0, floor)
    tall = np.where(away < 0, 1.6, 1.1) - 0.12 * np.abs(away)
    blocks = 0.3 * ((np.abs(away) > 14) & (np.abs(away) < 19))
    soil = np.where(wall | (np.abs(along) > 18), 0.0, np.maximum(tall, blocks))
    noise = 0.02 * np.random.default_rng(0).random(shape) * (soil > 0)
    pile = Pile(jnp.asarray(ground + soil + noise), CELL, ground=jnp.asarray(ground))
    return pile, (away < 0) & ~wall, (away > 0) & ~wall


PLAIN = dataclasses.replace(DEFAULT_SCHEDULE, momentum=0.0)


@pytest.mark.parametrize("kind", ["straight", "diagonal", "open"])
@pytest.mark.parametrize("schedule", [DEFAULT_SCHEDULE, PLAIN], ids=["momentum", "plain"])
def test_soil_stays_on_its_side_of_a_wall(kind: str, schedule: Schedule) -> None:
    """Each side keeps its volume to rounding, and neither has a gradient in the other."""
    with jax.enable_x64(True):
        pile, left, right = parted(kind)

        def of_left(height: jax.Array) -> tuple[jax.Array, Pile]:
            after = settle(pile.replace(height=height), schedule=schedule).pile
            return jnp.where(left, after.height, 0.0).sum(), after

        (_, after), gradient = jax.value_and_grad(of_left, has_aux=True)(pile.height)
        assert float(jnp.abs(after.height - pile.height).max()) > 0.5
        for side in (left, right):
            assert_volume_kept(pile.height[side], after.height[side], relative=1e-13)
        np.testing.assert_allclose(gradient, np.where(left, 1.0, 0.0), atol=1e-12)
        assert (np.asarray(after.height) >= np.asarray(pile.floor) - 1e-12).all()


@pytest.mark.parametrize("kind", ["straight", "diagonal"])
def test_soil_stays_on_its_side_in_every_way_to_relax_it(kind: str) -> None:
    """A whole pile, several windows, a batch, and sweeps alone; in float32."""
    pile, *sides = parted(kind)
    pile = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), pile)
    start = (jnp.int32(12), jnp.int32(8))
    window = jax.lax.dynamic_slice(pile.height, start, (40, 40))
    after = {
        "relax": relax(pile).height,
        "windows": settle_dug(pile, window, start).pile.height,
        "batch": jax.vmap(lambda h: settle(pile.replace(height=h)).pile.height)(
            jnp.stack([pile.height, pile.height])
        )[1],
        "converged": converged(pile, tolerance=np.radians(5.0)).height,
    }
    for name, height in after.items():
        assert float(jnp.abs(height - pile.height).max()) > 0.3, name
        for side in sides:
            soil = [np.asarray(h - pile.floor, np.float64)[side] for h in (pile.height, height)]
            assert_volume_kept(*soil, relative=1e-5 if name == "converged" else 1e-6)


def test_ground_is_not_dug() -> None:
    """A cell whose surface is its ground never loses height."""
    before = walled(diagonal=False)
    pose = Pose(*(jnp.float32(v) for v in (5.0, 6.0, 0.0)))
    bare = np.asarray(before.height) == np.asarray(before.floor)
    dug = excavate(before, pose, jnp.float32(3.0), width=2.7).pile
    change = jnp.full((52, 52), -0.5, jnp.float32)
    written, _ = add_local_change(before.height, before, pose, change, 1.0)
    for after in (dug.height, written):
        assert (np.asarray(after)[bare] >= np.asarray(before.height)[bare] - 1e-6).all()
        assert float(jnp.abs(after - before.height).max()) > 0.1


def test_no_soil_is_made_of_what_cannot_be_taken() -> None:
    """Soil that a change takes from behind a wall stays there, so it is not laid down before it."""
    before = walled(diagonal=False)
    pose = Pose(*(jnp.float32(v) for v in (4.0, 6.0, 0.0)))
    along = 0.1 * np.arange(52) - 1.0
    take, lay = np.where(along > 2.6, -0.3, 0.0), np.where((along > 0.5) & (along < 1.5), 0.2, 0.0)
    for part in (0.0, 1.0, 20.0):
        profile = (take + part * lay).astype(np.float32)
        change = jnp.asarray(np.repeat(profile[:, None], 52, axis=1))
        after, missing = add_local_change(before.height, before, pose, change, 1.0)
        grown = float((after - before.height).sum()) * CELL**2
        # What lies nowhere comes from nowhere.
        net = float(change.sum()) * CELL**2
        assert grown == pytest.approx(max(net, 0.0), abs=1e-3)
        assert float(missing) == pytest.approx(max(-net, 0.0), abs=1e-3)


@pytest.mark.parametrize("name", ["simulator", "low", pytest.param("high", marks=pytest.mark.slow)])
@pytest.mark.parametrize("where", ["ahead", "beside", "across"])
def test_no_world_digs_a_wall_or_takes_soil_through_it(name: str, where: str) -> None:
    """Soil leans on a wall; a loader digs in front of it, along it, or towards it at an angle."""
    x, y = np.meshgrid(*(CELL * np.arange(140),) * 2, indexing="ij")
    from_wall = {"ahead": x - 8.0, "beside": y - 8.8, "across": (x + y - 15.5) / np.sqrt(2.0)}
    away = from_wall[where]
    wall, beyond = (away > -0.05) & (away < 0.25), away >= 0.25
    ground = np.where(wall, 2.5, 0.0).astype(np.float32)
    soil = np.where(away < 0.0, np.clip((x - 5.5) * SLOPE, 0.0, 2.4), 0.0).astype(np.float32)
    pile = Pile(np.maximum(soil, ground), CELL, ground=ground)
    world = wlplan.load_world(name)
    action = Action(*(jnp.float32(v) for v in (0.4, 2.0, 0.4, 2.0)))
    for load in range(3):
        pose = Pose(*(jnp.float32(v) for v in (5.6 + 0.5 * load, 7.0, 0.0)))
        bare = np.asarray(pile.height) == ground
        before, (pile, performance) = pile, world(pile, pose, action)
        height = np.asarray(pile.height)
        assert (height >= ground - 1e-5).all()
        # What is bare loses nothing, the wall is as high as it was, and beyond it nothing came.
        assert (height[bare] >= ground[bare] - 1e-5).all()
        np.testing.assert_allclose(height[wall], ground[wall], atol=1e-5)
        assert np.abs(height[beyond]).max() < 1e-5
        assert float(performance.mass) > 0.5
        assert float(jnp.abs(pile.height - before.height).max()) > 0.1


def test_what_lies_behind_a_wall_is_not_loaded() -> None:
    """In the simulator: a load leaves the pile whole, and is the same with soil there or none."""
    x, y = np.meshgrid(*(CELL * np.arange(140),) * 2, indexing="ij")
    soil = np.clip((x - 6.0) * SLOPE, 0.0, 2.4)
    ground = np.where((x > 6.95) & (x < 7.25), 2.5, 0.0).astype(np.float32)
    pose = Pose(*(jnp.float32(v) for v in (6.0, 7.0, 0.0)))
    action = Action(*(jnp.float32(v) for v in (0.4, 2.0, 0.4, 2.0)))
    world = wlplan.load_world("simulator")
    loads = []
    for lies in (soil, np.where(x < 7.0, soil, 0.0)):
        pile = Pile(np.maximum(lies, ground).astype(np.float32), CELL, ground=ground)
        _, performance, report = world.solve(pile, pose, action)  # type: ignore[attr-defined]
        assert abs(float(report.missing)) < 0.01
        loads.append(jax.tree.leaves(performance))
    one, other = np.asarray(loads)
    np.testing.assert_allclose(one, other, rtol=1e-4)
    # Before the bucket, and beside it, from where some slides in.
    before, around = (
        soil[(x < 6.95) & (np.abs(y - 7.0) < half)].sum() * CELL**2 * 1.727 for half in (1.35, 1.6)
    )
    assert 0.8 * before < one[0] <= around
