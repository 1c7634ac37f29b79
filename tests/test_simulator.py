"""The simulator: ledgers, symmetries and trends of a loading; then values; then gradients."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage, stats

from experiments.dem_reference import REFERENCE, replay
from wlplan.constants import ACTION_HIGH, GRAVITY
from wlplan.engines.simulator import (
    STOP_REASONS,
    Settings,
    Simulator,
    dig,
    terrain,
    trace,
    walls,
)
from wlplan.engines.simulator.cycle import Cycle, State, advance, begin, outcome
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.automaton import FLOW_FRACTION, relax, steepest_slope, sweep
from wlplan.terrain.heightmap import local_axes
from wlplan.terrain.seed_piles import SEED_PILES, seed_pile
from wlplan.terrain.toe import ToeContour, toe_contour
from wlplan.types import Action, Performance, Pile, Pose, action_from

Rows = Sequence[npt.ArrayLike] | np.ndarray
Played = tuple[Pile, Performance, Cycle]
Loadings = tuple[
    Callable[..., Played], tuple[Pile, Pose, Action], Played, tuple[slice, slice, slice]
]


class Digs(Protocol):
    """Surfaces, actions and perhaps floors -> their cycles."""

    def __call__(self, heights: Rows, actions: Rows, grounds: Rows | None = None) -> Cycle:
        """One cycle a row; without floors they are level."""


ALONG, LEFT = local_axes(52, 1.0)
GRID = 224  # cells a side that hold any seed pile
POSES = 10  # random poses and actions a seed pile
BATCH = 64  # one compiled batch of `dig` serves most tests
DENSITY = GRAVEL.density / 1000.0  # [tonne/m^3]
MODERATE = np.array([0.35, 2.5, 0.35, 2.5])


def random_actions(rng: np.random.Generator, n: int) -> np.ndarray:
    return (rng.uniform(size=(n, 4)) * ACTION_HIGH).astype(np.float32)


# --- Whole loadings on the seed piles: one batch, played once. ---------------------------------


@pytest.fixture(scope="module")
def seed_piles() -> list[tuple[Pile, ToeContour]]:
    """Every seed pile relaxed, on a grid of one size, and its toe."""
    relaxed = jax.jit(relax)
    piles = []
    for number, (kind, slope) in enumerate(SEED_PILES):
        pile = seed_pile(kind, slope=slope, seed=number)
        before = [(GRID - n) // 2 for n in pile.height.shape]
        widths = [(b, GRID - n - b) for b, n in zip(before, pile.height.shape, strict=True)]
        pile = Pile(
            jnp.pad(pile.height, widths),
            pile.cell_size,
            pile.origin - pile.cell_size * jnp.asarray(before, jnp.float32),
        )
        pile = relaxed(pile)
        piles.append((pile, toe_contour(pile)))
    return piles


@pytest.fixture(scope="module")
def loadings(seed_piles: list[tuple[Pile, ToeContour]]) -> Loadings:
    """Random loadings on every seed pile, on uneven ground, and where there is nothing to dig.

    Returns the piles, poses and actions, what `Simulator.play` makes of them, and the slices of
    the three groups.
    """
    rng = np.random.default_rng(0)
    floors, heights, origins, poses = [], [], [], []
    x, y = np.meshgrid(0.1 * np.arange(GRID), 0.1 * np.arange(GRID), indexing="ij")
    rough = 0.1 * np.sin(1.3 * x + 0.4) * np.cos(0.9 * y) + 0.03 * x

    def add(
        pile: Pile,
        contour: ToeContour,
        count: int,
        floor: np.ndarray,
        turn: Callable[[np.random.Generator], float],
    ) -> None:
        for k in rng.choice(np.flatnonzero(contour.accessible), count, replace=False):
            floors.append(floor)
            heights.append(np.asarray(pile.height) + floor)
            origins.append(np.asarray(pile.origin))
            poses.append([*contour.points[k], contour.heading[k] + turn(rng)])

    for pile, contour in seed_piles:
        add(pile, contour, POSES, np.zeros((GRID, GRID)), lambda r: r.normal(0.0, 0.2))
    for pile, contour in seed_piles:
        add(pile, contour, 2, rough, lambda r: r.normal(0.0, 0.2))
    # Past the pile, over the edge of the grid, and flat ground.
    pile, contour = seed_piles[0]
    for x, y, heading in ((-10.5, 0.0, math.pi / 2), (-11.0, -11.0, -2.4), (40.0, 3.0, 0.0)):
        floors.append(np.zeros((GRID, GRID)))
        heights.append(np.asarray(pile.height))
        origins.append(np.asarray(pile.origin))
        poses.append([x, y, heading])
    floors.append(np.zeros((GRID, GRID)))
    heights.append(np.zeros((GRID, GRID)))
    origins.append(np.asarray(pile.origin))
    poses.append([0.0, 0.0, 0.5])

    places = jnp.asarray(np.array(poses), jnp.float32)
    piles = Pile(
        jnp.asarray(np.array(heights), jnp.float32),
        0.1,
        jnp.asarray(np.array(origins), jnp.float32),
        ground=jnp.asarray(np.array(floors), jnp.float32),
    )
    actions = action_from(jnp.asarray(random_actions(rng, len(poses))))
    inputs = piles, Pose(places[:, 0], places[:, 1], places[:, 2]), actions
    play = jax.jit(jax.vmap(Simulator().play))
    seeds = POSES * len(seed_piles)
    uneven = seeds + 2 * len(seed_piles)
    groups = slice(0, seeds), slice(seeds, uneven), slice(uneven, None)
    return play, inputs, play(*inputs), groups


def test_what_leaves_the_grid_is_the_load(loadings: Loadings) -> None:
    _, (piles, _, _), (after, performance, cycle), (seeds, uneven, nothing) = loadings
    before, left = (np.asarray(p.height, np.float64).sum((1, 2)) for p in (piles, after))
    lost = (before - left) * piles.cell_size**2 * DENSITY
    mass = np.asarray(performance.mass, np.float64)
    for group in (seeds, uneven):
        np.testing.assert_allclose(lost[group], mass[group], rtol=1e-5)
    np.testing.assert_allclose(lost[nothing], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(cycle.mass), 1000.0 * mass, rtol=2e-5, atol=1e-3)


def test_the_ledger_can_fail(loadings: Loadings) -> None:
    _, (piles, _, _), (after, performance, _), _ = loadings
    before, left = (np.asarray(p.height, np.float64).sum((1, 2)) for p in (piles, after))
    lost = (before - left) * piles.cell_size**2 * DENSITY
    wrong = np.asarray(performance.mass, np.float64) * (1 + 3e-5)
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(lost[:60], wrong[:60], rtol=1e-5)


def test_nothing_is_dug_below_the_ground(loadings: Loadings) -> None:
    _, (piles, _, _), (after, _, _), _ = loadings
    assert (np.asarray(after.height) - np.asarray(piles.ground)).min() >= -1e-5


def test_far_from_the_bucket_a_little_soil_slides_at_most(loadings: Loadings) -> None:
    """Beyond the window of the automaton only an avalanche that leaves it can move soil."""
    _, (piles, pose, _), (after, _, _), (seeds, _, _) = loadings
    axis = 0.1 * np.arange(GRID)
    x, y = (np.asarray(piles.origin)[seeds, k, None] + axis for k in (0, 1))
    far = (
        np.hypot(
            (x - np.asarray(pose.x)[seeds, None])[:, :, None],
            (y - np.asarray(pose.y)[seeds, None])[:, None, :],
        )
        > 9.0
    )
    moved = np.abs(np.asarray(after.height) - np.asarray(piles.height))[seeds]
    assert (moved * far).max() < 0.05
    assert (moved * far).sum() < 0.02 * moved.sum()


def test_the_pile_after_is_within_a_degree_of_the_angle_of_repose(loadings: Loadings) -> None:
    _, _, (after, _, _), (seeds, _, _) = loadings
    steepest = jax.vmap(lambda h: steepest_slope(Pile(h, 0.1)))(after.height[seeds])
    assert np.degrees(np.max(steepest)) <= 33.0 + 1e-3


def test_where_there_is_nothing_the_bucket_stays_empty(loadings: Loadings) -> None:
    _, (piles, _, _), (after, performance, cycle), (_, _, nothing) = loadings
    np.testing.assert_allclose(np.asarray(performance.mass)[nothing], 0.0, atol=1e-6)
    # The seed piles are relaxed to within a degree, so a window may still slide by a little.
    np.testing.assert_allclose(after.height[nothing], piles.height[nothing], atol=0.01)
    reasons = np.asarray(cycle.stop_reason)[nothing]
    assert set(reasons) <= {STOP_REASONS.index(r) for r in ("tilt_end", "penetration", "breakout")}


def test_everything_is_finite(loadings: Loadings) -> None:
    _, _, outcome, _ = loadings
    for leaf in jax.tree.leaves(outcome):
        assert np.isfinite(leaf).all()


def test_outcomes_lie_in_the_expected_ranges(loadings: Loadings) -> None:
    _, _, (_, performance, cycle), (seeds, _, _) = loadings
    mass, time, work = (
        np.asarray(v)[seeds] for v in (performance.mass, performance.time, performance.work)
    )
    assert mass.min() > 0.2
    assert mass.max() < 5.0
    assert 2.0 < np.median(mass) < 4.0
    assert time.min() > 6.0
    assert time.max() < 26.0
    assert work.min() > 100.0
    assert work.max() < 1600.0
    # Which event ends a cycle is up to the action.
    assert np.bincount(np.asarray(cycle.stop_reason)[seeds], minlength=4)[:3].min() > 0


def test_the_parts_of_the_work_are_its_sum_and_not_negative(loadings: Loadings) -> None:
    _, _, (_, performance, cycle), _ = loadings
    parts = [cycle.work_drive, cycle.work_boom, cycle.work_bucket, cycle.work_slip]
    for part in parts:
        assert np.min(part) >= 0.0
    np.testing.assert_allclose(sum(parts) / 1000.0, performance.work, rtol=1e-5)


def test_a_batch_equals_its_members(loadings: Loadings) -> None:
    """A batch of copies ends when its one member does, whatever the others of the batch did."""
    play, inputs, outcome, (_, uneven, _) = loadings
    slowest = int(np.argmax(np.asarray(outcome[1].time)))
    for k in {uneven.start, slowest}:
        copies = jax.tree.map(lambda v, k=k: jnp.broadcast_to(v[k], v.shape), inputs)
        alone, together = jax.tree.leaves(play(*copies)), jax.tree.leaves(outcome)
        for one, all_ in zip(alone, together, strict=True):
            np.testing.assert_allclose(one[3], all_[k], rtol=1e-5, atol=1e-5)


# --- Single digs on made-up surfaces. ----------------------------------------------------------


def ramp(slope: float, incidence: float = 0.0, top: float = 4.0) -> np.ndarray:
    """A plane that rises from the dig location, cut off at a height [m]; angles in degrees."""
    a = math.radians(incidence)
    distance = math.cos(a) * ALONG[:, None] + math.sin(a) * LEFT[None, :]
    return np.clip(math.tan(math.radians(slope)) * distance, 0.0, top).astype(np.float32)


def bumpy(seed: int, slope: float = 26.0) -> np.ndarray:
    """A ramp with smooth random bumps, no two sides alike."""
    noise = np.random.default_rng(seed).normal(size=(52, 52))
    noise = ndimage.gaussian_filter(noise, 6.0)
    bumps: np.ndarray = np.maximum(ramp(slope) * (1.0 + 0.5 * noise / noise.std() * 0.3), 0.0)
    return bumps.astype(np.float32)


def batched(step: float = 0.02, machine: WheelLoader = WA320, batch: int = BATCH) -> Digs:
    """`dig` over lists of surfaces, actions and floors, compiled for batches of one size."""

    @jax.jit
    @jax.vmap
    def run(height: jax.Array, ground: jax.Array, action: jax.Array) -> Cycle:
        return dig(
            height,
            ground,
            action_from(action),
            settings=Settings(step=step),
            machine=machine,
        )

    def call(heights: Rows, actions: Rows, grounds: Rows | None = None) -> Cycle:
        heights, actions = np.array(heights, np.float32), np.array(actions, np.float32)
        grounds = np.zeros_like(heights) if grounds is None else np.array(grounds, np.float32)
        n = len(actions)
        assert n <= batch
        fill = np.minimum(np.arange(batch), n - 1)
        cycles = run(*(jnp.asarray(rows[fill]) for rows in (heights, grounds, actions)))
        cycle: Cycle = jax.tree.map(lambda v: np.asarray(v)[:n], cycles)
        return cycle

    return call


@pytest.fixture(scope="module")
def digs() -> Digs:
    return batched()


def total_work(cycle: Cycle) -> jax.Array:
    return cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip


# Actions, and surfaces, that end in each event.
ENDS = {
    "tilt_end": (ramp(30.0), [0.7, 0.0, 0.0, 5.0]),
    "penetration": (ramp(8.0), [0.7, 0.0, 0.7, 0.0]),
    "breakout": (ramp(25.0, top=0.5), [0.0, 5.0, 0.7, 0.0]),
    "timeout": (ramp(32.0), [0.7, 0.0, 0.7, 0.0]),
}


@pytest.fixture(scope="module")
def ends(digs: Digs) -> dict[str, Cycle]:
    cycles = digs([h for h, _ in ENDS.values()], [a for _, a in ENDS.values()])
    return {r: jax.tree.map(lambda v, k=k: v[k], cycles) for k, r in enumerate(ENDS)}


@pytest.mark.parametrize("reason", STOP_REASONS)
def test_every_event_ends_some_dig(ends: dict[str, Cycle], reason: str) -> None:
    assert STOP_REASONS[int(ends[reason].stop_reason)] == reason
    assert 0.0 < ends[reason].fill_time <= 15.0 + 1e-4


def test_events_are_located_where_they_are_defined(ends: dict[str, Cycle]) -> None:
    assert ends["penetration"].tip_x == pytest.approx(3.2, abs=1e-3)
    assert ends["penetration"].tip_z == pytest.approx(0.0, abs=1e-3)
    assert ends["timeout"].fill_time == pytest.approx(15.0, abs=1e-3)
    # At the tilt end, with the boom down, the edge has swung up about the pin.
    forward = math.sqrt(WA320.tip_radius**2 - pin_height() ** 2)
    swung = forward * math.sin(WA320.tilt_end) + pin_height() * (1 - math.cos(WA320.tilt_end))
    assert ends["tilt_end"].tip_z == pytest.approx(swung, abs=2e-3)
    # At the breakout, the edge clears the surface that was there by 5 cm.
    breakout, surface = ends["breakout"], ENDS["breakout"][0]
    assert breakout.tip_x > 0.3
    there = np.interp(breakout.tip_x, ALONG, surface.mean(axis=1))
    assert breakout.tip_z - there == pytest.approx(0.05, abs=2e-3)


def pin_height() -> float:
    return WA320.pivot_height + WA320.boom_length * math.sin(WA320.boom_low)


def test_no_dig_goes_past_an_event(digs: Digs) -> None:
    rng = np.random.default_rng(1)
    cycle = digs([bumpy(k) for k in range(BATCH)], random_actions(rng, BATCH))
    assert (cycle.tip_x <= 3.2 + 1e-3).all()
    assert (cycle.fill_time <= 15.0 + 1e-3).all()
    assert (cycle.fill_time > 0.0).all()
    reached = cycle.stop_reason == STOP_REASONS.index("penetration")
    np.testing.assert_allclose(cycle.tip_x[reached], 3.2, atol=1e-3)


def test_left_and_right_are_alike(digs: Digs) -> None:
    rng = np.random.default_rng(2)
    surfaces, actions = [bumpy(k) for k in range(20)], random_actions(rng, 20)
    assert max(np.abs(h - h[:, ::-1]).max() for h in surfaces) > 0.1
    straight, mirrored = digs(surfaces, actions), digs([h[:, ::-1] for h in surfaces], actions)
    for name in ("mass", "time", "fill_time"):
        np.testing.assert_allclose(getattr(mirrored, name), getattr(straight, name), rtol=1e-3)
    np.testing.assert_allclose(total_work(mirrored), total_work(straight), rtol=1e-3)
    # A cycle may hang on rounding where two events coincide: nearly all, and the mean.
    difference = np.abs(mirrored.height[:, :, ::-1] - straight.height).max(axis=(1, 2))
    assert np.median(difference) < 1e-4
    assert difference.max() < 2e-2


def test_the_local_ledger_closes(digs: Digs) -> None:
    rng = np.random.default_rng(3)
    surfaces = np.array([bumpy(k) for k in range(20)])
    cycle = digs(surfaces, random_actions(rng, 20))
    lost = surfaces.sum((1, 2), dtype=np.float64) - cycle.height.sum((1, 2), dtype=np.float64)
    np.testing.assert_allclose(lost * 0.01 * GRAVEL.density, cycle.mass, rtol=2e-5)


def test_the_local_surface_stays_above_the_ground(digs: Digs) -> None:
    rng = np.random.default_rng(3)
    cycle = digs([bumpy(k) for k in range(20)], random_actions(rng, 20))
    assert cycle.height.min() >= -1e-5


@pytest.mark.slow
def test_a_smaller_time_step_changes_little(digs: Digs) -> None:
    rng = np.random.default_rng(4)
    surfaces, actions = [bumpy(k) for k in range(24)], random_actions(rng, 24)
    coarse = digs(surfaces, actions)
    fine = batched(step=0.005, batch=24)(surfaces, actions)
    for a, b in (
        (coarse.mass, fine.mass),
        (coarse.time, fine.time),
        (total_work(coarse), total_work(fine)),
    ):
        change = np.abs(a / b - 1)
        assert np.median(change) < 0.015
        # Few cycles hang between two ends, a stall and a breakout: there a little decides.
        assert np.mean(change > 0.05) <= 0.15


def test_a_steeper_slope_loads_more_a_second(digs: Digs) -> None:
    slopes = (15.0, 20.0, 25.0, 30.0)
    actions: list[npt.ArrayLike] = [
        MODERATE,
        [0.2, 2.0, 0.3, 2.0],
        [0.5, 3.0, 0.4, 3.0],
        [0.3, 1.5, 0.2, 1.0],
    ]
    cycle = digs([ramp(s) for s in slopes for _ in actions], actions * len(slopes))
    productivity = (cycle.mass / cycle.time).reshape(len(slopes), -1).mean(axis=1)
    assert np.all(np.diff(productivity) > 0.0), productivity


def test_head_on_loads_more_a_second_than_aslant(digs: Digs) -> None:
    angles = (0.0, 20.0, 40.0)
    actions: list[npt.ArrayLike] = [
        MODERATE,
        [0.2, 2.0, 0.3, 2.0],
        [0.5, 3.0, 0.4, 3.0],
        [0.3, 1.5, 0.2, 1.0],
    ]
    cycle = digs([ramp(28.0, a) for a in angles for _ in actions], actions * len(angles))
    productivity = (cycle.mass / cycle.time).reshape(len(angles), -1).mean(axis=1)
    assert productivity[0] > productivity[2], productivity


def test_tilting_later_fills_more(digs: Digs) -> None:
    thresholds = np.linspace(0.15, 0.5, 8)
    cycle = digs([ramp(28.0)] * 8, [[0.7, 0.0, t, 3.0] for t in thresholds])
    assert cycle.mass[-1] > 1.15 * cycle.mass[0], cycle.mass
    assert stats.spearmanr(thresholds, cycle.mass).statistic > 0.9


def test_a_drive_into_nothing_has_a_closed_form(digs: Digs) -> None:
    """Approach and penetration at a steady speed, tilt, brake, and the way back."""
    cycle = digs([np.zeros((52, 52))], [[0.7, 0.0, 0.7, 0.0]])
    speed, weight = WA320.travel_speed, WA320.mass * GRAVITY
    # The speed controller gives way to rolling resistance.
    steady = speed - WA320.rolling_resistance * weight / WA320.speed_gain
    fill = 3.2 / steady
    tilting = WA320.tilt_end / WA320.tilt_speed + 0.05 + 0.02
    braking = steady**2 / (2 * GRAVITY * (WA320.traction + WA320.rolling_resistance))
    accelerating = WA320.mass * speed**2 / 2 / WA320.wheel_power / 3
    back = max(
        (5.0 + 3.2 + braking) / speed + accelerating,
        (WA320.boom_carry - WA320.boom_low) / (0.6 * WA320.boom_speed),
    )
    assert cycle.mass == 0.0
    assert cycle.fill_time == pytest.approx(fill, rel=1e-2)
    assert cycle.time == pytest.approx(5.0 / speed + fill + max(tilting, 0.5) + back, rel=1e-2)
    assert cycle.work_slip == 0.0


def test_soil_slides_by_the_rule_of_the_automaton() -> None:
    surface = np.stack([bumpy(k, slope=40.0) for k in range(3)], axis=-1)
    rim = terrain.rimmed(jnp.asarray(surface))
    flow = terrain._outflow(rim, jnp.ones_like(rim), 0.06, 10.0)
    want = jax.vmap(lambda h: sweep(h, 0.06), in_axes=-1, out_axes=-1)(surface)
    assert np.abs(want - surface).max() > 1e-3
    np.testing.assert_allclose(surface - FLOW_FRACTION * flow, want, atol=1e-6)
    # No cell gives more than it may, nor more than it lets go.
    part = 0.3 * jnp.ones_like(rim)
    np.testing.assert_allclose(terrain._outflow(rim, part, 0.06, 10.0), 0.3 * flow, atol=1e-6)
    assert np.abs(terrain._outflow(rim, part, 0.06, 1e-3)).max() <= 8 * 0.3e-3 + 1e-8


@pytest.mark.parametrize("count", [1, 2, 5, 12, 13, 28, 52])
def test_a_sum_by_halves_is_the_sum(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 3))
    np.testing.assert_allclose(terrain.total(jnp.asarray(values)), values.sum(0), atol=1e-5)


reaction: Callable[..., terrain.Reaction] = jax.jit(terrain.reaction, static_argnums=(0, 1))


def met_by(
    height: np.ndarray,
    x: float = 2.0,
    z: float = 0.5,
    tilt: float = 0.0,
    soil: Soil = GRAVEL,
    fill: float = 0.0,
    ground: float = 0.0,
) -> terrain.Reaction:
    """`terrain.reaction` against one surface, in double precision."""
    rim = terrain.rimmed(jnp.asarray(height, jnp.float64)[..., None])
    fills = jnp.full((terrain.Lanes(WA320).count, 1), fill)
    bucket = terrain.Bucket(*(jnp.asarray([v]) for v in (x, z, tilt, walls.NOWHERE)))
    floor = jnp.full_like(rim, ground)
    return reaction(WA320, soil, rim, floor, fills, bucket, jnp.asarray(True))


def test_a_level_floor_rests_on_the_soil_it_has_cut() -> None:
    """The plate's thickness times the stiffness and the floor's area; nothing on hard ground."""
    with jax.enable_x64(True):
        cut = 0.5 * np.ones((52, 52))
        free = dataclasses.replace(GRAVEL, edge_resistance=0.0, intrusion_stiffness=0.0)
        borne, unborne = met_by(cut), met_by(cut, soil=free)
        lift = float(unborne.vertical[0] - borne.vertical[0])
        # Cells that the edge has passed whole count: half a cell less than the floor's length.
        area = WA320.bucket_width * (WA320.bucket_depth - 0.05)
        pressure = GRAVEL.intrusion_stiffness * WA320.plate_thickness
        assert lift == pytest.approx(pressure * area, rel=0.05)
        arm = float(borne.moment[0]) / lift
        assert arm == pytest.approx(WA320.bucket_depth / 2, rel=0.1)
        hard = met_by(cut, ground=0.5)
        assert float(hard.vertical[0]) == pytest.approx(float(unborne.vertical[0]), abs=1e-6)


def test_soil_behind_the_map_bears_nothing() -> None:
    """The bucket's back reaches over the near edge of the map: cells there count once, not more."""
    with jax.enable_x64(True):
        spill = np.where(ALONG < -0.95, 0.1, 0.0)[:, None] * np.ones(52)
        flat = np.zeros((52, 52))
        got, none = (met_by(h, x=-0.2, z=0.0) for h in (spill, flat))
        one_cell = GRAVEL.intrusion_stiffness * 0.1 * WA320.bucket_width * 0.1
        lift = float(none.vertical[0] - got.vertical[0])
        assert 0.5 * one_cell < lift < 1.1 * one_cell


