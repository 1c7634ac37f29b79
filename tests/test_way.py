"""The way to the truck: curves that can be driven, exact lengths, room to drive, gradients."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_gradient

from wlplan.planning.clearance import FARTHEST, clearance
from wlplan.planning.driving import Room, Way, room_of
from wlplan.planning.lane import lane_touching
from wlplan.planning.placement import best_receiver, place_receiver, truck_stands_on
from wlplan.planning.way import points_of, way_to
from wlplan.planning.yard import Yard, packed_soil, unpacked_soil, yard_of
from wlplan.site.machine import WA320
from wlplan.site.receiver import Receiver, truck_outline
from wlplan.terrain.standing import standing
from wlplan.types import Pile, Pose

Place = tuple[float, float, float]  # x [m], y [m], heading [rad]

RADIUS = WA320.turning_radius
BACK = WA320.approach_distance
# A map of 36 m a side around the origin, which is where the loadings of these tests end.
CELLS, CORNER = 361, -18.0


def field(*boxes: tuple[float, float, float, float]) -> Pile:
    """Level ground with soil 1 m high in boxes x0, y0, x1, y1 [m]."""
    x, y = np.meshgrid(*(CORNER + 0.1 * np.arange(CELLS),) * 2, indexing="ij")
    height = np.zeros((CELLS, CELLS), np.float32)
    for x0, y0, x1, y1 in boxes:
        height[(x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)] = 1.0
    return Pile(height, 0.1, (CORNER, CORNER))


def pose_ending(start: Place) -> Pose:
    """The dig pose whose loading ends at a place."""
    x, y, heading = start
    at = x + BACK * math.cos(heading), y + BACK * math.sin(heading), heading
    return Pose(*(jnp.asarray(v, jnp.result_type(float)) for v in at))


def receiver_at(place: Place) -> Receiver:
    return Receiver(*(jnp.asarray(v, jnp.result_type(float)) for v in place))


@jax.jit
def _drive(pose: Pose, receiver: Receiver, room: Room) -> tuple[jax.Array, jax.Array, Way]:
    return way_to(pose, receiver, room, WA320)


OPEN = field()


def drive(start: Place, goal: Place, pile: Pile = OPEN) -> tuple[float, float, Way]:
    room = room_of(yard_of(pile, WA320), pile)
    length, touching, way = _drive(pose_ending(start), receiver_at(goal), room)
    return float(length), float(touching), way


def scenes(count: int) -> list[tuple[Place, Place]]:
    random = np.random.default_rng(5)
    found = []
    for _ in range(count):
        away, bearing = random.uniform(5.0, 14.0), random.uniform(math.pi / 2, 3 * math.pi / 2)
        goal = (away * math.cos(bearing), away * math.sin(bearing), random.uniform(-3.1, 3.1))
        found.append(((0.0, 0.0, 0.0), goal))
    return found


def test_points_are_a_way_that_can_be_driven() -> None:
    for start, goal in scenes(12):
        _, _, way = drive(start, goal)
        points = points_of(way, RADIUS)
        np.testing.assert_allclose(points[0, :3], start, atol=2e-3)
        turn = math.remainder(points[-1, 2] - goal[2], 2 * math.pi)
        assert [*points[-1, :2], turn] == pytest.approx([*goal[:2], 0.0], abs=2e-3)
        # Backwards first, then forwards, one change.
        gear = points[:, 3]
        assert set(gear) <= {-1.0, 1.0}
        assert (np.diff(gear) >= 0.0).all()
        steps = np.diff(points[:, :2], axis=0)
        lengths = np.hypot(*steps.T)
        assert lengths.max() <= 0.25 + 1e-6
        # The length is that of the points, but for what chords are shorter than arcs.
        assert float(way.length) == pytest.approx(lengths.sum(), rel=1e-3, abs=1e-3)
        driven = (lengths > 1e-3) & (gear[1:] == gear[:-1])
        turns = np.angle(np.exp(1j * np.diff(points[:, 2])))
        # It moves the way it points, and turns no tighter than it can.
        middle = points[:-1, 2] + 0.5 * turns
        along = np.cos(np.arctan2(steps[:, 1], steps[:, 0]) - middle)[driven]
        np.testing.assert_allclose(along, gear[:-1][driven], atol=1e-3)
        assert (np.abs(turns[driven]) <= lengths[driven] / RADIUS * 1.01 + 1e-3).all()


def test_where_the_loading_ended_there_is_no_way() -> None:
    length, touching, way = drive((0.0, 0.0, 0.5), (0.0, 0.0, 0.5))
    assert length < 0.3
    assert float(way.length) < 0.3
    assert touching == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("back", [0.0, 2.0, 5.0])
def test_a_quarter_turn_is_as_long_as_it_says(side: float, back: float) -> None:
    """Straight back, then around a quarter of a circle: no way is longer than that."""
    goal = (RADIUS - back, side * RADIUS, side * math.pi / 2)
    length, _, way = drive((0.0, 0.0, 0.0), goal)
    by_hand = back + RADIUS * math.pi / 2
    assert float(way.length) <= by_hand + 0.1
    assert -1e-5 < length - float(way.length) <= 0.3


def _shortest_by_search(goal: Place) -> float:
    """Shortest way from the origin over a raster of cusps, by Dubins' lengths alone."""
    x, y = np.meshgrid(np.arange(-14.0, 6.1, 0.5), np.arange(-12.0, 12.1, 0.5), indexing="ij")
    heading = np.radians(np.arange(0.0, 360.0, 7.5))
    cusps = [a.ravel() for a in np.broadcast_arrays(x[..., None], y[..., None], heading)]

    def dubins(end: Place) -> np.ndarray:
        lengths = []
        for s0, s1 in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
            x0, y0, a0 = cusps
            dx = end[0] - RADIUS * s1 * math.sin(end[2]) - x0 + RADIUS * s0 * np.sin(a0)
            dy = end[1] + RADIUS * s1 * math.cos(end[2]) - y0 - RADIUS * s0 * np.cos(a0)
            crossing = 0.5 * (s0 - s1)
            left = dx**2 + dy**2 - (2 * RADIUS * crossing) ** 2
            line = np.sqrt(np.maximum(left, 0.0))
            bearing = np.arctan2(dy, dx) + crossing * np.arctan2(2 * RADIUS, line)
            arcs = (s0 * (bearing - a0) + 1e-9) % (2 * math.pi)
            arcs = arcs + (s1 * (end[2] - bearing) + 1e-9) % (2 * math.pi)
            lengths.append(np.where(left >= 0.0, RADIUS * arcs + line, np.inf))
        shortest: np.ndarray = np.min(lengths, axis=0)
        return shortest

    return float((dubins((0.0, 0.0, 0.0)) + dubins(goal)).min())


