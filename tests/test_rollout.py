"""Rollouts: laws with a fake world, then the shipped low world, then its gradients."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike, DTypeLike
from laws import assert_gradient, volume
from precision import in_float64

import wlplan
from wlplan.engines.simulator import Simulator
from wlplan.planning.job import make_job
from wlplan.planning.playing import play_candidate
from wlplan.planning.rollout import load_by_load, rollout
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton import relax
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import toe_contour
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose, Rollout, World, action_from

DENSITY = GRAVEL.density / 1000.0  # [tonne/m^3]


def fake_world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Takes a part of every cell near x, the more the higher the threshold."""
    x = pile.origin[0] + pile.cell_size * jnp.arange(pile.height.shape[0])
    part = 0.3 * action.delta_bk * jnp.exp(-((x - pose.x) ** 2))
    after = pile.replace(height=pile.height * (1.0 - part)[:, None])
    mass = DENSITY * (volume(pile) - volume(after))
    return after, Performance(mass=mass, time=5.0 + action.k_bm * mass, work=100.0 * pose.y + mass)


def heap(seed: int = 0) -> Pile:
    height = np.random.default_rng(seed).uniform(0.5, 1.5, (20, 12)).astype(np.float32)
    return Pile(jnp.asarray(height), 0.1, jnp.asarray([-1.0, 2.0]))


def plan_of(rows: ArrayLike, dtype: DTypeLike = jnp.float32) -> LoadingPlan:
    """Plans from an array [..., N, 7]: x, y, heading, action."""
    rows = jnp.asarray(rows, dtype)
    pose = Pose(rows[..., 0], rows[..., 1], rows[..., 2])
    return LoadingPlan(pose=pose, action=action_from(rows[..., 3:]))


def random_rows(seed: int, loads: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 0.7, (loads, 7))


# --- Laws, with the fake world. -----------------------------------------------------------------


def test_a_rollout_is_the_loop_over_its_loadings() -> None:
    plan, pile = plan_of(random_rows(0, 6)), heap()
    outcome = rollout(fake_world, pile, plan)
    for n in range(6):
        loading = jax.tree.map(lambda leaf, n=n: leaf[n], plan)
        pile, performance = fake_world(pile, loading.pose, loading.action)
        jax.tree.map(
            lambda one, all_, n=n: np.testing.assert_allclose(all_[n], one, rtol=1e-5),
            performance,
            outcome.performance,
        )
    np.testing.assert_allclose(outcome.pile.height, pile.height, rtol=1e-5)
    assert outcome.performance.mass.shape == (6,)


def test_no_loading_leaves_the_pile() -> None:
    outcome = rollout(fake_world, heap(), plan_of(np.zeros((0, 7))))
    np.testing.assert_array_equal(outcome.pile.height, heap().height)
    assert outcome.performance.mass.shape == (0,)


def test_the_parts_of_a_rollout_follow_on() -> None:
    rows = random_rows(1, 5)
    whole = rollout(fake_world, heap(), plan_of(rows))
    first = rollout(fake_world, heap(), plan_of(rows[:2]))
    second = rollout(fake_world, first.pile, plan_of(rows[2:]))
    np.testing.assert_allclose(whole.pile.height, second.pile.height, rtol=1e-6)
    np.testing.assert_allclose(
        whole.performance.work,
        np.concatenate([first.performance.work, second.performance.work]),
        rtol=1e-6,
    )


def test_it_passes_jit_and_vmap_over_plans_and_piles() -> None:
    plans = [plan_of(random_rows(s, 4)) for s in range(3)]
    piles = [heap(s) for s in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *plans)
    heaps = jax.tree.map(lambda *leaves: jnp.stack(leaves), *piles)
    run = jax.jit(lambda pile, plan: rollout(fake_world, pile, plan))
    over_plans = jax.vmap(run, in_axes=(None, 0))(piles[0], stacked)
    over_both = jax.vmap(run)(heaps, stacked)
    for k in range(3):
        alone = run(piles[0], plans[k])
        np.testing.assert_allclose(over_plans.pile.height[k], alone.pile.height, rtol=1e-6)
        alone = run(piles[k], plans[k])
        np.testing.assert_allclose(over_both.performance.mass[k], alone.performance.mass, rtol=1e-5)


