"""Planners: toe following, squashing, and what each planner promises."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import BEST_ACTION, SITE, bowl_world, circle, cone
from laws import assert_gradient

import wlplan
from wlplan.actions import squash, unsquash
from wlplan.errors import InputError
from wlplan.planning.amounts import Loads, Trucks
from wlplan.planning.job import judged, make_job, with_toe
from wlplan.planning.loading import Loading
from wlplan.planning.plan import plan_loads, play
from wlplan.planning.planners import Gradient, Greedy, Nominal, greedy
from wlplan.planning.planners.greedy import cost_by_thorough_ways, cost_of, plan_of
from wlplan.planning.playing import PlanResult, outcomes
from wlplan.planning.poses import distance_to_toe, pose_at, toe_of
from wlplan.planning.watch import Watch
from wlplan.terrain.excavation import excavate
from wlplan.terrain.toe import TOE_RISE, toe_contour
from wlplan.types import Action, Performance, Pile, Pose, action_vector
from wlplan.worlds.capabilities import as_pytree

GREEDY = Greedy(actions=12, refine_steps=40, refined=4, poses_per_metre=0.5)
NOMINAL = Nominal(actions=12, refine_steps=40, rows=2)
GRADIENT = Gradient(
    starts=2,
    iterations=6,
    candidates=4,
    snapshot_every=3,
    start=GREEDY,
)


def test_squashing_stays_in_the_box_and_is_inverted() -> None:
    raw = jnp.asarray([-40.0, 40.0, 0.0, 1.0])
    action = action_vector(squash(raw))
    np.testing.assert_allclose(action[:3], [0.0, 5.0, 0.35], atol=1e-6)
    part = np.array([0.2, 0.5, 0.7, 0.9])
    back = action_vector(squash(jnp.asarray(unsquash(part), jnp.float32)))
    np.testing.assert_allclose(back / np.array([0.7, 5.0, 0.7, 5.0]), part, rtol=1e-5)


@pytest.mark.parametrize("position", [0.0, 0.3, 0.999, 1.25, -0.4])
def test_a_pose_is_on_the_toe_and_points_into_the_pile(position: float) -> None:
    toe, pile = toe_of(circle()), cone()
    pose = pose_at(toe, pile, jnp.asarray(position), jnp.asarray(0.0))
    assert math.hypot(pose.x, pose.y) == pytest.approx(5.0 - TOE_RISE / 0.5, abs=0.15)
    angle = 2 * np.pi * position
    assert math.cos(float(pose.heading) - angle - np.pi) == pytest.approx(1.0, abs=1e-3)


def test_the_pose_follows_the_toe_of_a_dug_pile() -> None:
    toe, pile = toe_of(circle()), cone()
    first = pose_at(toe, pile, jnp.asarray(0.1), jnp.asarray(0.2))
    dug, *_ = excavate(pile, first, jnp.asarray(2.0), width=2.7)
    second = pose_at(toe, dug, jnp.asarray(0.1), jnp.asarray(0.2))
    assert float(first.heading) == float(second.heading)
    moved = math.hypot(float(second.x - first.x), float(second.y - first.y))
    assert 0.5 < moved < 3.0
    assert float(distance_to_toe(dug, second, width=2.7)) == pytest.approx(0.0, abs=0.02)


def test_without_a_pile_on_the_way_the_pose_stays_on_the_contour() -> None:
    flat = Pile(jnp.zeros((161, 161)), 0.1, (-8.0, -8.0))
    pose = pose_at(toe_of(circle()), flat, jnp.asarray(0.0), jnp.asarray(0.0))
    assert float(pose.x) == pytest.approx(4.7, abs=1e-5)


def test_the_pose_is_differentiable_along_the_toe() -> None:
    with jax.enable_x64(True):
        pile = cone(jnp.float64)
        toe = toe_of(circle(), dtype=np.float64)

        def cost(inputs: tuple[jax.Array, jax.Array]) -> jax.Array:
            pose = pose_at(toe, pile, *inputs)
            return pose.x + 0.3 * pose.y - 0.7 * pose.heading

        assert_gradient(cost, (jnp.asarray(0.1237), jnp.asarray(0.21)), relative=1e-5)


def test_only_accessible_points_are_dug() -> None:
    contour = circle()
    accessible = contour.accessible.copy()
    accessible[50:120] = accessible[200:220] = False
    toe = toe_of(dataclasses.replace(contour, accessible=accessible))
    assert not toe.closed
    assert int(toe.count) == accessible.sum()
    # Beyond the longest gap is where the path begins.
    np.testing.assert_allclose(toe.points[0], contour.points[120], atol=1e-6)
    for position in np.linspace(-0.2, 1.2, 60):
        pose = pose_at(toe, cone(), jnp.asarray(position), jnp.asarray(0.0))
        turn = (math.atan2(pose.y, pose.x) / (2 * np.pi) % 1.0) * 290
        assert accessible[round(turn) % 290] or accessible[round(turn - 0.6) % 290]


@pytest.mark.parametrize("planner", [GREEDY, pytest.param(NOMINAL, marks=pytest.mark.slow)])
def test_the_best_action_is_found(planner: Greedy | Nominal) -> None:
    plan = plan_loads(
        bowl_world, cone(), loads=2, planner=planner, contour=circle(), site=SITE
    ).plan
    found = np.asarray(action_vector(plan.action)) / np.array([0.7, 5.0, 0.7, 5.0])
    assert np.abs(found - BEST_ACTION / np.array([0.7, 5.0, 0.7, 5.0])).max() < 0.15


@pytest.fixture(scope="module")
def plans() -> dict[str, PlanResult]:
    results = {}
    for planner in (NOMINAL, GREEDY, GRADIENT):
        results[type(planner).__name__.lower()] = plan_loads(
            bowl_world, cone(), loads=3, planner=planner, contour=circle(), site=SITE
        )
    return results


def test_a_gradient_plan_costs_at_most_what_greedy_and_nominal_cost(
    plans: dict[str, PlanResult],
) -> None:
    assert plans["gradient"].cost <= plans["greedy"].cost
    assert plans["gradient"].cost <= plans["nominal"].cost


def test_the_same_seed_gives_the_same_plan(plans: dict[str, PlanResult]) -> None:
    again = plan_loads(bowl_world, cone(), loads=3, planner=GREEDY, contour=circle(), site=SITE)
    for a, b in zip(
        jax.tree.leaves(again.plan), jax.tree.leaves(plans["greedy"].plan), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_a_result_is_what_its_plan_yields(plans: dict[str, PlanResult]) -> None:
    """The plan in a result, played again with its poses as they are, gives the result."""
    result = plans["gradient"]
    assert result.plan.pose.x.shape == (3,)
    assert result.costs.shape == (3,)
    assert float(result.costs.sum()) == pytest.approx(float(result.cost), rel=1e-6)
    again = play(bowl_world, cone(), result.plan, site=SITE)
    np.testing.assert_allclose(
        again.rollout.performance.mass, result.rollout.performance.mass, rtol=1e-5
    )
    assert float(again.cost) == pytest.approx(float(result.cost), rel=1e-5)


def test_a_referee_has_the_last_word_among_the_candidates() -> None:
    def contrary(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """Likes what the planner's world does not: another best action."""
        after, performance = bowl_world(pile, pose, action)
        gain = action_vector(action) @ np.array([0.0, 1.0, 0.0, 0.0])
        return after, performance.replace(mass=performance.mass * (0.5 + 0.2 * gain))

    options: dict[str, Any] = {
        "loads": 2,
        "planner": GRADIENT,
        "contour": circle(),
        "site": SITE,
    }
    alone = plan_loads(bowl_world, cone(), **options)
    judged = plan_loads(bowl_world, cone(), referee=contrary, **options)
    greedy = plan_loads(
        bowl_world,
        cone(),
        loads=2,
        planner=GREEDY,
        contour=circle(),
        site=SITE,
        referee=contrary,
    )
    assert alone.refereed is None
    # The greedy plan is among the candidates, and the limit in the planner's own world.
    assert judged.refereed is not None
    assert greedy.refereed is not None
    assert judged.refereed.cost <= greedy.refereed.cost * (1 + 1e-6)
    assert judged.cost <= greedy.cost * (1 + 1e-5)
    # What the referee saw is the plan, with the poses of the result.
    again = play(contrary, cone(), judged.plan, site=SITE)
    assert float(again.cost) == pytest.approx(float(judged.refereed.cost), rel=1e-5)
    assert float(judged.refereed.cost) != float(judged.cost)


