"""Soil in the approach lane: met, taken up, pushed; a free lane changes nothing; limits."""

import dataclasses
import itertools
import json
import math
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.lane import RIDGE, load, replay
from wlplan.cli import main
from wlplan.dataset.episode import Episode
from wlplan.dataset.vector_simulator import VectorSimulator
from wlplan.engines.simulator import STOP_REASONS, Settings, Simulator, dig
from wlplan.engines.simulator.cycle import Cycle
from wlplan.engines.simulator.lane import LENGTH, RESIDUE, ROWS, dig_through_lane, lane_of
from wlplan.io import write_pile
from wlplan.site.machine import WA320
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton import steepest_slope
from wlplan.terrain.heightmap import local_axes
from wlplan.types import Action, Performance, Pile, Pose, action_from

ALONG, LEFT = local_axes(52, 1.0)
BEHIND, _ = local_axes(52, 1.0 + LENGTH)
DENSITY = GRAVEL.density
MODERATE = [0.35, 2.5, 0.35, 2.5]
STUBBORN = [0.7, 0.0, 0.7, 0.0]
RAMP = np.clip(math.tan(math.radians(27.0)) * ALONG[:, None] * np.ones(52), 0.0, 4.0)


def ridge(high: float, before: float = 3.0, left: float = 0.0, steep: float = 0.53) -> np.ndarray:
    """Thickness of soil in a lane with a ridge across it, 3 m long [m]."""
    away = np.hypot(BEHIND[:, None] + before, np.maximum(np.abs(LEFT[None] - left) - 1.5, 0.0))
    heap: np.ndarray = np.maximum(high - steep * away, 0.0)
    return heap


Through = Callable[..., Cycle]
Plays = Callable[..., tuple[Pile, Performance, Cycle]]


@pytest.fixture(scope="module")
def through() -> Through:
    """Lanes and actions -> cycles that dig the ramp behind; every batch is filled up to 8."""

    @jax.jit
    @jax.vmap
    def run(lane: jax.Array, action: jax.Array) -> Cycle:
        is_met = (lane[:ROWS] > RESIDUE).any()
        ramp = jnp.asarray(RAMP, jnp.float32)
        return dig_through_lane(ramp, 0.0 * ramp, (lane, is_met), action_from(action))

    def call(lanes: list[np.ndarray], actions: list[list[float]] | None = None) -> Cycle:
        rows = actions or [MODERATE] * len(lanes)
        fill = [min(k, len(lanes) - 1) for k in range(8)]
        cycles = run(
            jnp.asarray(np.array([lanes[k] for k in fill]), jnp.float32),
            jnp.asarray(np.array([rows[k] for k in fill]), jnp.float32),
        )
        cycle: Cycle = jax.tree.map(lambda v: np.asarray(v)[: len(lanes)], cycles)
        return cycle

    return call


def changed(cycle: Cycle) -> np.ndarray:
    assert cycle.lane_change is not None
    return np.asarray(cycle.lane_change, np.float64)


def work_of(cycle: Cycle) -> np.ndarray:
    total: np.ndarray = np.asarray(
        cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
    )
    return total


def test_a_free_lane_changes_nothing(through: Through) -> None:
    """Next to cycles whose lanes are not free; thin layers are none; to rounding, as `dig`."""
    thin = np.full((52, 52), RESIDUE)
    cycle = through([np.zeros((52, 52)), thin, ridge(0.5), 0.0 * thin], [MODERATE] * 3 + [STUBBORN])
    alone = jax.jit(partial(dig, jnp.asarray(RAMP, jnp.float32), jnp.zeros((52, 52))))
    for k, action in ((0, MODERATE), (1, MODERATE), (3, STUBBORN)):
        want = alone(action_from(jnp.asarray(action)))
        for name in ("mass", "time", "work_drive", "work_boom", "work_bucket", "fill_time"):
            np.testing.assert_allclose(getattr(cycle, name)[k], getattr(want, name), rtol=2e-5)
        np.testing.assert_allclose(cycle.height[k], want.height, atol=1e-3)
        assert not changed(cycle)[k].any()
    assert changed(cycle)[2].any()


def test_what_leaves_lane_and_pile_is_the_load(through: Through) -> None:
    lanes = [ridge(h, b, y) for h, b, y in itertools.product((0.2, 0.6), (1.4, 3.0), (0.0, 0.9))]
    cycle = through(lanes)
    lost = -changed(cycle).sum((1, 2))
    lost += (RAMP - np.asarray(cycle.height, np.float64)).sum((1, 2))
    # What of the ridge lies on the map of the dig is not on the ramp here: it came from the lane.
    np.testing.assert_allclose(lost * 0.01 * DENSITY, cycle.mass, atol=0.5)
    # Nothing is taken that is not there, and some of the ridge is.
    for lane, change in zip(lanes, changed(cycle), strict=True):
        assert (lane[:ROWS] + change[:ROWS]).min() >= -1e-5
        assert not change[ROWS:].any()
        assert change.sum() < -0.3 * lane[:ROWS].sum()


