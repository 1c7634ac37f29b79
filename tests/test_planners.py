"""What every planner keeps to, and where those that search do find the best."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE, circle, cone, spoilt_world

import wlplan
from wlplan import Constraint, Objective
from wlplan.errors import InputError
from wlplan.planning import planners
from wlplan.planning.amounts import Loads, Trucks
from wlplan.planning.job import Decisions, Job, make_job, with_toe
from wlplan.planning.loading import Loading
from wlplan.planning.plan import plan_loads, planner_of
from wlplan.planning.planners import (
    CmaEs,
    CrossEntropy,
    Gradient,
    Greedy,
    IteratedGreedy,
    MaxLoad,
    Nominal,
    RandomSearch,
    TreeSearch,
)
from wlplan.planning.planners.cross_entropy import _coloured
from wlplan.planning.planners.greedy import cost_by_thorough_ways, cost_of, plan_of
from wlplan.planning.playing import PlanResult, outcomes
from wlplan.planning.population import Near, Spread
from wlplan.planning.proposals import NothingWorthIt, Proposals
from wlplan.planning.watch import Watch
from wlplan.types import Action, LoadingPlan, Pose

# Few, and for all the same: what evaluates and refines them is compiled once.
_SEARCH: dict[str, Any] = {"poses_per_metre": 0.5, "actions": 12, "refined": 4, "refine_steps": 20}
GREEDY = Greedy(**_SEARCH)
# As many as go around the toe, for the best first loads are all in the east.
TREE = TreeSearch(**_SEARCH, width=8, apart=3.0)
NOMINAL = Nominal(actions=4, rows=2, refine_steps=2)
SMALL: dict[str, Any] = {
    "cma_es": CmaEs(population=8, iterations=3, start=GREEDY, candidates=2),
    "cross_entropy": CrossEntropy(
        population=10, elites=4, iterations=3, start=GREEDY, candidates=2
    ),
    "gradient": Gradient(starts=2, iterations=3, candidates=2, start=GREEDY),
    "greedy": GREEDY,
    "iterated_greedy": IteratedGreedy(rounds=2, starts=1, greedy=GREEDY, candidates=2),
    "max_load": MaxLoad(**_SEARCH),
    "nominal": NOMINAL,
    "random_search": RandomSearch(plans=16, batch=4, candidates=2),
    "tree_search": TREE,
}
GOAL = Objective({"mass": 1.0})
# Of the best two loads.
LEAST = 4.29 / 2.8 + 4.29 / 3.0


def plan(planner: Any, **options: Any) -> PlanResult:
    if "amount" not in options:
        options = {"loads": 2, **options}
    options = {"objective": GOAL, "site": SITE, "contour": circle(), **options}
    return plan_loads(spoilt_world, cone(), planner=planner, **options)


def job() -> Job:
    asked = make_job(spoilt_world, cone(), site=SITE, objective=GOAL, amount=Loads(2))
    return with_toe(asked, circle())


@pytest.fixture(scope="module")
def plans() -> dict[str, PlanResult]:
    return {name: plan(SMALL[name]) for name in planners.NAMES}


@pytest.mark.parametrize("name", planners.NAMES)
def test_a_plan_has_as_many_loads_as_asked_for(name: str, plans: dict[str, PlanResult]) -> None:
    result = plans[name]
    assert result.costs.shape == (2,)
    assert result.plan.truck is None
    assert np.isfinite(result.costs).all()
    assert result.stopped == ""
    assert result.spent > 0.0


@pytest.mark.parametrize("name", planners.NAMES)
def test_the_same_seed_gives_the_same_plan(name: str, plans: dict[str, PlanResult]) -> None:
    again = plan(SMALL[name])
    for a, b in zip(jax.tree.leaves(again.plan), jax.tree.leaves(plans[name].plan), strict=True):
        np.testing.assert_array_equal(a, b)
    assert again.spent == plans[name].spent


@pytest.mark.parametrize("name", planners.NAMES)
def test_a_budget_is_kept(
    name: str, plans: dict[str, PlanResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is exceeded by no more than what was to be evaluated next; that is a batch."""
    spent: list[float] = []

    class Noting(Watch):
        def spend(self, **evaluations: float | int) -> None:
            before = self.spent
            try:
                super().spend(**evaluations)
            finally:
                spent.append(self.spent - before)

    monkeypatch.setattr("wlplan.planning.plan.Watch", Noting)
    budget = int(0.9 * plans[name].spent)
    result = plan(SMALL[name], budget=budget)
    assert result.stopped == "budget"
    assert budget < result.spent == pytest.approx(sum(spent))
    assert sum(spent[:-1]) <= budget
    assert np.isfinite(result.costs).all()
    assert len(result.costs) >= 1


