"""What a loading is worth: values by hand, terms of one's own, constraints, gradients."""

import math
from collections.abc import Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike
from laws import assert_gradient

from wlplan.errors import InputError
from wlplan.planning.loading import Loading, Transport
from wlplan.planning.objective import Constraint, Objective, objective_of
from wlplan.planning.objectives import OBJECTIVES
from wlplan.planning.terms import TERMS, CycleTime, CycleWork, InverseMass
from wlplan.site.site import Site
from wlplan.types import Action, Performance, Pile, Pose

PLAIN = Objective(
    {
        "mass": (2.0, InverseMass(4.0)),
        "time": (1.0, CycleTime(50.0)),
        "work": (1.0, CycleWork(1000.0)),
    }
)


def loading(
    mass: ArrayLike,
    time: ArrayLike,
    work: ArrayLike,
    transport_time: ArrayLike = 0.0,
    transport_work: ArrayLike = 0.0,
    x: ArrayLike = 0.0,
) -> Loading:
    def numbers(*values: ArrayLike) -> Iterator[jax.Array]:
        return (jnp.asarray(v, jnp.result_type(float)) for v in values)

    return Loading(
        pile=Pile(jnp.ones((4, 4)), 0.1),
        pose=Pose(*numbers(x, 0.0, 0.0)),
        action=Action(*numbers(0.1, 1.0, 0.2, 2.0)),
        performance=Performance(*numbers(mass, time, work)),
        transport=Transport(*numbers(transport_time, transport_work)),
        site=Site(),
    )


def cost(objective: Objective, *values: ArrayLike) -> jax.Array:
    return objective(loading(*values))


def test_the_reference_loading_costs_the_sum_of_the_weights() -> None:
    """But for what the least mass adds, a part in two thousand."""
    for weights in OBJECTIVES.values():
        terms = (
            cast("InverseMass | CycleTime | CycleWork", TERMS[name])
            for name in ("mass", "time", "work")
        )
        references = [term.reference for term in terms]
        value = cost(Objective(weights), *references)
        # Nothing is touched, and it was played: nothing is uncertain.
        expected = sum(weights.get(name, 0.0) for name in ("mass", "time", "work"))
        assert value == pytest.approx(expected, rel=1e-3)


def test_values_by_hand() -> None:
    # 2 * 4/2 + (10 + 15)/50 + (300 + 200)/1000.
    assert cost(PLAIN, 2.0, 10.0, 300.0, 15.0, 200.0) == pytest.approx(4.0 + 0.5 + 0.5, rel=2e-3)
    assert cost(Objective({"time": 1.0}), 0.0, 46.3, 1e6) == pytest.approx(1.0)
    assert cost(Objective({"work": 1.0}), 0.0, 1e6, 516.5) == pytest.approx(0.5)


def test_the_named_objectives_have_the_follow_ups_weights() -> None:
    efficiency = {"mass": 2.0, "time": 1.0, "work": 1.0}
    assert {name: OBJECTIVES["efficiency"][name] for name in efficiency} == efficiency
    for name, weights in OBJECTIVES.items():
        assert objective_of(name) == Objective(weights)
        assert objective_of(weights) == Objective(weights)
    assert objective_of(PLAIN) is PLAIN
    assert hash(Objective(OBJECTIVES["energy"])) == hash(objective_of("energy"))
    assert objective_of("energy") != objective_of("efficiency")


def far(one: Loading) -> jax.Array:
    """A term of somebody else: how far east the dig is."""
    return one.pose.x


def test_any_function_of_a_loading_is_a_term_and_an_objective() -> None:
    assert objective_of(far)(loading(1.0, 1.0, 1.0, x=3.0)) == 3.0
    assert objective_of(far).names == ("far",)
    for written in ({"far": far}, {"far": (1.0, far)}, {"far": (far, 1.0)}, {"far": [1.0, far]}):
        assert Objective(written)(loading(1.0, 1.0, 1.0, x=3.0)) == 3.0
    both = Objective({"time": 1.0, "far": (0.5, far)})
    one = loading(1.0, 46.3, 1.0, x=3.0)
    assert both(one) == pytest.approx(1.0 + 1.5)
    values = both.values(one)
    assert values["far"] == 3.0
    assert both.cost(values) == both(one)