def test_it_passes_float64_and_gradients_in_plan_and_pile() -> None:
    with jax.enable_x64(True):
        pile = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), heap())

        def cost(point: tuple[LoadingPlan, jax.Array]) -> jax.Array:
            plan, height = point
            outcome = rollout(fake_world, pile.replace(height=height), plan)
            assert outcome.performance.mass.dtype == jnp.float64
            total: Performance = jax.tree.map(jnp.sum, outcome.performance)
            return total.mass + total.time + total.work / 100.0 + (outcome.pile.height**2).sum()

        assert_gradient(cost, (plan_of(random_rows(2, 3), jnp.float64), pile.height[:, :]))


def test_loadings_may_be_decided_on_the_pile_as_it_is() -> None:
    """The decision reads the pile; what it then saw is what the loop gives by hand."""

    def decide(pile: Pile, threshold: jax.Array) -> tuple[Pose, Action]:
        zero = jnp.zeros(())
        pose = Pose(x=volume(pile), y=pile.height.max(), heading=zero)
        return pose, action_from(jnp.stack([zero, zero, threshold, zero]))

    def world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        after = pile.replace(height=pile.height * (1.0 - action.delta_bk))
        return after, Performance(mass=pose.x, time=pose.y, work=pose.heading)

    thresholds = jnp.asarray([0.5, 0.2, 0.1])

    def load(pile: Pile, threshold: jax.Array) -> tuple[Pile, tuple[LoadingPlan, Performance]]:
        pose, action = decide(pile, threshold)
        after, performance = world(pile, pose, action)
        return after, (LoadingPlan(pose, action), performance)

    after, (plan, performance) = load_by_load(load, heap(), thresholds)
    left = np.cumprod([1.0, 0.5, 0.8])
    np.testing.assert_allclose(plan.pose.x, float(volume(heap())) * left, rtol=1e-5)
    np.testing.assert_allclose(plan.pose.y, float(heap().height.max()) * left, rtol=1e-5)
    np.testing.assert_allclose(plan.action.delta_bk, thresholds)
    np.testing.assert_allclose(performance.mass, plan.pose.x)
    # Played again as a fixed plan, it is the same.
    again = rollout(world, heap(), plan)
    np.testing.assert_allclose(again.pile.height, after.height)


# --- The worlds that ship. ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def low() -> World:
    return wlplan.load_world("low")