def test_a_tilted_floor_sinks_in_and_a_steep_path_frees_it() -> None:
    with jax.enable_x64(True):
        level = 0.5 * np.ones((52, 52))
        along_path = np.maximum(0.5 - (2.0 - ALONG) * math.tan(0.5), 0.0)[:, None] * np.ones(52)
        sunk, free = met_by(level, tilt=0.3), met_by(along_path, tilt=0.3)
        assert float(sunk.vertical[0]) < float(met_by(level).vertical[0]) < 0.0
        assert abs(float(free.vertical[0])) < 0.1 * abs(float(sunk.vertical[0]))
        assert float(sunk.horizontal[0]) > float(free.horizontal[0]) >= 0.0


def test_the_content_is_weighed_pushed_and_carried() -> None:
    """Level, out of the soil: friction and push against travel, weight and carried soil down."""
    with jax.enable_x64(True):
        flat = np.zeros((52, 52))
        got = met_by(flat, z=1.0, fill=0.05)
        load = float(got.content_mass[0]) * GRAVITY
        assert load == pytest.approx(28 * 0.05 * GRAVEL.density * GRAVITY, rel=1e-6)
        push = GRAVEL.content_push + math.tan(GRAVEL.steel_friction)
        assert float(got.horizontal[0]) == pytest.approx(push * load, rel=1e-6)
        assert float(got.vertical[0]) == pytest.approx((1 + GRAVEL.content_carry) * load, rel=1e-6)