class Blind(Greedy):
    """Greedy that is not shown the referee."""

    plays_in_referee = False


@pytest.mark.slow
def test_greedy_makes_the_load_that_is_best_as_the_referee_plays_it() -> None:
    def fails_where_it_is_best(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        after, performance = bowl_world(pile, pose, action)
        part = 0.1 + 0.9 * jax.nn.sigmoid(4.0 * pose.y)
        return after, performance.replace(mass=part * performance.mass)

    options: dict[str, Any] = {"loads": 3, "contour": circle(), "site": SITE}
    settings = {**dataclasses.asdict(GREEDY), "refined": 12}
    referee = wlplan.world(fails_where_it_is_best)
    seeing, blind = (
        plan_loads(
            bowl_world,
            cone(),
            planner=kind(**settings),
            referee=referee,
            mend=False,
            **options,
        )
        for kind in (Greedy, Blind)
    )
    assert seeing.refereed is not None
    assert blind.refereed is not None
    # South of the truck the ways are shortest, and there loads fail.
    assert (np.asarray(blind.plan.pose.y) < 0.0).all()
    assert seeing.plan.pose.y[0] > 0.0
    assert seeing.refereed.cost < 0.5 * blind.refereed.cost


def test_a_load_follows_on_the_pile_that_the_referee_leaves() -> None:
    def takes_all(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """Digs as the planning world has it, and lowers all of the pile besides."""
        after, performance = bowl_world(pile, pose, action)
        return after.replace(height=0.8 * after.height), performance

    job = with_toe(make_job(bowl_world, cone(), site=SITE, amount=Loads(2)), circle())
    asked = job.replace(referee=as_pytree(takes_all))
    made = GREEDY.grow(asked, [], 2, np.random.default_rng(0), Watch())
    low = 0.8**2 * np.asarray(cone().height).max()
    assert np.asarray(made[-1].standing.pile.height).max() <= low * (1.0 + 1e-6)
    plan = jax.tree.map(lambda leaf: leaf[None], plan_of(asked, made, 2))
    played = outcomes(judged(asked), plan)
    mass = played.rollout.performance.mass[0].sum()
    np.testing.assert_allclose(made[-1].standing.done.mass, mass, rtol=1e-5)
    np.testing.assert_allclose(
        made[-1].standing.pile.height, played.rollout.pile.height[0], atol=1e-5
    )
    # The ways of greedy are good ones, those of a play the best.
    assert played.cost[0] <= cost_of(asked, made) <= 1.01 * played.cost[0]
    np.testing.assert_allclose(cost_by_thorough_ways(asked, made, 2), played.cost[0], rtol=1e-6)


def test_loads_that_fill_trucks_cost_what_a_play_of_them_says() -> None:
    """Waits, misfits and what is missing included."""
    job = with_toe(make_job(bowl_world, cone(), site=SITE, amount=Trucks(2, 4.0)), circle())
    made = GREEDY.grow(job, [], 5, np.random.default_rng(0), Watch())
    plan = jax.tree.map(lambda leaf: leaf[None], plan_of(job, made, 5))
    assert len(set(np.asarray(plan.truck[0]).tolist())) >= 2
    played = outcomes(job, plan)
    np.testing.assert_allclose(cost_by_thorough_ways(job, made, 5), played.cost[0], rtol=1e-6)


@pytest.mark.parametrize(("slower", "count"), [(1.0, 2), (1.5, 8)])
def test_the_referee_plays_no_more_than_it_has_to(
    slower: float, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two, where it sees what was foreseen; all, where every load is worse than that."""

    def referee(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        after, performance = bowl_world(pile, pose, action)
        return after, performance.replace(time=slower * performance.time + 10.0 * (slower - 1.0))

    played: list[int] = []
    play = greedy._scores_as_played

    def counted(shared: Any, loads: Any) -> Any:
        played.append(len(loads[0].position))
        return play(shared, loads)

    monkeypatch.setattr(greedy, "_scores_as_played", counted)
    job = with_toe(make_job(bowl_world, cone(), site=SITE, amount=Loads(1)), circle())
    watch = Watch()
    asked = job.replace(referee=as_pytree(referee))
    dataclasses.replace(GREEDY, refined=8).grow(asked, [], 1, np.random.default_rng(0), watch)
    assert sum(played) == count


def test_bad_requests_are_refused() -> None:
    with pytest.raises(InputError, match="unknown planner"):
        plan_loads(bowl_world, cone(), planner="best")
    with pytest.raises(InputError, match="at least 1"):
        plan_loads(bowl_world, cone(), loads=0)
    with pytest.raises(InputError, match="unknown objective"):
        plan_loads(bowl_world, cone(), objective="speed")
    with pytest.raises(InputError, match="no derivative"):
        plan_loads(wlplan.Simulator(), cone(), planner="gradient")
    with pytest.raises(InputError):
        plan_loads(bowl_world, Pile(jnp.zeros((100, 100)), 0.1))


@pytest.mark.parametrize(
    "planner",
    [NOMINAL, *(pytest.param(one, marks=pytest.mark.slow) for one in (GREEDY, GRADIENT))],
    ids=lambda one: type(one).__name__,
)
def test_a_cost_that_is_never_finite_is_one_clear_error(planner: Any) -> None:
    def even(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        return pile, Performance(
            mass=2.0 + 0.0 * pose.x, time=9.0 + action.k_bm, work=300.0 + action.k_bk
        )

    def nowhere(loading: Loading) -> jax.Array:
        return jnp.nan * loading.performance.mass

    seen: list[float | None] = []
    with pytest.raises(InputError, match="no plan has a finite cost"):
        plan_loads(
            even,
            cone(),
            loads=2,
            objective=nowhere,
            planner=planner,
            progress=lambda stage, done, total, cost: seen.append(cost),
        )
    assert seen
    assert not np.isfinite(np.array(seen, float)).any()


def test_a_plan_can_be_made_of_loading_plan_leaves() -> None:
    plan = wlplan.LoadingPlan(
        pose=Pose(jnp.asarray([-5.0]), jnp.asarray([0.0]), jnp.asarray([0.0])),
        action=Action(*(jnp.asarray([v], jnp.float32) for v in BEST_ACTION)),
    )
    outcome = play(bowl_world, cone(), plan, site=SITE)
    assert float(outcome.rollout.performance.mass[0]) == pytest.approx(3.0, rel=1e-4)


# The last one, for it clears what the others share.
@pytest.mark.slow
def test_another_pile_on_the_same_grid_needs_no_compiling(caplog: pytest.LogCaptureFixture) -> None:
    """The next action has to come within a second, on a pile whose toe the last load changed."""
    first, second = cone(), cone(radius=3.0)
    lengths = [toe_contour(pile).length for pile in (first, second)]
    assert abs(lengths[0] - lengths[1]) > 3.0

    def compilations(pile: Pile) -> list[str]:
        caplog.clear()
        with jax.log_compiles():
            plan_loads(bowl_world, pile, loads=1, planner=GREEDY)
        return [r.getMessage() for r in caplog.records if "XLA compilation" in r.getMessage()]

    jax.clear_caches()
    assert compilations(first)
    assert not compilations(second)
