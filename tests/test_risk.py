"""Terms of what a loading may cost beyond what is foreseen: by hand, where they count, plans."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_gradient

import wlplan
from wlplan.errors import InputError
from wlplan.planning.loading import Loading, Transport
from wlplan.planning.plan import play
from wlplan.planning.planners import Greedy
from wlplan.planning.risk import Deviation, ExpectedStall, MassDeviation
from wlplan.planning.terms import InverseMass
from wlplan.site.site import Site
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose
from wlplan.worlds.capabilities import as_pytree, can

QUICK = Greedy(actions=4, refine_steps=2, poses_per_metre=0.4)


def outcome(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Three tonnes, wherever; the pile stays as it is."""
    return pile, Performance(3.0 + 0.0 * pose.x, 9.4 + action.k_bm, 400.0 + 0.0 * pose.x)


def likely(pile: Pile, pose: Pose, action: Action) -> jax.Array:
    """More likely the further north."""
    return jax.nn.sigmoid(2.0 * pose.y)


def deviation(pile: Pile, pose: Pose, action: Action) -> Performance:
    return Performance(0.1 + 0.0 * pose.x, 4.63 * action.k_bk, 103.3 + 0.0 * pose.x)


KNOWS = wlplan.world(outcome, stall_probability=likely, uncertainty=deviation)
PLAIN = wlplan.world(outcome)


def loading(world: Any, y: float = 0.0, time: float = 9.4, k_bk: float = 1.0) -> Loading:
    def number(value: Any) -> jax.Array:
        return jnp.asarray(value, jnp.result_type(float))

    return Loading(
        pile=Pile(jnp.ones((4, 4)), 0.1),
        pose=Pose(*map(number, (0.0, y, 0.0))),
        action=Action(*map(number, (0.1, 1.0, 0.2, k_bk))),
        performance=Performance(*map(number, (3.0, time, 400.0))),
        transport=Transport(*map(number, (20.0, 300.0))),
        site=Site(),
        world=world,
    )


def test_an_expected_stall_by_hand() -> None:
    term = ExpectedStall()
    # An even chance of 12 s more.
    assert float(term(loading(KNOWS))) == pytest.approx(0.5 * 12.0 / 46.3, rel=1e-5)
    rare = 1.0 / (1.0 + np.exp(4.0))
    assert float(term(loading(KNOWS, y=-2.0))) == pytest.approx(rare * 12.0 / 46.3, rel=1e-4)
    # A stall that the time has in it already costs nothing more.
    assert float(term(loading(KNOWS, y=9.0, time=22.0))) == 0.0


def test_a_deviation_by_hand() -> None:
    assert float(Deviation()(loading(KNOWS))) == pytest.approx(0.1 + 0.1, rel=1e-5)
    assert float(Deviation()(loading(KNOWS, k_bk=3.0))) == pytest.approx(0.3 + 0.1, rel=1e-5)


def test_a_lighter_load_by_hand() -> None:
    one = loading(KNOWS)
    assert float(MassDeviation()(one)) == pytest.approx(4.29 * 0.1 / 9.0, rel=2e-3)
    # It is the slope of M0 / M: so of a small deviation what the term of the mass differs by.
    lighter = one.replace(performance=one.performance.replace(mass=one.performance.mass - 0.001))
    slope = (float(InverseMass()(lighter)) - float(InverseMass()(one))) / 0.001
    assert float(MassDeviation()(one)) == pytest.approx(0.1 * slope, rel=2e-3)


@pytest.mark.parametrize("term", [ExpectedStall(), Deviation(), MassDeviation()])
def test_where_nothing_is_known_or_open_it_counts_nothing(term: Any) -> None:
    for world in (None, outcome, PLAIN, wlplan.load_world("simulator")):
        assert float(term(loading(world))) == 0.0