def test_soil_pushed_out_of_a_lane_is_laid_down_whole_and_alike_on_both_sides() -> None:
    lanes = terrain.Lanes(WA320)
    aside = terrain._aside(lanes)
    assert aside.shape == (54, lanes.count)
    np.testing.assert_allclose(aside[1:-1].sum(axis=0), 1.0)
    np.testing.assert_array_equal(aside[[0, -1]], aside[[1, -2]])
    np.testing.assert_allclose(aside, aside[::-1, ::-1])
    # From the outer lanes some goes beside the bucket.
    assert aside[: 1 + lanes.first, 0].sum() > 0.2


@pytest.mark.parametrize("width", [WA320.bucket_width, 5.2])
def test_what_stands_over_the_side_plates_falls_beside_the_bucket(width: float) -> None:
    machine = dataclasses.replace(WA320, bucket_width=width)
    lanes = terrain.Lanes(machine)
    height = terrain.rimmed(jnp.zeros((52, 52, 1)))
    full = lanes.width * machine.bucket_depth * (machine.side_height + 0.1)
    bucket = terrain.Bucket(*(jnp.asarray([v]) for v in (2.0, 1.0, 0.3, walls.NOWHERE)))
    reach = bucket.x, bucket.x
    after, fill = jax.jit(partial(terrain.move, machine, GRAVEL, step=0.02))(
        height, jnp.asarray(full, jnp.float32), height, bucket, reach, wanted=jnp.asarray(True)
    )
    laid = np.asarray(after)[1:-1, 1:-1, 0] * 0.01
    lost = full.sum() - np.asarray(fill, np.float64).sum()
    assert lost > 1e-4
    assert laid.sum() == pytest.approx(lost, rel=1e-4)
    columns = np.flatnonzero(laid.sum(axis=0))
    np.testing.assert_array_equal(columns, [max(lanes.first - 1, 0), min(lanes.end, 51)])


