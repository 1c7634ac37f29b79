"""The area where trucks may stand: what fits into a polygon, and who keeps to it."""

import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from areas import features, square
from cones import bowl_world, wide_cone

from wlplan.errors import InputError
from wlplan.io import read_scan, write_pile
from wlplan.planning.job import make_job
from wlplan.planning.placement import beside, place_of, place_receiver, truck_cells, truck_stands_on
from wlplan.planning.spots import best_spots
from wlplan.planning.truck_area import places_inside, stands_inside
from wlplan.planning.watch import Watch
from wlplan.site.machine import WA320
from wlplan.site.polygon import Polygon, holds, is_inside
from wlplan.site.receiver import Receiver, truck_outline
from wlplan.site.site import Site
from wlplan.types import Pile


def ring(*corners: tuple[float, float]) -> np.ndarray:
    return np.array(corners, float)


def box(x0: float, y0: float, x1: float, y1: float, turn: float = 0.0) -> Polygon:
    c, s = math.cos(turn), math.sin(turn)
    corners = ring((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    return (corners @ np.array([[c, s], [-s, c]]),)


# An L, and a square with a hole in it.
CORNERED: Polygon = (ring((0, 0), (10, 0), (10, 4), (4, 4), (4, 10), (0, 10)),)
HOLLOW: Polygon = (*box(-6, -6, 6, 6), *box(-1, -1, 1, 1))
PILE = wide_cone()


def receiver(x: float, y: float, heading: float) -> Receiver:
    return Receiver(*(jnp.float32(value) for value in (x, y, heading)))


def all_of_the_truck(place: np.ndarray) -> np.ndarray:
    """Points all over the truck of a receiver, those on its outline included."""
    x, y = truck_cells(place[None], WA320)
    return np.stack([x[0], y[0]], axis=-1)


# --- geometry


def test_points_in_polygons_by_hand() -> None:
    points = np.array([[1.0, 9.0], [5.0, 5.0], [9.0, 3.9], [-1.0, 4.0], [3.9, 4.1]])
    np.testing.assert_array_equal(is_inside(CORNERED, points), [True, False, True, False, True])
    points = np.array([[0.0, 0.0], [0.0, 3.0], [7.0, 0.0]])
    np.testing.assert_array_equal(is_inside(HOLLOW, points), [False, True, False])


def test_rectangles_in_polygons_by_hand() -> None:
    # Along a leg of the L, across its inner corner, turned in the corner, and a hair too long.
    places = np.array([[5.0, 2.0, 0.0], [3.5, 3.5, 0.8], [2.0, 2.0, 0.8], [5.0, 2.0, 0.0]])
    np.testing.assert_array_equal(holds(CORNERED, places[:3], (8.0, 3.0)), [True, False, False])
    assert holds(CORNERED, places[3:], (9.999, 3.999)).all()
    assert not holds(CORNERED, places[3:], (10.001, 3.0)).any()
    # All corners inside, and a hole in the middle.
    assert not holds(HOLLOW, np.array([[0.0, 0.0, 0.3]]), (4.0, 4.0)).any()
    assert holds(HOLLOW, np.array([[0.0, 4.0, 0.0]]), (8.0, 3.0)).all()


def test_rectangles_in_polygons_against_their_points() -> None:
    """Whatever is held has all its points inside, and what is not held has some outside."""
    random = np.random.default_rng(0)
    places = random.uniform((-7.0, -7.0, 0.0), (11.0, 11.0, 6.3), (400, 3))
    sides = 3.0, 1.5
    across, along = np.meshgrid(np.linspace(-0.5, 0.5, 61), np.linspace(-0.5, 0.5, 31))
    for polygon in (CORNERED, HOLLOW):
        found = holds(polygon, places, sides)
        inside = []
        for x, y, heading in places:
            c, s = math.cos(heading), math.sin(heading)
            u, v = (sides[0] * across).ravel(), (sides[1] * along).ravel()
            points = np.stack([x + c * u - s * v, y + s * u + c * v], axis=-1)
            inside.append(is_inside(polygon, points).all())
        np.testing.assert_array_equal(found, inside)
        assert 20 < found.sum() < 380


@pytest.mark.parametrize("turn", [0.0, 0.41])
def test_a_truck_fits_into_what_is_hardly_larger(turn: float) -> None:
    near, far, half = truck_outline(WA320)
    long, wide = 2.0 * half, far - near
    places = places_inside((box(20.0, 5.0, 20.05 + long, 5.05 + wide, turn),), WA320)
    assert len(places) >= 2
    for place in places:
        assert is_inside(
            box(20.0, 5.0, 20.05 + long, 5.05 + wide, turn), all_of_the_truck(place)
        ).all()
    with pytest.raises(InputError, match=r"no truck, 7.0 m by 2.6 m, fits"):
        places_inside((box(20.0, 5.0, 19.9 + long, 5.05 + wide, turn),), WA320)


def test_a_truck_stands_in_one_polygon_not_in_two() -> None:
    halves = box(0.0, 0.0, 5.0, 9.0), box(5.0, 0.0, 10.0, 9.0)
    # Its middle is on the border between the two.
    near, far, _ = truck_outline(WA320)
    place = np.array([[5.0, 4.5 - 0.5 * (near + far), 0.5 * math.pi]])
    assert stands_inside(place, (box(0.0, 0.0, 10.0, 9.0),), WA320).all()
    assert not stands_inside(place, halves, WA320).any()
    assert stands_inside(place, None, WA320).all()


# --- who keeps to it

SOUTH = (box(-19.0, -19.0, 19.0, -9.0),)


@pytest.mark.parametrize("area", [SOUTH, (box(12.0, 6.0, 19.6, 9.0, 0.3),)])
def test_the_default_truck_and_the_best_spots_are_inside(area: tuple[Polygon, ...]) -> None:
    assert not stands_inside(place_of(beside(Site(), PILE).placed_receiver)[None], area, WA320)[0]
    site = beside(Site(truck_area=area), PILE)
    job = make_job(bowl_world, PILE, site=site, objective="delivery")
    spots = best_spots(job, seed=0, watch=Watch(), area=area)
    assert spots
    for spot in (site.placed_receiver, job.site.placed_receiver, *spots):
        assert any(is_inside(one, all_of_the_truck(place_of(spot))).all() for one in area)
        on, _ = truck_stands_on(place_of(spot)[None], PILE, np.asarray(PILE.height) > 0.25, WA320)
        assert on[0] == 0.0


def test_a_truck_that_is_given_has_to_be_inside() -> None:
    outside = receiver(-12.0, 4.0, 1.3)
    with pytest.raises(InputError, match=r"from -12.0, 4.0, heading 74°, does not stand inside"):
        beside(Site(receiver=outside, truck_area=SOUTH), PILE)
    assert beside(Site(receiver=outside), PILE).receiver == outside
    inside = receiver(-5.0, -9.0, -0.5 * math.pi)
    assert beside(Site(receiver=inside, truck_area=SOUTH), PILE).receiver == inside
    with pytest.raises(InputError, match="does not stand inside"):
        place_receiver(PILE, (-12.0, 4.0), area=SOUTH)
    # Without a heading it is one of those with which the truck is inside.
    for x in (-9.0, 0.0, 4.0):
        placed = place_receiver(PILE, (x, -10.5), area=SOUTH)
        assert stands_inside(place_of(placed)[None], SOUTH, WA320)[0]


def test_an_area_without_room_is_told() -> None:
    on_the_pile = (box(-2.0, -4.0, 2.0, 4.0),)
    with pytest.raises(InputError, match="no room in the area for trucks"):
        beside(Site(truck_area=on_the_pile), PILE)
    with pytest.raises(InputError, match="fits into the area for trucks"):
        beside(Site(truck_area=(box(10.0, 0.0, 13.0, 6.0),)), PILE)
    closed = np.asarray(PILE.height) < 9.0
    with pytest.raises(InputError, match="no room in the area for trucks"):
        beside(Site(truck_area=SOUTH, keep_out=jnp.asarray(closed)), PILE)


def test_the_default_truck_keeps_off_closed_ground() -> None:
    free = place_of(beside(Site(), PILE).placed_receiver)
    i, j = (np.rint((free[k] + 20.0) / 0.1).astype(int) for k in (0, 1))
    closed = np.zeros(PILE.height.shape, bool)
    closed[max(i - 60, 0) : i + 60, max(j - 60, 0) : j + 60] = True
    site = beside(Site(keep_out=jnp.asarray(closed)), PILE)
    on, _ = truck_stands_on(place_of(site.placed_receiver)[None], PILE, closed, WA320)
    assert on[0] == 0.0


# --- files


def drawn(folder: Path, *polygons: tuple[list[list[float]], dict[str, Any]]) -> str:
    path = folder / "trucks.geojson"
    path.write_text(features(*polygons))
    return str(path)


def scan_at(folder: Path, offset: float) -> tuple[str, Pile]:
    path, pile = folder / "scan.npz", PILE.replace(origin=PILE.origin)
    write_pile(path, pile)
    stored = dict(np.load(path))
    np.savez(path, **{**stored, "origin": np.array([offset - 20.0, -20.0])})
    return str(path), pile


def test_an_area_is_read_in_the_coordinates_of_the_scan(tmp_path: Path) -> None:
    path, _ = scan_at(tmp_path, 500_000.0)
    file = drawn(tmp_path, (square(500_008.0, -18.0, 9.0), {}), (square(0.0, 0.0, 1.0), {}))
    scan = read_scan(path, truck_area=file)
    assert scan.contents.truck_area is not None
    (first,) = scan.contents.truck_area[0]
    np.testing.assert_allclose(first[0], np.array([500_008.0, -18.0]) - scan.frame.offset[:2])
    assert [note for note in scan.notes if "trucks stand in 2 areas" in note]
    assert read_scan(path).contents.truck_area is None


@pytest.mark.parametrize(
    ("polygon", "words"),
    [
        ((square(8.0, -18.0, 9.0), {"kind": "no-go"}), "kind 'no-go': use one of truck"),
        ((square(7008.0, -18.0, 9.0), {}), "coordinates of the scan"),
    ],
)
def test_an_area_for_trucks_that_is_none_is_refused(
    tmp_path: Path, polygon: tuple[list[list[float]], dict[str, Any]], words: str
) -> None:
    path, _ = scan_at(tmp_path, 0.0)
    with pytest.raises(InputError, match=words) as caught:
        read_scan(path, truck_area=drawn(tmp_path, polygon))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="kind 'truck'"):
        read_scan(path, keep_out=drawn(tmp_path, (square(8.0, -18.0, 9.0), {"kind": "truck"})))