def test_ways_in_the_open_are_as_short_as_a_search_finds() -> None:
    """The raster is coarse, so its ways are a little longer than the shortest."""
    far = [goal for _, goal in scenes(24)]
    far = [goal for goal in far if not _truck_is_in_the_way(goal)]
    assert len(far) >= 10
    ratios = [float(drive((0.0, 0.0, 0.0), g)[2].length) / _shortest_by_search(g) for g in far]
    assert min(ratios) > 0.9
    assert np.median(ratios) < 1.05
    assert np.mean(np.array(ratios) < 1.1) > 0.8


def _truck_is_in_the_way(goal: Place) -> bool:
    near, far, half = truck_outline(WA320)
    ahead = (near + far) / 2
    x, y = goal[0] + ahead * math.cos(goal[2]), goal[1] + ahead * math.sin(goal[2])
    return math.hypot(x, y) < half + 6.0


@pytest.mark.parametrize("angle", [0.4, 2.0, -2.9])
def test_it_does_not_depend_on_the_frame(angle: float) -> None:
    c, s = math.cos(angle), math.sin(angle)

    def moved(place: Place) -> Place:
        x, y, heading = place
        return c * x - s * y + 3.0, s * x + c * y - 2.0, heading + angle

    for start, goal in scenes(6):
        length, touching, _ = drive(moved(start), moved(goal))
        expected, untouched, _ = drive(start, goal)
        assert length == pytest.approx(expected, abs=0.02)
        assert touching == pytest.approx(untouched, abs=0.02)