def test_the_higher_a_ridge_the_more_is_taken_up_there_and_the_less_is_dug(
    through: Through,
) -> None:
    cycle = through([ridge(h) for h in (0.0, 0.15, 0.3, 0.45, 0.6)])
    taken = -changed(cycle).sum((1, 2))
    dug = (RAMP - np.asarray(cycle.height, np.float64)).sum((1, 2))
    assert (np.diff(taken) > 0.0).all()
    assert (np.diff(dug) < 0.0).all()


def test_a_little_more_than_a_free_lane_makes_little_difference(through: Through) -> None:
    """In a lane that is played the speed gives way to rolling resistance: 1 % of it."""
    high = RESIDUE + np.array([0.0, 1e-3, 2e-3, 4e-3])
    cycle = through([ridge(h) for h in high])
    for values in (cycle.mass, cycle.time, work_of(cycle)):
        np.testing.assert_allclose(values[1:], values[0], rtol=1e-2)


def test_left_and_right_in_the_lane_are_alike(through: Through) -> None:
    lane = ridge(0.5, 2.5, 0.8)
    one, other = (jax.tree.map(lambda v, k=k: v[k], through([lane, lane[:, ::-1]])) for k in (0, 1))
    np.testing.assert_allclose(one.mass, other.mass, rtol=1e-3)
    np.testing.assert_allclose(one.time, other.time, rtol=1e-3)
    np.testing.assert_allclose(changed(one), changed(other)[:, ::-1], atol=5e-3)


def test_who_is_stuck_in_the_lane_ends_there(through: Through) -> None:
    """A lane full of soil: the cycle ends as a filling that takes too long, with what it has."""
    weak = dataclasses.replace(WA320, traction=0.02)
    lane = jnp.asarray(np.where(BEHIND < -1.2, 1.2, 0.0)[:, None] * np.ones(52), jnp.float32)
    ramp = jnp.asarray(RAMP, jnp.float32)
    cycle = jax.jit(partial(dig_through_lane, machine=weak))(
        ramp, 0.0 * ramp, (lane, jnp.asarray(True)), action_from(jnp.asarray(MODERATE))
    )
    assert STOP_REASONS[int(cycle.stop_reason)] == "timeout"
    assert float(cycle.fill_time) == pytest.approx(15.0, abs=1e-3)
    assert -LENGTH - 1.0 <= float(cycle.tip_x) < -1.0
    assert float(cycle.mass) > 0.0
    lost = -changed(cycle).sum()
    lost += (RAMP - np.asarray(cycle.height, np.float64)).sum()
    assert lost * 0.01 * DENSITY == pytest.approx(float(cycle.mass), abs=0.5)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(cycle))


# --- On a pile. ---------------------------------------------------------------------------------

X, Y = np.meshgrid(0.1 * np.arange(160), 0.1 * np.arange(120), indexing="ij")
SLOPE = np.clip(0.5 * (X - 8.0), 0.0, 3.0)
SQUARE, ASLANT = (8.0, 6.0, 0.0), (8.0, 6.0, 0.5)


def pile_of(*heaps: np.ndarray, ground: np.ndarray | None = None) -> Pile:
    floor = np.zeros_like(SLOPE) if ground is None else ground
    height = floor + np.maximum.reduce([SLOPE, *heaps])
    return Pile(jnp.asarray(height, jnp.float32), 0.1, ground=jnp.asarray(floor, jnp.float32))


def mound(x: float, y: float, high: float = 0.5) -> np.ndarray:
    away = np.hypot(X - x, np.maximum(np.abs(Y - y) - 1.0, 0.0))
    heap: np.ndarray = np.maximum(high - 0.5 * away, 0.0)
    return heap


def pose_of(values: tuple[float, ...]) -> Pose:
    return Pose(*(jnp.asarray(v, jnp.float32) for v in values))


@pytest.fixture(scope="module")
def solve() -> Plays:
    run = jax.jit(Simulator(lane_soil=True).play)
    return partial(run, action=action_from(jnp.asarray(MODERATE)))