def test_cycles_advanced_in_parts_end_alike(digs: Digs) -> None:
    """A few steps at a time, in one go, and next to others that took longer: the same bytes."""
    rng = np.random.default_rng(5)
    height = jnp.asarray(np.stack([bumpy(k) for k in range(8)], axis=-1))
    action = action_from(jnp.asarray(random_actions(rng, 8)))
    state = begin(height, jnp.zeros_like(height), action, WA320)

    @jax.jit
    def run(state: State, steps: jax.Array) -> State:
        return advance(state, machine=WA320, soil=GRAVEL, settings=Settings(), steps=steps)

    once = run(state, jnp.asarray(2000))
    while not state.has_ended.all():
        state = run(state, jnp.asarray(7))
    for one, other in zip(*map(jax.tree.leaves, (state, once)), strict=True):
        np.testing.assert_array_equal(one, other)
    mass = outcome(state, machine=WA320, soil=GRAVEL).mass
    want = digs([bumpy(k) for k in range(8)], np.stack(jax.tree.leaves(action), axis=-1)).mass
    np.testing.assert_allclose(mass, want, rtol=1e-5)


# --- Walls ahead. -------------------------------------------------------------------------------

# Never lifts nor tilts; at once, a little; and the boom only.
STUBBORN, BOOM = [0.7, 0.0, 0.7, 0.0], [0.2, 2.0, 0.7, 0.0]
EITHER: list[npt.ArrayLike] = [STUBBORN, MODERATE, BOOM, [0.7, 0.0, 0.3, 3.0]]