@pytest.fixture(scope="module")
def cone() -> tuple[Pile, np.ndarray]:
    """A relaxed 30 degree cone and five loadings along its toe, two of them a second time."""
    pile = jax.jit(relax)(seed_pile("conical", slope=math.radians(30.0)))
    contour = toe_contour(pile)
    rng = np.random.default_rng(0)
    accessible = np.flatnonzero(contour.accessible)
    spots = accessible[(np.array([1, 3, 7, 1, 3]) * accessible.size) // 48]
    rows = np.concatenate(
        [
            contour.points[spots] + rng.normal(0.0, 0.03, (5, 2)),
            contour.heading[spots, None] + rng.normal(0.0, 0.1, (5, 1)),
            rng.uniform(0.25, 0.75, (5, 4)) * [0.7, 5.0, 0.7, 5.0],
        ],
        axis=1,
    )
    # The later loadings follow the toe as it retreats.
    step = 0.5 * (np.arange(5) > 2)
    rows[:, 0] += step * np.cos(rows[:, 2])
    rows[:, 1] += step * np.sin(rows[:, 2])
    return pile, rows


@pytest.fixture(scope="module")
def roll() -> Callable[..., Rollout]:
    """One compiled rollout for any world that is a pytree."""
    return jax.jit(lambda world, pile, plan: rollout(world, pile, plan))


def lost_mass(before: Pile, after: Pile) -> float:
    heights = (np.asarray(p.height, np.float64).sum() for p in (before, after))
    first, last = heights
    return float(first - last) * before.cell_size**2 * DENSITY


def test_the_low_world_removes_what_it_loads(
    low: World, cone: tuple[Pile, np.ndarray], roll: Callable[..., Rollout]
) -> None:
    pile, rows = cone
    outcome = roll(low, pile, plan_of(rows))
    mass = np.asarray(outcome.performance.mass, np.float64)
    assert mass.min() > 0.5
    np.testing.assert_allclose(lost_mass(pile, outcome.pile), mass.sum(), rtol=1e-5)
    assert outcome.pile.height.min() >= -1e-6
    assert np.min(outcome.performance.time) > 5.0


def test_the_simulator_rolls_out_under_the_same_signature(
    cone: tuple[Pile, np.ndarray], roll: Callable[..., Rollout]
) -> None:
    pile, rows = cone
    outcome = roll(Simulator(), pile, plan_of(rows))
    mass = np.asarray(outcome.performance.mass, np.float64)
    assert mass.min() > 0.5
    np.testing.assert_allclose(lost_mass(pile, outcome.pile), mass.sum(), rtol=1e-5)


def cost_in(world: World, pile: Pile) -> Callable[[LoadingPlan], jax.Array]:
    """The objective of a plan, transport included."""
    receiver = Receiver(*(jnp.asarray(v, pile.height.dtype) for v in (-18.03, -3.07, -0.53)))
    job = make_job(world, pile, site=Site(receiver=receiver))
    return lambda plan: play_candidate(job, plan, report=False).cost


@pytest.mark.slow
def test_gradient_of_five_loadings_against_finite_differences(
    low: World, cone: tuple[Pile, np.ndarray]
) -> None:
    with jax.enable_x64(True):
        world, pile = in_float64((low, cone[0]))
        cost = cost_in(world, pile)
        assert_gradient(cost, plan_of(cone[1], jnp.float64), skip=3)


def test_the_gradient_check_can_fail() -> None:
    """A gradient that is a thousandth too long does not pass."""
    with jax.enable_x64(True):
        pile = in_float64(heap())

        def cost(plan: LoadingPlan, error: float) -> jax.Array:
            total = rollout(fake_world, pile, plan).performance
            value = (total.mass + total.time + total.work / 100.0).sum()
            return value + error * (value - jax.lax.stop_gradient(value))

        plan = plan_of(random_rows(3, 5), jnp.float64)
        assert_gradient(lambda p: cost(p, 0.0), plan, skip=3)
        with pytest.raises(AssertionError, match="differ"):
            assert_gradient(lambda p: cost(p, 1e-3), plan, skip=3)


@pytest.fixture(scope="module")
def gradient_of_one(low: World) -> Callable[..., Any]:
    """Gradient of the cost of two loadings with respect to plan and heights."""

    @jax.jit
    def run(height: jax.Array, origin: jax.Array, plan: LoadingPlan) -> Any:
        def cost(plan: LoadingPlan, height: jax.Array) -> jax.Array:
            return cost_in(low, Pile(height, 0.1, origin))(plan)

        return jax.value_and_grad(cost, argnums=(0, 1))(plan, height)

    return run


# Slow, for what it takes to compile; on a smaller grid the same is tested below for any plan.
@pytest.mark.slow
@pytest.mark.parametrize("case", ["on the pile", "off the pile", "off the grid", "flat", "hollow"])
def test_gradients_are_finite_everywhere(
    case: str, cone: tuple[Pile, np.ndarray], gradient_of_one: Callable[..., Any]
) -> None:
    pile, rows = cone
    height, rows = pile.height, rows[[0, 0]]
    if case == "off the pile":
        rows[:, :3] = [-9.3, -9.3, -2.3]
    if case == "off the grid":
        rows[:, :3] = [40.0, -3.0, 0.3]
    if case == "flat":
        height = jnp.zeros_like(height)
    if case == "hollow":  # nothing is left where the bucket digs
        rows[:, :3] = [-1.0, 0.0, 0.0]
        x = np.asarray(pile.origin)[0] + 0.1 * np.arange(height.shape[0])
        height = jnp.where((np.abs(x) < 5.0)[:, None], 0.0, height)
    value, gradient = gradient_of_one(height, pile.origin, plan_of(rows))
    for leaf in jax.tree.leaves((value, gradient)):
        assert np.isfinite(leaf).all()
    if case == "on the pile":
        assert min(np.abs(leaf).max() for leaf in jax.tree.leaves(gradient)) > 0.0


# --- Wherever a bucket may be sent. -------------------------------------------------------------

CELLS, CELL = 48, 0.2  # a small grid, from -4.8 m to 4.6 m
SIDE = CELL * (np.arange(CELLS) - CELLS // 2)


def small_piles() -> np.ndarray:
    """Heights [4, 48, 48]: a cone, level ground, a layer of 5 cm, and a ridge to the border."""
    x, y = np.meshgrid(SIDE, SIDE, indexing="ij")
    bumps = 0.1 * np.random.default_rng(0).normal(size=x.shape)
    cone = np.maximum(1.8 - 0.55 * np.hypot(x, y) + bumps, 0.0)
    ridge = np.maximum(1.5 - 0.5 * np.abs(x), 0.0)
    piles = [cone, np.zeros_like(x), np.where(np.hypot(x, y) < 3.0, 0.05, 0.0), ridge]
    return np.stack(piles).astype(np.float32)


def wild_rows(seed: int, plans: int, loads: int = 2) -> np.ndarray:
    """Plans [plans, loads, 7] of digs on the pile, off it, on lines of the grid and far outside.

    Half of the plans dig the same place again and again, which exhausts it. Actions reach the
    corners of their box.
    """
    rng = np.random.default_rng(seed)
    shape = (plans, loads)
    near, far = rng.uniform(-5.0, 5.0, (*shape, 2)), rng.uniform(-60.0, 60.0, (*shape, 2))
    line = rng.choice(SIDE, (*shape, 2))
    border = np.where(rng.random((*shape, 2)) < 0.5, line, rng.choice(SIDE[[0, -1]], (*shape, 2)))
    away = rng.uniform(-math.pi, math.pi, shape)
    toe = -3.0 * np.stack([np.cos(away), np.sin(away)], axis=-1)
    kind = rng.integers(5, size=shape)[..., None]
    place = np.select([kind == k for k in range(5)], [toe, near, line, border, far])
    heading = np.where(rng.random(shape) < 0.7, away, 0.25 * math.pi * rng.integers(-4, 5, shape))
    action = rng.uniform(size=(*shape, 4))
    action = np.where(rng.random(action.shape) < 0.1, np.round(action), action)
    rows = np.concatenate([place, heading[..., None], action * [0.7, 5.0, 0.7, 5.0]], axis=-1)
    rows[::2] = rows[::2, :1]
    return rows


ANY_PLAN = pytest.mark.parametrize(
    ("plans", "floor"),
    [
        (200, False),
        pytest.param(8_000, False, marks=pytest.mark.slow),
        pytest.param(2_000, True, marks=pytest.mark.slow),
    ],
)


def each_wild_plan(
    function: Callable[[Pile, LoadingPlan], Any], plans: int, floor: bool
) -> tuple[Any, list[str]]:
    """`function(pile, plan)` of random plans, leaves [plans], and what those were, for messages.

    Args:
        function: Of one pile and one plan.
        plans: How many.
        floor: Whether there is a sloping floor under the piles, and a corner that was not seen.
    """
    heights = jnp.asarray(small_piles())
    fields: dict[str, Any] = {}
    if floor:
        i, j = np.indices((CELLS, CELLS))
        fields = {"ground": jnp.asarray(0.02 * CELL * i, jnp.float32), "valid": i + j > 12}
        heights = heights + fields["ground"][None]
    rows = wild_rows(1, plans)
    # Every pile with both kinds of plan.
    which = np.arange(plans) // 2 % len(heights)

    def one(case: tuple[jax.Array, LoadingPlan]) -> Any:
        k, plan = case
        return function(Pile(heights[k], CELL, jnp.asarray(SIDE[[0, 0]]), **fields), plan)

    # One after the other: on a CPU a batch would only make the slowest member's work for all.
    run = jax.jit(lambda *cases: jax.lax.map(one, cases))
    results = jax.tree.map(np.asarray, run(jnp.asarray(which), plan_of(rows)))
    return results, [f"pile {k}, {row}" for k, row in zip(which, rows, strict=True)]


@pytest.mark.slow
@ANY_PLAN
def test_gradients_are_finite_for_any_plan(low: World, plans: int, floor: bool) -> None:
    def check(pile: Pile, plan: LoadingPlan) -> tuple[jax.Array, jax.Array]:
        """Whether the cost and its gradient in plan and heights are finite, and its largest."""

        def cost(plan: LoadingPlan, height: jax.Array) -> jax.Array:
            return cost_in(low, pile.replace(height=height))(plan)

        leaves = jax.tree.leaves(jax.value_and_grad(cost, argnums=(0, 1))(plan, pile.height))
        finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in leaves]).all()
        return finite, jnp.stack([jnp.abs(leaf).max() for leaf in leaves]).max()

    (finite, largest), cases = each_wild_plan(check, plans, floor)
    assert finite.all(), f"{(~finite).sum()} of {plans}: {cases[finite.argmin()]}"
    # What an almost empty bucket costs is steep, but nothing more than that.
    assert largest.max() < 1e5, cases[largest.argmax()]
    assert np.median(largest) > 0.0