@pytest.mark.parametrize("place", [SQUARE, ASLANT])
def test_the_ledger_of_the_pile_closes(solve: Plays, place: tuple[float, ...]) -> None:
    pile = pile_of(mound(4.6, 5.2), mound(6.4, 6.3, 0.3))
    after, performance, cycle = solve(pile, pose_of(place))
    lost = (np.asarray(pile.height, np.float64) - np.asarray(after.height, np.float64)).sum()
    assert lost * 0.01 * DENSITY / 1e3 == pytest.approx(float(performance.mass), rel=2e-5)
    assert np.asarray(after.height).min() >= -1e-6
    # The lane is cleared where the bucket went, and what is left of the mounds is at rest.
    assert changed(cycle).sum() < -5.0
    assert np.degrees(steepest_slope(after)) <= 33.0 + 1e-3
    if place is SQUARE:
        assert np.asarray(after.height)[36:60, 52:68].mean() < 0.06


def test_the_floor_of_a_lane_may_slope_and_structures_are_no_soil(
    solve: Plays,
) -> None:
    sloping = 0.03 * X
    step = np.where((X > 4.0) & (X < 4.6) & (Y > 7.0), 1.5, 0.0)
    free, _, plain = solve(pile_of(), pose_of(SQUARE))
    for ground in (sloping, step):
        lane, is_met = lane_of(pile_of(ground=ground), pose_of(SQUARE), WA320)
        assert not bool(is_met)
        assert float(jnp.abs(lane).max()) == 0.0
    heaped = pile_of(mound(4.6, 6.0), ground=sloping)
    lane, is_met = lane_of(heaped, pose_of(SQUARE), WA320)
    level, _ = lane_of(pile_of(mound(4.6, 6.0)), pose_of(SQUARE), WA320)
    assert bool(is_met)
    np.testing.assert_allclose(lane[:ROWS], level[:ROWS], atol=1e-5)
    assert not changed(plain).any()
    assert np.asarray(free.height).shape == SLOPE.shape


def test_beyond_the_map_there_is_no_soil() -> None:
    """The border of a map that ends in soil is not repeated over the lane."""
    pile = Pile(jnp.ones((60, 120), jnp.float32), 0.1)
    lane, is_met = lane_of(pile, pose_of((2.0, 6.0, 0.0)), WA320)
    beyond = BEHIND < -2.0 - 1e-3
    assert bool(is_met)
    assert float(jnp.abs(lane[beyond]).max()) == 0.0
    np.testing.assert_allclose(lane[~beyond], 1.0)


def test_what_lies_beside_or_behind_the_lane_is_not_met() -> None:
    for x, y in ((4.6, 9.5), (1.0, 6.0)):
        assert not bool(lane_of(pile_of(mound(x, y)), pose_of(SQUARE), WA320)[1])
    short = dataclasses.replace(WA320, approach_distance=2.0)
    far = pile_of(mound(4.6, 6.0))
    assert bool(lane_of(far, pose_of(SQUARE), WA320)[1])
    assert not bool(lane_of(far, pose_of(SQUARE), short)[1])
    assert not bool(
        lane_of(far, pose_of(SQUARE), dataclasses.replace(short, approach_distance=1.0))[1]
    )


def test_an_episode_side_by_side_is_played_as_one_alone(solve: Plays) -> None:
    """Loadings with soil in their lanes, among others: as `Simulator.play` makes them."""

    class Lanes(Episode):
        """Digs the same face three times, the first two over mounds."""

        def reset(self) -> None:
            self.height = pile_of(mound(4.6, 5.2), mound(6.0, 9.4)).height
            self.origin = jnp.zeros(2, jnp.float32)

        def next_loading(self) -> tuple[np.ndarray, np.ndarray]:
            at = [SQUARE, (8.0, 9.0, 0.0), SQUARE][self.load]
            self.pose = np.array(at, np.float32)
            return self.pose, np.array(MODERATE, np.float32)

    episodes, finished = (
        iter([Lanes(0, 0, 3, Simulator(lane_soil=True), length=3)]),
        list[Episode | None](),
    )
    VectorSimulator(
        Simulator(lane_soil=True),
        lambda: next(episodes, None),
        finished.append,
        threading.Event(),
    ).run()
    (episode,) = (one for one in finished if one is not None)
    pile = pile_of(mound(4.6, 5.2), mound(6.0, 9.4)).replace(ground=None)
    met = []
    for loading, at in zip(episode.loadings, [SQUARE, (8.0, 9.0, 0.0), SQUARE], strict=True):
        pile, performance, cycle = solve(pile, pose_of(at))
        met.append(bool(changed(cycle).any()))
        for name in ("mass", "time", "work"):
            np.testing.assert_allclose(loading[name], getattr(performance, name), rtol=1e-3)
    np.testing.assert_allclose(episode.height, pile.height, atol=0.02)
    assert met[:2] == [True, True]


