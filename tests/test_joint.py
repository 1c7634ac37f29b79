"""The place of the truck and the digs of a plan refined together, as an experiment does."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE, bowl_world, circle, cone
from laws import assert_gradient
from precision import in_float64

from experiments._common.joint import (
    Placed,
    _allowed,
    _shortest_mixture,
    cost_of_placed,
    refined,
)
from wlplan.planning.amounts import Trucks
from wlplan.planning.job import Decisions, Job, make_job, with_toe
from wlplan.planning.placement import place_of
from wlplan.planning.playing import outcomes
from wlplan.planning.spots import at_receiver
from wlplan.planning.watch import Watch


def job_on_the_cone(dtype: Any = jnp.float32) -> Job:
    site = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), SITE)
    job = make_job(bowl_world, cone(dtype), site=site, objective="delivery")
    return with_toe(job, circle())


def digs(dtype: Any = jnp.float32) -> Decisions:
    """Two of them in the west, where the truck is."""
    return Decisions(
        jnp.asarray([0.47, 0.53], dtype),
        jnp.asarray([0.1, -0.2], dtype),
        jnp.asarray([[0.1, -0.3, 0.2, 0.4], [0.0, 0.2, -0.1, 0.3]], dtype),
    )


def as_row(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[None], tree)


@pytest.mark.slow
def test_the_cost_of_a_plan_against_finite_differences_of_place_and_digs() -> None:
    with jax.enable_x64(True):
        job, plan = in_float64(job_on_the_cone(jnp.float64)), digs(jnp.float64)
        placed = Placed(job.site.placed_receiver, plan)

        def cost(placed: Placed) -> jax.Array:
            return cost_of_placed(job, placed)

        assert assert_gradient(cost, placed, step=1e-5) == 0
        gradient = jax.jit(jax.grad(cost))(placed).receiver
        assert min(abs(float(value)) for value in jax.tree.leaves(gradient)) > 1e-4


def anywhere(places: np.ndarray) -> np.ndarray:
    return np.ones(len(places), bool)


def west_of(limit: float) -> Any:
    return lambda places: places[:, 0] <= limit


@pytest.mark.slow
def test_place_and_digs_get_cheaper_and_keep_to_where_a_truck_may_stand() -> None:
    job, plan = job_on_the_cone(), digs()
    start = outcomes(job, as_row(plan))
    limit = float(job.site.placed_receiver.x) + 0.2
    for may_stand in (anywhere, west_of(limit)):
        watch = Watch()
        found = refined(job, plan, may_stand, steps=7, watch=watch)
        after = outcomes(at_receiver(job, found.receiver), as_row(found.plan))
        assert float(after.cost[0]) < float(start.cost[0]) - 0.01
        # Three parts of each step are looked at with their gradients, and where it begins.
        assert watch.spent == (7 * 3 + 1) * 2 * 4
        # The ways are shorter, and the digs have a part in that it is cheaper.
        assert float(after.transport.time.sum()) < float(start.transport.time.sum())
        same_digs = outcomes(at_receiver(job, found.receiver), as_row(plan))
        assert float(after.cost[0]) < float(same_digs.cost[0]) - 1e-3
        assert place_of(found.receiver)[0] <= (limit if may_stand is not anywhere else np.inf)
        assert (place_of(found.receiver) != place_of(job.site.placed_receiver)).any()


@pytest.mark.slow
def test_trucks_that_are_just_full_stay_so() -> None:
    """The digs are at a kink: less in a truck costs much. The place is refined all the same."""
    plan = digs().replace(truck=jnp.asarray([0, 0]))
    job = job_on_the_cone()
    mass = float(outcomes(job, as_row(plan)).rollout.performance.mass.sum())
    job = job.replace(amount=Trucks(1, mass / 0.95))
    start = outcomes(job, as_row(plan))
    np.testing.assert_allclose(float(start.misfit.sum()), 0.0, atol=1e-4)
    found = refined(job, plan, anywhere, steps=7, watch=Watch())
    after = outcomes(at_receiver(job, found.receiver), as_row(found.plan))
    assert float(after.cost[0]) < float(start.cost[0]) - 0.005
    assert float(after.misfit.sum()) < 2e-3
    np.testing.assert_array_equal(np.asarray(after.plan.truck), [[0, 0]])


def test_a_step_is_made_as_far_as_there_is_room() -> None:
    old, new = np.array([0.0, 0.0, 0.0]), np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(_allowed(old, new, anywhere), new)
    np.testing.assert_array_equal(_allowed(old, new, west_of(0.5)), [0.0, 2.0, 3.0])
    nowhere = lambda places: np.zeros(len(places), bool)  # noqa: E731
    np.testing.assert_array_equal(_allowed(old, new, nowhere), old)


def test_the_shortest_mixture_by_hand() -> None:
    rows = np.array([[1.0, 3.0, 0.0], [1.0, -1.0, 0.0]])
    np.testing.assert_allclose(_shortest_mixture(rows), [1.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(_shortest_mixture(rows[:1]), rows[0])
    # One of them is nearer to zero than any mixture with the other.
    rows = np.array([[1.0, 0.0], [3.0, 0.5]])
    np.testing.assert_allclose(_shortest_mixture(rows), rows[0], atol=1e-4)