@ANY_PLAN
def test_the_ledger_closes_for_any_plan(low: World, plans: int, floor: bool) -> None:
    def check(pile: Pile, plan: LoadingPlan) -> tuple[jax.Array, jax.Array, jax.Array]:
        outcome = rollout(low, pile, plan)
        return pile.height, outcome.pile.height, outcome.performance.mass

    (before, after, mass), cases = each_wild_plan(check, plans, floor)
    lost = (before.astype(np.float64) - after).sum(axis=(1, 2)) * CELL**2 * DENSITY
    error = np.abs(lost - mass.sum(axis=1))
    assert error.max() < 2e-5, cases[error.argmax()]  # [tonne]


@pytest.mark.parametrize("reverse", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vmap_over_plans_and_piles_equals_the_members(low: World, reverse: bool) -> None:
    """In the shipped world, where each member makes its own number of rounds."""
    with jax.enable_x64(True):
        world, piles = in_float64((low, jnp.asarray(small_piles()[[0, 3]])))
        plans = plan_of(wild_rows(2, 3), jnp.float64)

        def play(height: jax.Array, plan: LoadingPlan) -> Any:
            pile = Pile(height, CELL, jnp.asarray(SIDE[[0, 0]]))
            return jax.grad(cost_in(world, pile))(plan) if reverse else rollout(world, pile, plan)

        one = jax.jit(play)
        every = jax.jit(jax.vmap(jax.vmap(play, in_axes=(None, 0)), in_axes=(0, None)))
        batch = every(piles, plans)
        for i in range(2):
            for k in range(3):
                member = one(piles[i], jax.tree.map(lambda leaf, k=k: leaf[k], plans))
                jax.tree.map(
                    lambda a, b, i=i, k=k: np.testing.assert_allclose(b[i, k], a, 1e-8, 1e-10),
                    member,
                    batch,
                )