def fenced(
    surface: np.ndarray,
    at: float,
    top: float = 2.5,
    turned: float = 0.0,
    columns: slice = slice(None),
) -> tuple[np.ndarray, np.ndarray]:
    """A surface with a wall of three cells across it, nothing behind it, and the ground.

    Its face is `at` metres ahead, where its ramp is half as high as it is; `turned` in degrees.
    """
    a = math.radians(turned)
    behind = math.cos(a) * (ALONG[:, None] - at) + math.sin(a) * LEFT[None, :]
    rises = np.clip(behind / 0.1 + 0.5, 0.0, 1.0)
    ground = np.zeros((52, 52))
    ground[:, columns] = (top * rises * (behind < 0.3))[:, columns]
    soil = np.where(behind < 0.0, surface, 0.0)
    return np.maximum(soil, ground).astype(np.float32), ground.astype(np.float32)


def rows_of(scenes: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[Rows, Rows]:
    return [height for height, _ in scenes], [ground for _, ground in scenes]


def in_front_of(scene: tuple[np.ndarray, np.ndarray], at: float) -> float:
    """Soil before a wall that stands square to the heading [kg]."""
    height, ground = (v.astype(np.float64) for v in scene)
    return float((height - ground)[at - 0.05 > ALONG].sum() * 0.01 * GRAVEL.density)


@pytest.mark.parametrize("at", [0.6, 0.95, 1.0, 1.07])
def test_the_bucket_does_not_pass_a_wall(digs: Digs, at: float) -> None:
    scenes = [fenced(ramp(s), at) for s in (0.0, 20.0, 30.0) for _ in EITHER]
    heights, grounds = rows_of(scenes)
    cycle, free = (
        digs(rows, EITHER * 3, floors)
        for rows, floors in (
            (heights, grounds),
            ([ramp(s) for s in (0.0, 20.0, 30.0) for _ in EITHER], None),
        )
    )
    # On a ramp of a cell the face is known to a part of it.
    assert (cycle.tip_x <= at + 0.02).all()
    # A bucket that tilts draws its edge back by a little.
    assert (cycle.tip_x >= at - 0.06).all()
    assert (free.tip_x > at + 0.3).all()
    assert (cycle.mass <= np.maximum(free.mass, 1e-6)).all()
    for mass, scene in zip(cycle.mass, scenes, strict=True):
        assert mass <= in_front_of(scene, at) + 1e-3
    # A wall is no soil, and what lies before it is dug.
    assert (cycle.mass[:4] == 0.0).all()
    assert (cycle.mass[4:] > 100.0).all()
    # It ends as every cycle does.
    assert (cycle.fill_time <= 15.0 + 1e-3).all()
    assert (cycle.stop_reason[::4] == STOP_REASONS.index("timeout")).all()
    assert (cycle.stop_reason[1::4] == STOP_REASONS.index("breakout")).all()
    np.testing.assert_allclose(cycle.fill_time[::4], 15.0, atol=1e-3)
    for part in ("work_drive", "work_boom", "work_bucket", "work_slip"):
        assert np.isfinite(getattr(cycle, part)).all()
        assert (getattr(cycle, part) >= 0.0).all()
    before, after = (np.array(h).sum((1, 2), np.float64) for h in (heights, cycle.height))
    # Rounding goes with what stands on the map, the wall too.
    difference = (before - after) * 0.01 * GRAVEL.density - cycle.mass
    np.testing.assert_array_less(np.abs(difference), 5e-5 * before * 0.01 * GRAVEL.density)
    assert (cycle.height >= np.array(grounds) - 1e-5).all()


def test_the_edge_is_before_the_wall_all_the_time() -> None:
    height, ground = fenced(ramp(30.0), 1.0)
    run = jax.jit(jax.vmap(partial(trace, jnp.asarray(height), jnp.asarray(ground))))
    path = run(action_from(jnp.asarray(np.array(EITHER, np.float32))))
    assert (np.asarray(path.tip_x) <= 1.0 + 1e-4).all()
    assert (np.asarray(path.tip_x).max(axis=1) >= 1.0 - 1e-4).all()
    # Held there, the bucket lifts or tilts as its controller has it, and at the stop tilts out.
    rising = np.diff(np.asarray(path.tip_z), axis=1)
    assert rising.min() >= -1e-6
    np.testing.assert_allclose(path.tilt[:, -1], WA320.tilt_end, atol=1e-3)


def test_what_is_driven_over_is_no_wall(digs: Digs) -> None:
    """A kerb, and a floor that rises by 10 degrees or has the noise of a scan."""
    flat = np.zeros((52, 52), np.float32)
    noise = np.random.default_rng(0).normal(0.0, 0.03, (52, 52))
    floors = [fenced(flat, 1.0, 0.1)[1], ramp(10.0), noise]
    cycle = digs(floors, [STUBBORN] * 3, floors)
    assert (cycle.stop_reason == STOP_REASONS.index("penetration")).all()
    soil, kerb = fenced(flat, 1.0, 0.1)
    slope = ramp(28.0)
    behind = [np.maximum(slope, kerb), slope, np.maximum(slope, soil)]
    over, none, _ = digs(behind, [MODERATE] * 3, [kerb, flat, kerb]).mass
    assert over == pytest.approx(none, rel=0.05)


def test_a_raised_bucket_passes_what_is_lower(digs: Digs) -> None:
    """The boom lifts the edge over 0.4 m in time; a bucket that stays down is stopped."""
    slope = ramp(20.0)
    low, high = (fenced(slope, 1.6, top)[1] for top in (0.4, 2.5))
    grounds = [low, low, high]
    cycle = digs([np.maximum(slope, g) for g in grounds], [BOOM, STUBBORN, BOOM], grounds)
    assert cycle.tip_x[0] > 2.0
    assert cycle.tip_z[0] > 0.4
    np.testing.assert_allclose(cycle.tip_x[1:], 1.6, atol=0.02)


def test_a_corner_of_the_bucket_is_enough(digs: Digs) -> None:
    flat = np.zeros((52, 52), np.float32)
    lanes = terrain.Lanes(WA320)
    beside = [
        slice(0, lanes.first),
        slice(lanes.end, 52),
        slice(0, lanes.first + 1),
        slice(lanes.end - 1, 52),
    ]
    posts = [fenced(flat, 1.0, columns=columns) for columns in beside]
    aslant = [fenced(flat, 2.0, turned=turned) for turned in (30.0, -30.0)]
    heights, grounds = rows_of([*posts, *aslant])
    cycle = digs(heights, [STUBBORN] * 6, grounds)
    np.testing.assert_allclose(cycle.tip_x[:4], [3.2, 3.2, 1.0, 1.0], atol=0.02)
    half = LEFT[lanes.end - 1]
    corner = 2.0 - half * math.tan(math.radians(30.0))
    np.testing.assert_allclose(cycle.tip_x[4:], corner, atol=0.05)


def test_the_face_moves_with_the_pose_whatever_the_cells() -> None:
    """Walls on a grid, seen from places a few millimetres apart, square and aslant."""
    grid = np.zeros((120, 120), np.float32)
    grid[75:78] = 2.5
    pile = Pile(jnp.asarray(grid), 0.1, ground=jnp.asarray(grid))
    lanes = terrain.Lanes(WA320)

    @jax.jit
    @jax.vmap
    def stop(x: jax.Array, heading: jax.Array) -> jax.Array:
        _, ground = Simulator().view(pile, Pose(x, jnp.float32(6.0), heading))
        met = lanes.of(terrain.rimmed(ground[..., None]))
        return walls.nearest(*walls.faces(met), jnp.zeros(1))[0]

    places = np.linspace(5.5, 5.8, 61, dtype=np.float32)
    for heading in (0.0, 0.5):
        found = np.asarray(stop(jnp.asarray(places), jnp.full(61, heading, jnp.float32)))
        half = LEFT[lanes.end - 1] * math.tan(heading)
        # The face is half a cell before the first cell of the wall.
        np.testing.assert_allclose(found, (7.45 - places) / math.cos(heading) - half, atol=0.05)
        assert np.abs(np.diff(found)).max() < 0.03


# --- Against the discrete elements: a guard against regressions, not a validation. --------------


@pytest.fixture(scope="module")
def against_dem() -> tuple[dict[str, np.ndarray], Cycle]:
    return replay()


def test_the_stored_reference_says_where_it_comes_from() -> None:
    with np.load(REFERENCE) as file:
        reference = dict(file)
    assert "LAMMPS" in str(reference["provenance"])
    assert reference["h0_cg"].shape == (len(reference["mass_t"]), 52, 52)


def test_masses_rank_like_the_discrete_elements(
    against_dem: tuple[dict[str, np.ndarray], Cycle],
) -> None:
    reference, cycle = against_dem
    simulated = cycle.mass / 1000.0
    assert stats.spearmanr(simulated, reference["mass_t"]).statistic >= 0.75
    assert abs(np.mean(simulated / reference["mass_t"]) - 1.0) < 0.15


def test_times_and_works_are_not_far_from_the_discrete_elements(
    against_dem: tuple[dict[str, np.ndarray], Cycle],
) -> None:
    reference, cycle = against_dem
    work = (cycle.work_drive + cycle.work_boom + cycle.work_bucket) / 1000.0
    assert abs(np.mean(cycle.time / reference["time_s"]) - 1.0) < 0.15
    assert abs(np.mean(work / reference["work_kJ"]) - 1.0) < 0.25


# --- Derivatives. -------------------------------------------------------------------------------

# Poses at the toe of a cone, with actions that no event or clip is close to.
SMOOTH = np.array(
    [
        [-6.9, 0.6, -0.1, 0.35, 2.2, 0.3, 2.0],
        [-6.8, -0.7, 0.15, 0.25, 1.5, 0.4, 2.8],
    ]
)
# Off the pile, driving past it.
NOWHERE = np.array([-10.5, 0.0, math.pi / 2, 0.35, 2.2, 0.3, 2.0])
# Mass, time, work of the first and mass of the second; mass of nothing.
OF_POINT, OF_OUTPUT = np.array([0, 0, 0, 1, 2]), np.array([0, 1, 2, 0, 0])


@pytest.fixture(scope="module")
def derivatives() -> tuple[np.ndarray, ...]:
    """Outcomes of both settings, gradients [5, 7] and central differences [4, 7]."""
    with jax.enable_x64(True):
        cone = seed_pile("conical", slope=math.radians(30.0), seed=3)

        def outcome(world: Simulator, vector: jax.Array) -> jax.Array:
            _, performance = world(cone, Pose(*vector[:3]), action_from(vector[3:]))
            return jnp.stack([performance.mass, performance.time, performance.work])

        fixed = Simulator(settings=Settings(differentiable=True))

        @jax.jit
        @jax.vmap
        def gradient(vector: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jax.value_and_grad(lambda v: outcome(fixed, v) @ weight)(vector)

        points = np.concatenate([SMOOTH, NOWHERE[None]])
        values, gradients = gradient(
            jnp.asarray(points[OF_POINT]), jnp.asarray(np.eye(3)[OF_OUTPUT])
        )

        forward = jax.jit(jax.vmap(lambda v: outcome(Simulator(), v)))
        step = 1e-6
        shifts = step * np.eye(7)
        shifted = SMOOTH[:, None] + np.concatenate([0 * shifts[:1], shifts, -shifts])
        out = np.asarray(forward(jnp.asarray(shifted.reshape(-1, 7)))).reshape(len(SMOOTH), 15, 3)
        central = (out[:, 1:8] - out[:, 8:]) / (2 * step)
        return (
            np.asarray(values)[:4],
            out[OF_POINT[:4], 0, OF_OUTPUT[:4]],
            np.asarray(gradients),
            central[OF_POINT[:4], :, OF_OUTPUT[:4]],
        )


@pytest.mark.slow
def test_the_differentiable_setting_gives_the_same_outcome(
    derivatives: tuple[np.ndarray, ...],
) -> None:
    fixed, default, _, _ = derivatives
    np.testing.assert_allclose(fixed, default, rtol=1e-6)


@pytest.mark.slow
def test_gradients_against_finite_differences(derivatives: tuple[np.ndarray, ...]) -> None:
    _, _, gradient, central = derivatives
    size = np.linalg.norm(central, axis=-1)
    assert (size > 0.0).all()
    error = np.linalg.norm(gradient[:4] - central, axis=-1)
    np.testing.assert_array_less(error, 5e-3 * size)


@pytest.mark.slow
def test_gradients_are_finite_where_there_is_nothing_to_dig(
    derivatives: tuple[np.ndarray, ...],
) -> None:
    _, _, gradient, _ = derivatives
    assert np.isfinite(gradient).all()


@pytest.mark.slow
def test_gradients_before_a_wall_against_finite_differences() -> None:
    """Of mass, time and work in the place of the wall, the slope and the action: it is met."""
    with jax.enable_x64(True):
        along = jnp.asarray(np.tile(ALONG[:, None], 52))

        def outcome(vector: jax.Array, differentiable: bool) -> jax.Array:
            behind = along - vector[0]
            ground = 2.5 * jnp.clip(behind / 0.1 + 0.5, 0.0, 1.0)
            soil = jnp.clip(vector[1] * along, 0.0, 4.0)
            cycle = dig(
                jnp.maximum(jnp.where(behind < 0.0, soil, 0.0), ground),
                ground,
                action_from(vector[2:]),
                settings=Settings(differentiable=differentiable),
            )
            return jnp.stack([cycle.mass, cycle.time, total_work(cycle), cycle.tip_x])

        points = np.array([[1.23, 0.5, *MODERATE], [1.53, 0.55, 0.25, 1.5, 0.4, 2.8]])
        size, step = points.shape[1], 1e-6
        gradient = np.asarray(
            jax.jit(jax.vmap(jax.jacrev(partial(outcome, differentiable=True))))(points)
        )
        shifts = step * np.concatenate([np.eye(size), -np.eye(size)])
        shifted = (points[:, None] + shifts).reshape(-1, size)
        forward = jax.jit(jax.vmap(partial(outcome, differentiable=False)))
        out = np.asarray(forward(jnp.asarray(shifted))).reshape(len(points), 2, size, -1)
        central = np.moveaxis(out[:, 0] - out[:, 1], 1, 2) / (2 * step)
    assert np.isfinite(gradient).all()
    # The edge is where the wall is, and a wall that is further off leaves more to dig.
    np.testing.assert_allclose(gradient[:, 3, 0], 1.0, atol=0.3)
    assert (gradient[:, 0, 0] > 300.0).all()
    error = np.linalg.norm((gradient - central)[:, :3], axis=-1)
    np.testing.assert_array_less(error, 5e-3 * np.linalg.norm(central[:, :3], axis=-1))