@pytest.mark.parametrize("name", ["stall", "deviation", "mass_deviation"])
def test_the_gradients_are_those_of_finite_differences(name: str) -> None:
    goal = wlplan.Objective({name: 1.0})
    with jax.enable_x64(True):

        def cost(point: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
            one = loading(KNOWS)
            return goal(
                one.replace(
                    pose=one.pose.replace(y=point[0]),
                    action=one.action.replace(k_bk=point[1]),
                    performance=one.performance.replace(time=point[2]),
                )
            )

        assert_gradient(cost, tuple(np.array(v) for v in (0.3, 1.5, 10.0)))


def test_an_objective_says_what_its_terms_need() -> None:
    goal = wlplan.Objective({"mass": 2.0, "stall": 1.0, "deviation": 0.5})
    assert goal.needs == {"stall": "stall_probability", "deviation": "uncertainty"}
    assert not wlplan.Objective(wlplan.OBJECTIVES["efficiency"]).needs
    assert wlplan.Objective(wlplan.OBJECTIVES["careful"]).needs == {"mass_deviation": "uncertainty"}
    bounded = wlplan.Objective({"sure": wlplan.Constraint(ExpectedStall())})
    assert bounded.needs == {"sure": "stall_probability"}


def test_a_world_declares_that_it_foresees_stalls() -> None:
    one = loading(KNOWS, y=1.0)
    assert KNOWS.has_stall_probability
    found = KNOWS.stall_probability(one.pile, one.pose, one.action)
    assert float(found) == pytest.approx(1.0 / (1.0 + np.exp(-2.0)))
    assert not PLAIN.has_stall_probability
    with pytest.raises(InputError, match="stall_probability") as error:
        PLAIN.stall_probability(one.pile, one.pose, one.action)
    assert "\n" not in str(error.value)


def test_a_world_that_is_no_pytree_keeps_what_it_knows() -> None:
    class Mine:
        has_stall_probability = True

        def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
            return outcome(pile, pose, action)

        def stall_probability(self, pile: Pile, pose: Pose, action: Action) -> jax.Array:
            return likely(pile, pose, action)

    world = as_pytree(Mine())
    assert can(world, "stall_probability")
    assert not can(world, "uncertainty")
    assert not jax.tree.leaves(world)


@pytest.fixture(scope="module")
def pile() -> Pile:
    return wlplan.relax(wlplan.seed_pile("conical", slope=np.radians(30.0), height=2.0))


@pytest.mark.parametrize("name", ["stall", "deviation", "mass_deviation"])
def test_to_plan_for_what_the_world_does_not_know_is_refused(pile: Pile, name: str) -> None:
    goal = wlplan.Objective({"time": 1.0, name: 1.0})
    calls: list[Any] = [
        lambda: wlplan.plan_loads(PLAIN, pile, loads=1, objective=goal, planner=QUICK),
        lambda: wlplan.next_load(PLAIN, pile, objective=goal),
    ]
    for call in calls:
        with pytest.raises(InputError, match=f"'{name}' needs a world") as error:
            call()
        assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_plan_says_how_likely_its_loads_stall_and_caution_makes_it_less_so(pile: Pile) -> None:
    # The truck stands in the north, where loads are most likely to stall.
    site = Site(receiver=wlplan.Receiver(*(jnp.float32(v) for v in (0.0, 11.0, 0.0))))
    plain = {"time": 1.0, "touching": 0.1}
    found = {}
    for weight in (0.0, 40.0):
        goal = wlplan.Objective({**plain, "stall": weight})
        plan = wlplan.plan_loads(
            KNOWS, pile, loads=2, objective=goal, planner=QUICK, site=site, referee=PLAIN
        )
        y = np.asarray(plan.plan.pose.y)
        assert plan.stall_probability is not None
        np.testing.assert_allclose(plan.stall_probability, 1.0 / (1.0 + np.exp(-2.0 * y)), 1e-4)
        # The referee has played it: nothing is open, and nothing is charged.
        assert plan.refereed is not None
        assert plan.refereed.stall_probability is None
        assert not np.asarray(plan.refereed.terms["stall"]).any()
        found[weight] = float(np.max(plan.stall_probability))
    assert found[0.0] > 0.5
    assert found[40.0] < 0.05


def test_a_plan_is_played_where_nothing_is_known(pile: Pile) -> None:
    goal = wlplan.Objective({"time": 1.0, "stall": 1.0})
    one = loading(KNOWS)
    pose = one.pose.replace(x=jnp.asarray(-3.0))
    plan: LoadingPlan = LoadingPlan(*jax.tree.map(lambda leaf: leaf[None], (pose, one.action)))
    knows, plain = (play(world, pile, plan, objective=goal) for world in (KNOWS, PLAIN))
    assert plain.stall_probability is None
    assert knows.stall_probability is not None
    assert float(plain.terms["stall"][0]) == 0.0
    assert float(knows.cost - plain.cost) == pytest.approx(0.5 * 11.0 / 46.3, rel=1e-4)