def test_what_is_in_the_way_is_gone_around() -> None:
    goal = (-15.0, -1.0, 2.2)
    straight, _, _ = drive((0.0, 0.0, 0.0), goal)
    wall = field((-9.0, -1.5, -8.5, 18.0))
    around, touching, way = drive((0.0, 0.0, 0.0), goal, wall)
    assert touching == pytest.approx(0.0, abs=0.02)
    assert around > straight + 1.0
    points = points_of(way, RADIUS)
    blocked = np.asarray(wall.height) > 0.5
    free = clearance(points, np.array([BACK, 0.0, 0.0]), blocked, wall, np.array(goal), WA320)
    assert 0.0 <= free < 3.0


def test_where_there_is_no_way_the_least_is_touched() -> None:
    ring = field((-18, -18, 18, -9), (-18, 9, 18, 18), (-10, -18, -9, 18))
    _, touching, _ = drive((0.0, 0.0, 0.0), (-15.0, 0.0, math.pi), ring)
    assert touching > 0.3


def test_gradient_against_finite_differences() -> None:
    with jax.enable_x64(True):
        wall = field((-9.0, -1.5, -8.5, 18.0))
        wall = wall.replace(height=jnp.asarray(wall.height, jnp.float64))
        room = room_of(yard_of(wall, WA320), wall)
        room = jax.tree.map(
            lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf, room
        )

        def one(p: jax.Array) -> jax.Array:
            length, touching, _ = way_to(Pose(*p[:3]), Receiver(*p[3:]), room, WA320)
            return length + 3.0 * touching

        places = np.array(
            [
                [BACK, 0.0, 0.0, -14.0, 2.0, 2.2],
                [BACK, 0.3, 0.1, -3.5, 4.1, 1.2],
                [BACK, -0.2, -0.1, -7.0, -4.0, -1.4],
                [BACK + 2.0, 0.4, 0.05, -11.0, -5.0, 2.8],
            ]
        )
        assert_gradient(lambda p: jax.vmap(one)(p).sum(), jnp.asarray(places))


@pytest.mark.parametrize("goal", [(0, 0, 0), (BACK, 0, 0), (-9, 0, math.pi), (30, 0, math.pi)])
def test_gradient_is_finite_at_special_places(goal: Place) -> None:
    room = room_of(yard_of(OPEN, WA320), OPEN)

    @jax.jit
    @jax.grad
    def gradient(p: jax.Array) -> jax.Array:
        length, touching, _ = way_to(Pose(*p[:3]), Receiver(*p[3:]), room, WA320)
        return length + touching

    found = gradient(jnp.asarray([BACK, 0.0, 0.0, *goal], jnp.float32))
    assert np.isfinite(found).all()
    assert np.abs(found).max() < 100.0


# --- the lane and the yard


@jax.jit
def _lane(pose: Pose, receiver: Receiver, pile: Pile, yard: Yard) -> jax.Array:
    return lane_touching(pose, receiver, pile, yard, WA320)


def lane(pile: Pile, receiver: Place = (0.0, 15.0, 1.5)) -> float:
    pose = pose_ending((0.0, 0.0, 0.0))
    return float(_lane(pose, receiver_at(receiver), pile, yard_of(pile, WA320)))


def test_ridges_in_the_lane_count_by_their_length() -> None:
    assert lane(OPEN) == 0.0
    # Two metres of a ridge under one tyre; a ridge beside the lane; the pile ahead.
    assert lane(field((1.0, 0.8, 3.0, 1.2))) == pytest.approx(2.0, abs=0.4)
    assert lane(field((1.0, 1.6, 3.0, 2.2))) == 0.0
    assert lane(field((BACK, -3.0, BACK + 4.0, 3.0))) == 0.0
    low = field((1.0, -1.0, 3.0, 1.0))
    assert lane(low.replace(height=0.2 * low.height)) == 0.0
    # The truck in the lane.
    assert lane(OPEN, (2.0, -4.05, math.pi / 2)) > 2.0