@pytest.mark.parametrize("name", planners.NAMES)
def test_an_interruption_leaves_the_best_so_far(name: str) -> None:
    calls: list[float | None] = []

    def progress(stage: str, done: int, total: int, cost: float | None) -> None:
        calls.append(cost)
        if len(calls) == 2:
            raise KeyboardInterrupt

    result = plan(SMALL[name], progress=progress)
    assert result.stopped == "interrupted"
    assert len(calls) >= 2
    assert np.isfinite(result.costs).all()
    assert len(result.costs) >= 1


@pytest.mark.parametrize("name", planners.NAMES)
def test_trucks_are_filled(name: str) -> None:
    result = plan(SMALL[name], amount=Trucks(1, 5.6))
    mass = float(np.asarray(result.rollout.performance.mass).sum())
    assert result.plan.truck is not None
    assert set(result.plan.truck.tolist()) == {0}
    assert math.isfinite(float(result.cost))
    if name in ("greedy", "max_load", "tree_search", "cma_es", "cross_entropy"):
        assert mass == pytest.approx(5.6, rel=0.1)


@pytest.mark.parametrize(
    "name", ["cma_es", "cross_entropy", "max_load", "random_search", "tree_search"]
)
def test_a_cost_that_is_never_finite_is_one_clear_error(name: str) -> None:
    seen: list[float | None] = []
    with pytest.raises(InputError, match="no plan has a finite cost"):
        plan(
            SMALL[name],
            objective=nowhere,
            progress=lambda stage, done, total, cost: seen.append(cost),
        )
    assert seen
    assert not np.isfinite(np.array(seen, float)).any()


def nowhere(loading: Loading) -> jax.Array:
    return jnp.nan * loading.performance.mass


@pytest.mark.parametrize("name", sorted({*planners.NAMES} - {"gradient"}))
def test_by_name_nothing_is_refined_where_there_is_no_derivative(name: str) -> None:
    planner: Any = planner_of(name, wlplan.world(spoilt_world, differentiable=False))
    for one in (planner, getattr(planner, "start", None)):
        assert not getattr(one, "refine_steps", 0)


def test_what_is_played_is_counted(plans: dict[str, PlanResult]) -> None:
    start = plans["greedy"].spent
    # A load that is played, with the search of its way.
    one = 1.0 + 0.7
    assert plans["random_search"].spent == pytest.approx(16 * 2 * one)
    # Populations of 10, 8 and 8, and three means.
    assert plans["cross_entropy"].spent == pytest.approx(start + 29 * 2 * one)
    assert plans["cma_es"].spent == pytest.approx(start + (3 * 8 + 3) * 2 * one)
    # Fifteen poses: at the roots of both trees, with their ways, and at the nodes of the first that
    # go on; these are played, and the two loads that are made.
    ways, at_poses = 15 * 0.3, 15 * 20 * 0.25 + 15 * 12 / 150
    nodes = (plans["tree_search"].spent - 2 - 2 * (at_poses + ways)) / (at_poses + 1)
    assert nodes == pytest.approx(round(nodes))
    assert round(nodes) in range(5, 8)


