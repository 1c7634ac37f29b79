"""Loads that fail in the referee get actions that worked at others, where that is cheaper."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wlplan
from wlplan.planning.job import make_job
from wlplan.planning.plan import choose
from wlplan.planning.proposals import Proposals
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose

LOADS = 4


def hoped(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """What the world that plans foresees: faster with a larger gain, wherever."""
    nothing = 0.0 * pose.x
    return pile, Performance(4.0 + nothing, 10.0 - 0.5 * action.k_bm, 400.0 + nothing)


def stalls_in_the_north(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """The same, but digs of much gain stall north of the middle, which nobody foresaw."""
    _, foreseen = hoped(pile, pose, action)
    stuck = (pose.y > 0.0) & (action.k_bm > 3.0)
    return pile, foreseen.replace(time=jnp.where(stuck, 21.0, foreseen.time))


@pytest.fixture(scope="module")
def pile() -> Pile:
    return wlplan.relax(wlplan.seed_pile("conical", slope=np.radians(30.0), height=2.0))


def plan_of(k_bm: list[float], y: list[float]) -> LoadingPlan:
    count = len(y)

    def row(value: Any) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(value, jnp.float32), (count,))

    pose = Pose(row(-4.0), row(y), row(0.0))
    return LoadingPlan(pose, Action(row(0.3), row(k_bm), row(0.2), row(3.0)))


def chosen(pile: Pile, plan: LoadingPlan, referee: Any, **how: Any) -> wlplan.PlanResult:
    job = make_job(wlplan.world(hoped), pile, objective={"time": 1.0})
    return choose(job, Proposals(plan), referee=wlplan.world(referee), **how)


def test_a_load_that_failed_gets_the_best_action_of_those_that_did_not(pile: Pile) -> None:
    # The second and the last stall. What worked in the south with much gain stalls there too.
    plan = plan_of([4.0, 5.0, 2.0, 4.5], [-0.5, 0.5, -0.3, 0.3])
    left = chosen(pile, plan, stalls_in_the_north, mend=False)
    assert left.refereed is not None
    np.testing.assert_allclose(left.refereed.rollout.performance.time, [8.0, 21.0, 9.0, 21.0])
    made = chosen(pile, plan, stalls_in_the_north)
    assert made.refereed is not None
    np.testing.assert_allclose(made.plan.action.k_bm, [4.0, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(made.refereed.rollout.performance.time, [8.0, 9.0, 9.0, 9.0])
    assert float(made.refereed.cost) < float(left.refereed.cost)
    # What is foreseen is that of the plan that is handed over.
    np.testing.assert_allclose(made.rollout.performance.time, [8.0, 9.0, 9.0, 9.0])
    np.testing.assert_array_equal(made.plan.pose.y, left.plan.pose.y)


def test_each_load_gets_what_is_cheapest_there(pile: Pile) -> None:
    """South of -2 m another gain is too much."""

    def picky(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        _, foreseen = hoped(pile, pose, action)
        limit = jnp.where(pose.y > 0.0, 3.0, jnp.where(pose.y < -0.4, 4.0, 9.0))
        stuck = action.k_bm > limit
        return pile, foreseen.replace(time=jnp.where(stuck, 21.0, foreseen.time))

    plan = plan_of([3.5, 5.0, 2.0, 5.0], [-0.3, 0.3, -0.2, -0.5])
    made = chosen(pile, plan, picky)
    np.testing.assert_allclose(made.plan.action.k_bm, [3.5, 2.0, 2.0, 3.5])


def test_a_load_that_fails_since_another_was_mended_is_mended_too(pile: Pile) -> None:
    """Each dig of little gain leaves the pile lower, and there no other digs get on."""

    def soft(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        _, foreseen = hoped(pile, pose, action)
        gentle = action.k_bm < 3.0
        stuck = ~gentle & ((pose.y > 0.0) | (pile.height.max() < 1.95))
        lower = pile.replace(height=pile.height - jnp.where(gentle, 0.1, 0.0))
        return lower, foreseen.replace(time=jnp.where(stuck, 21.0, foreseen.time))

    assert 1.95 < float(pile.height.max()) < 2.05
    plan = plan_of([4.0, 5.0, 4.5, 2.0], [-0.5, 0.5, -0.3, -0.2])
    left = chosen(pile, plan, soft, mend=False)
    assert left.refereed is not None
    np.testing.assert_allclose(left.refereed.rollout.performance.time, [8.0, 21.0, 7.75, 9.0])
    made = chosen(pile, plan, soft)
    np.testing.assert_allclose(made.plan.action.k_bm, [4.0, 2.0, 2.0, 2.0])
    assert made.refereed is not None
    np.testing.assert_allclose(made.refereed.rollout.performance.time, [8.0, 9.0, 9.0, 9.0])


@pytest.mark.parametrize(
    ("k_bm", "y"),
    [
        # Nothing failed; everything did; what worked elsewhere stalls there too.
        ([4.0, 2.0, 3.0, 4.0], [-0.5, 0.5, -0.3, -0.2]),
        ([4.0, 4.0, 4.0, 4.0], [0.2, 0.5, 0.3, 0.1]),
        ([4.0, 4.0, 4.5, 5.0], [-0.2, 0.5, -0.3, -0.1]),
    ],
)
def test_otherwise_the_plan_is_left_as_it_is(pile: Pile, k_bm: list[float], y: list[float]) -> None:
    plan = plan_of(k_bm, y)
    made, left = (chosen(pile, plan, stalls_in_the_north, mend=mend) for mend in (True, False))
    np.testing.assert_array_equal(made.plan.action.k_bm, k_bm)
    assert made.refereed is not None
    assert left.refereed is not None
    assert float(made.refereed.cost) == float(left.refereed.cost)