def test_what_stands_counts_where_soil_does_not() -> None:
    box = field((1.0, 0.8, 3.0, 1.2))
    wall = box.replace(ground=box.height)
    assert standing(np.asarray(wall.floor), 0.1).sum() == (np.asarray(box.height) > 0).sum()
    assert lane(wall) == pytest.approx(2.0, abs=0.5)
    # A yard that slopes is no wall, nor is one that is level.
    slope = 0.15 * np.arange(CELLS)[:, None] * 0.1 * np.ones((1, CELLS), np.float32)
    assert not standing(slope, 0.1).any()
    assert not standing(np.asarray(OPEN.floor), 0.1).any()


def test_soil_is_packed_without_loss() -> None:
    pile = field((1.0, 0.8, 3.0, 1.2), (-7.3, -7.1, 2.0, 0.0))
    soil = unpacked_soil(np.asarray(packed_soil(pile)), pile.height.shape)
    np.testing.assert_array_equal(soil, np.asarray(pile.height) > 0.25)


@pytest.mark.parametrize(("side", "expected"), [(1.8, 0.4), (1.0, -0.4), (9.0, FARTHEST)])
def test_clearance_by_hand(side: float, expected: float) -> None:
    """One cell beside a straight way: its edge is half a cell nearer than its middle."""
    points = np.array([[-x, 0.0, 0.0, -1.0] for x in np.arange(0.0, 12.0, 0.25)])
    cell = field((-6.04, side - 0.04, -5.96, side + 0.04))
    blocked = np.asarray(cell.height) > 0.5
    assert blocked.sum() == 1
    far = np.array([40.0, 0.0, 0.0])
    found = clearance(points, np.array([BACK, 0.0, 0.0]), blocked, cell, far, WA320)
    assert found == pytest.approx(expected, abs=0.011)


# --- where the truck stands


def cone() -> Pile:
    x, y = np.meshgrid(*(CORNER + 0.1 * np.arange(CELLS),) * 2, indexing="ij")
    height = np.maximum(3.0 - 0.65 * np.hypot(x, y), 0.0).astype(np.float32)
    return Pile(height, 0.1, (CORNER, CORNER))


def test_the_default_truck_has_room_and_short_ways() -> None:
    pile = cone()
    receiver = best_receiver(pile)
    at = np.array([float(v) for v in (receiver.x, receiver.y, receiver.heading)])
    on, unseen = truck_stands_on(at[None], pile, np.asarray(pile.height) > 0.25, WA320)
    assert (on[0], unseen[0]) == (0.0, 0.0)
    away = math.hypot(at[0], at[1])
    assert 8.0 < away < 25.0
    # The dig that is nearest is a V of less than three lengths of the loader away.
    bearing = math.atan2(at[1], at[0])
    toe = 4.4
    best = min(
        float(
            drive(
                (
                    (toe + BACK) * math.cos(bearing + turn),
                    (toe + BACK) * math.sin(bearing + turn),
                    bearing + turn + math.pi,
                ),
                (at[0], at[1], at[2]),
                pile,
            )[2].length
        )
        for turn in (-0.6, -0.3, 0.0, 0.3, 0.6)
    )
    assert best < 16.0


def test_a_truck_without_a_heading_does_not_stand_in_the_way() -> None:
    receiver = place_receiver(cone(), (-13.0, 1.0))
    near, far, _ = truck_outline(WA320)
    ahead = 0.5 * (near + far)
    heading = float(receiver.heading)
    middle = (-13.0 + ahead * math.cos(heading), 1.0 + ahead * math.sin(heading))
    assert math.hypot(*middle) > 9.0