@pytest.mark.parametrize(
    ("planner", "within"),
    [
        (RandomSearch(plans=256), 0.5),
        (CrossEntropy(population=60, iterations=12, start=None), 0.02),
        (CmaEs(iterations=40, start=None), 0.02),
        (TREE, 0.03),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_searches_finds_the_best(planner: Any, within: float) -> None:
    """Greedy takes the fuller load first, which spoils the second."""
    assert plan(planner).cost <= LEAST * (1.0 + within)


def test_iterated_greedy_begins_with_greedy_and_keeps_what_is_better(
    plans: dict[str, PlanResult],
) -> None:
    once = plan(dataclasses.replace(SMALL["iterated_greedy"], rounds=0))
    for a, b in zip(jax.tree.leaves(once.plan), jax.tree.leaves(plans["greedy"].plan), strict=True):
        np.testing.assert_array_equal(a, b)
    costs = [float(plan(IteratedGreedy(rounds=r, greedy=GREEDY)).cost) for r in (0, 3)]
    assert costs[1] <= costs[0]


@dataclasses.dataclass(frozen=True)
class LateGreedy(Greedy):
    """Finds nothing now and then."""

    misses: list[int] = dataclasses.field(default_factory=list)

    def grow(self, *given: Any, **options: Any) -> Any:
        """As the misses have it, from the last to the first."""
        if self.misses and self.misses.pop():
            raise NothingWorthIt
        return super().grow(*given, **options)


def test_iterated_greedy_tries_again_where_one_start_finds_nothing() -> None:
    with pytest.raises(NothingWorthIt):
        IteratedGreedy(starts=2, greedy=LateGreedy(**_SEARCH, misses=[1, 1])).propose(
            job(), 2, seed=0
        )
    late = IteratedGreedy(starts=2, rounds=1, greedy=LateGreedy(**_SEARCH, misses=[1, 0, 1]))
    found = late.propose(job(), 2, seed=0).candidates
    assert np.isfinite(outcomes(job(), found).cost).all()


def test_what_is_made_is_kept_and_the_rest_is_made_again() -> None:
    asked, random = job(), np.random.default_rng(1)
    made = GREEDY.grow(asked, [], 2, random, Watch())
    again = GREEDY.grow(asked, made[:1], 2, random, Watch())
    assert len(made) == len(again) == 2
    assert again[0] is made[0]
    assert again[1].decision.position != made[1].decision.position
    for one in (made, again):
        played = outcomes(asked, jax.tree.map(lambda leaf: leaf[None], plan_of(asked, one, 2)))
        np.testing.assert_allclose(cost_of(asked, one), played.cost[0], rtol=1e-5)
        np.testing.assert_allclose(cost_by_thorough_ways(asked, one, 2), played.cost[0], rtol=1e-6)


def test_a_tree_sees_what_a_load_spoils(plans: dict[str, PlanResult]) -> None:
    greedy, tree = plans["greedy"].plan.pose.x, plans["tree_search"].plan.pose.x
    assert greedy[0] > 0.0
    assert tree[0] < -1.0 < 1.0 < tree[1]
    assert plans["tree_search"].cost < 0.7 * plans["greedy"].cost
    deep = plan(dataclasses.replace(TREE, depth=4))
    assert float(deep.cost) == pytest.approx(float(plans["tree_search"].cost), rel=1e-6)


def test_a_tree_of_depth_one_chooses_by_cost() -> None:
    """Of the same trials, as greedy does."""
    few = {**_SEARCH, "refine_steps": 0, "offsets": (0.0,), "neighbours": 1}
    tree, greedy = plan(TreeSearch(depth=1, **few)), plan(Greedy(**few))
    for a, b in zip(jax.tree.leaves(tree.plan), jax.tree.leaves(greedy.plan), strict=True):
        np.testing.assert_array_equal(a, b)
    assert tree.spent == greedy.spent


def test_max_load_takes_most_of_what_may_be() -> None:
    def eastward(loading: Loading) -> jax.Array:
        return loading.pose.x

    def dug(planner: Any, **terms: Any) -> float:
        goal = Objective({"mass": 1.0, **terms})
        return float(plan(planner, objective=goal, loads=1).plan.pose.x[0])

    few = {**_SEARCH, "refine_steps": 0}
    assert dug(Greedy(**few), east=(0.5, eastward)) < 0.0
    assert dug(MaxLoad(**few), east=(0.5, eastward)) > 0.0
    assert dug(MaxLoad(**few), east=Constraint(eastward)) < 0.1


def test_what_starts_at_a_plan_is_limited_by_it(plans: dict[str, PlanResult]) -> None:
    first: Any = GREEDY.propose(job(), 2, seed=0).candidates
    for name in ("cma_es", "cross_entropy"):
        assert plans[name].cost <= plans["greedy"].cost * (1.0 + 1e-6)
        handed = SMALL[name].propose(job(), 2, seed=0)
        assert handed.candidates.position.shape == (2, 2)
        np.testing.assert_array_equal(handed.limit.position, first.position[0])


@pytest.mark.parametrize("kind", [CrossEntropy, CmaEs])
def test_a_start_has_to_be_decisions(kind: Any) -> None:
    class Fixed:
        def propose(self, job: Job, loads: int, *, seed: int, progress: Any = None) -> Proposals:
            numbers = jnp.zeros(loads)
            return Proposals(LoadingPlan(Pose(*(numbers,) * 3), Action(*(numbers,) * 4)))

    with pytest.raises(InputError, match="plans fixed poses"):
        plan(kind(start=Fixed()))


def test_plans_near_one_differ_only_in_the_loads_it_makes() -> None:
    base = Decisions(
        jnp.asarray([0.1, 0.9, 0.5]),
        jnp.zeros(3),
        jnp.zeros((3, 4)),
        jnp.asarray([0, 0, -1], jnp.int32),
    )
    near = Near(job(), base, Spread(position=2.0, offset=0.3, action=0.5))
    assert near.loads == 2
    numbers = np.zeros((1, 2, 6))
    numbers[0, 1] = [1.0, -1.0, 2.0, 0.0, 0.0, 0.0]
    found = near.plans(numbers)
    length = 2 * np.pi * 4.7
    np.testing.assert_allclose(found.position[0], [0.1, 0.9 + 2.0 / length, 0.5], rtol=1e-3)
    np.testing.assert_allclose(found.offset[0], [0.0, -0.3, 0.0], rtol=1e-6)
    np.testing.assert_allclose(found.action[0, :, 0], [0.0, 1.0, 0.0], rtol=1e-6)
    assert found.truck is not None
    assert found.truck.tolist() == [[0, 0, -1]]
    # Once around is nowhere; only positions go around.
    around = np.zeros((1, 2, 6))
    around[..., :2] = length / 2.0
    step = near.shortest(around)
    np.testing.assert_allclose(step[..., 0], 0.0, atol=0.1)
    np.testing.assert_array_equal(step[..., 1:], around[..., 1:])


def test_coloured_noise_has_variance_one_and_neighbours_alike() -> None:
    random = np.random.default_rng(0)
    white, red = (_coloured(random, (4000, 12, 1), exponent)[..., 0] for exponent in (0.0, 2.0))
    for noise, alike in ((white, 0.0), (red, 0.6)):
        assert noise.var() == pytest.approx(1.0, abs=0.05)
        assert (noise[:, 1:] * noise[:, :-1]).mean() == pytest.approx(alike, abs=0.15)


def test_a_tree_needs_no_compiling_on_another_pile(caplog: pytest.LogCaptureFixture) -> None:
    """However long the toe is, and however many rows of loads go on."""

    def compilations(radius: float) -> list[str]:
        caplog.clear()
        with jax.log_compiles():
            plan_loads(
                spoilt_world, cone(radius=radius), loads=2, planner=TREE, objective=GOAL, site=SITE
            )
        return [r.getMessage() for r in caplog.records if "XLA compilation" in r.getMessage()]

    compilations(5.0)
    assert not compilations(3.0)