def test_a_term_sees_the_pile_before_and_the_site() -> None:
    def slab(one: Loading) -> jax.Array:
        return one.pile.height.sum() * one.site.machine.bucket_width

    assert objective_of(slab)(loading(1.0, 1.0, 1.0)) == pytest.approx(16.0 * 2.7)


def test_a_constraint_costs_what_it_is_violated_by_and_says_how_much() -> None:
    bound = Objective({"time": 1.0, "east": Constraint(lambda one: one.pose.x - 2.0, penalty=5.0)})
    assert bound.constraints == ("east",)
    kept, broken = loading(1.0, 46.3, 1.0, x=1.0), loading(1.0, 46.3, 1.0, x=2.5)
    assert bound(kept) == pytest.approx(1.0)
    assert bound.values(kept)["east"] == 0.0
    assert bound(broken) == pytest.approx(1.0 + 5.0 * 0.5)
    assert bound.values(broken)["east"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("written", "complaint"),
    [
        ("speed", r"unknown objective 'speed'.*efficiency"),
        ({"speed": 1.0}, r"unknown term 'speed'.*mass"),
        ({}, "named terms"),
        ({"mass": math.nan}, "'mass'"),
        ({"mass": "much"}, "'mass'"),
        ({"mass": (1.0, 2.0)}, "'mass'"),
    ],
)
def test_what_is_no_objective_is_an_input_error_of_one_line(
    written: str | dict[str, Any], complaint: str
) -> None:
    with pytest.raises(InputError, match=complaint) as error:
        objective_of(written)
    assert "\n" not in str(error.value)


def test_a_term_has_to_be_one_number() -> None:
    with pytest.raises(InputError, match=r"'heights'.*shape \(4, 4\)"):
        Objective({"heights": lambda one: one.pile.height})(loading(1.0, 1.0, 1.0))


def test_less_mass_more_time_and_more_work_cost_more() -> None:
    base = cost(PLAIN, 3.0, 10.0, 300.0, 15.0, 200.0)
    assert cost(PLAIN, 2.9, 10.0, 300.0, 15.0, 200.0) > base
    for k in range(4):
        more = [10.0, 300.0, 15.0, 200.0]
        more[k] *= 1.1
        assert cost(PLAIN, 3.0, *more) > base


def test_a_batch_equals_its_members() -> None:
    rng = np.random.default_rng(0)
    rows = jnp.asarray(rng.uniform(1.0, 9.0, (7, 5)), jnp.float32)
    together = jax.vmap(lambda row: cost(PLAIN, *row))(rows)
    np.testing.assert_allclose(together, [cost(PLAIN, *row) for row in rows], rtol=1e-6)


def test_gradient_against_finite_differences() -> None:
    with jax.enable_x64(True):
        point = [jnp.asarray(v) for v in (2.5, 9.0, 310.0, 25.0, 280.0)]
        assert_gradient(lambda p: cost(PLAIN, *p), point, step=1e-4)


def test_an_empty_bucket_has_a_finite_cost_and_gradient() -> None:
    for mass in (0.0, 1e-6):
        value, gradient = jax.value_and_grad(lambda m: cost(PLAIN, m, 8.0, 200.0))(mass)
        assert jnp.isfinite(value)
        assert jnp.isfinite(gradient)
        # As much as many good loads, so that it never pays.
        assert value > 10 * cost(PLAIN, 4.0, 8.0, 200.0)
    # Away from zero the gradient says to take more.
    assert jax.grad(lambda m: cost(PLAIN, m, 8.0, 200.0))(0.05) < -10.0