@pytest.mark.slow
def test_a_plan_is_played_over_soil_in_the_lane_and_says_so(
    tmp_path: Path,
) -> None:
    scan, plan, out = tmp_path / "scan.npz", tmp_path / "plan.json", tmp_path / "out"
    # A tongue that the pile sends into the lane: what lies apart is another pile.
    write_pile(scan, pile_of(np.where(X > 4.5, np.maximum(0.4 - 0.5 * np.abs(Y - 6.0), 0.0), 0.0)))
    keys = ("delta_bm", "k_bm", "delta_bk", "k_bk")
    load = {"x": 8.0, "y": 6.0, "heading": 0.0, "action": dict(zip(keys, MODERATE, strict=True))}
    plan.write_text(json.dumps({"format": "wlplan.plan/1", "loads": [load]}))
    loaded = {}
    for engine in ("simulator", "simulator-lane"):
        words = [str(scan), str(plan), "--engine", engine, "--out", str(out / engine)]
        assert main(["simulate", *words]) == 0
        document = json.loads((out / engine / "plan.json").read_text())
        loaded[engine] = document["total"]["simulated"]["mass"]
        assert document.get("engine", "simulator") == engine
    assert loaded["simulator-lane"] != pytest.approx(loaded["simulator"], rel=0.01)
    page = (out / "simulator-lane" / "report.html").read_text()
    assert "played in the simulator with soil in the approach lane" in page


@pytest.mark.slow
def test_it_stalls_over_the_ridges_that_stall_the_discrete_elements() -> None:
    """A guard against regressions; the table is in docs/simulator.md."""
    cycles = load(RIDGE)
    theirs = cycles["stop_reason"] == "timeout"
    met, free = (replay(cycles, lane_soil=which) for which in (True, False))
    stalls = met["stop_reason"] == "timeout"
    assert theirs.sum() == 4
    assert (stalls & theirs).sum() == 4
    assert stalls.sum() <= 5
    assert ((free["stop_reason"] == "timeout") & theirs).sum() == 1
    np.testing.assert_allclose(met["mass"], cycles["mass_t"], rtol=0.25)
    assert abs(met["mass"].mean() / cycles["mass_t"].mean() - 1.0) < 0.08


# --- Derivatives. -------------------------------------------------------------------------------


@pytest.mark.slow
def test_gradients_through_the_lane_against_finite_differences() -> None:
    """Of mass, time and work in the height and place of a ridge, and the action."""
    with jax.enable_x64(True):
        along, left = jnp.asarray(BEHIND)[:, None], jnp.asarray(LEFT)[None]

        def outcome(vector: jax.Array, differentiable: bool) -> jax.Array:
            away = jnp.hypot(along + 2.7 + vector[1], jnp.maximum(jnp.abs(left) - 1.51, 0.0) + 1e-3)
            lane = jnp.maximum(vector[0] - 0.53 * away, 0.0)
            is_met = (jax.lax.stop_gradient(lane)[:ROWS] > RESIDUE).any()
            ramp = jnp.asarray(RAMP)
            cycle = dig_through_lane(
                ramp,
                0.0 * ramp,
                (lane, is_met),
                action_from(vector[2:]),
                settings=Settings(differentiable=differentiable),
            )
            work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
            return jnp.stack([cycle.mass, cycle.time, work])

        points = np.array([[0.43, 0.013, *MODERATE], [0.31, -0.021, 0.25, 1.5, 0.4, 2.8]])
        size, step = points.shape[1], 1e-6
        reverse = jax.jit(jax.vmap(jax.jacrev(partial(outcome, differentiable=True))))
        gradient = np.asarray(reverse(jnp.asarray(points)))
        shifts = step * np.concatenate([np.eye(size), -np.eye(size)])
        shifted = (points[:, None] + shifts).reshape(-1, size)
        forward = jax.jit(jax.vmap(partial(outcome, differentiable=False)))
        out = np.asarray(forward(jnp.asarray(shifted))).reshape(len(points), 2, size, 3)
        central = np.moveaxis(out[:, 0] - out[:, 1], 1, 2) / (2 * step)
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient[:, :, 0]) > 0.0).all()
    error = np.linalg.norm(gradient - central, axis=-1)
    np.testing.assert_array_less(error, 1e-2 * np.linalg.norm(central, axis=-1))


@pytest.mark.slow
def test_gradients_of_a_loading_with_and_without_a_ridge_are_finite() -> None:
    world = Simulator(lane_soil=True).with_derivatives()

    @jax.jit
    def gradient(pile: Pile, vector: jax.Array) -> jax.Array:
        def mass(vector: jax.Array) -> jax.Array:
            _, performance = world(pile, Pose(*vector[:3]), Action(*vector[3:]))
            return performance.mass + performance.time + performance.work

        slope: jax.Array = jax.grad(mass)(vector)
        return slope

    vector = jnp.asarray([*ASLANT, *MODERATE], jnp.float32)
    for heaps in ([mound(4.6, 5.2)], [], [SLOPE * 0.0]):
        assert np.isfinite(gradient(pile_of(*heaps), vector)).all()
