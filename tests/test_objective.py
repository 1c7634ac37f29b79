"""What a loading is worth: values by hand, then gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_gradient

from wlplan.errors import InputError
from wlplan.planning.objective import OBJECTIVES, Objective, loading_cost, objective_named
from wlplan.types import Performance

PLAIN = Objective((2.0, 1.0, 1.0), mass=4.0, time=50.0, work=1000.0)


def cost(objective, mass, time, work, transport_time=0.0, transport_work=0.0):
    values = (jnp.asarray(v, jnp.result_type(float)) for v in (mass, time, work))
    rest = (jnp.asarray(v, jnp.result_type(float)) for v in (transport_time, transport_work))
    return loading_cost(objective, Performance(*values), *rest)


def test_the_reference_loading_costs_the_sum_of_the_weights():
    """But for what the least mass adds, a part in two thousand."""
    for objective in (*OBJECTIVES.values(), PLAIN):
        value = cost(objective, objective.mass, objective.time, objective.work)
        assert value == pytest.approx(sum(objective.weights), rel=1e-3)


def test_values_by_hand():
    # 2 * 4/2 + (10 + 15)/50 + (300 + 200)/1000.
    assert cost(PLAIN, 2.0, 10.0, 300.0, 15.0, 200.0) == pytest.approx(4.0 + 0.5 + 0.5, rel=2e-3)
    assert cost(Objective((0.0, 1.0, 0.0)), 0.0, 46.3, 1e6) == pytest.approx(1.0)
    assert cost(Objective((0.0, 0.0, 1.0)), 0.0, 1e6, 516.5) == pytest.approx(0.5)


def test_the_named_objectives_have_the_follow_ups_weights():
    assert OBJECTIVES["efficiency"].weights == (2.0, 1.0, 1.0)
    assert OBJECTIVES["productivity"].weights[2] == OBJECTIVES["energy"].weights[1] == 0.0
    for name, objective in OBJECTIVES.items():
        assert objective_named(name) is objective
    assert objective_named(PLAIN) is PLAIN


def test_an_unknown_name_is_an_input_error_of_one_line():
    with pytest.raises(InputError, match=r"unknown objective 'speed'; .*efficiency") as error:
        objective_named("speed")
    assert "\n" not in str(error.value)


def test_less_mass_more_time_and_more_work_cost_more():
    base = cost(PLAIN, 3.0, 10.0, 300.0, 15.0, 200.0)
    assert cost(PLAIN, 2.9, 10.0, 300.0, 15.0, 200.0) > base
    for k in range(4):
        more = [10.0, 300.0, 15.0, 200.0]
        more[k] *= 1.1
        assert cost(PLAIN, 3.0, *more) > base


def test_a_batch_equals_its_members():
    rng = np.random.default_rng(0)
    mass, time, work, t, w = jnp.asarray(rng.uniform(1.0, 9.0, (5, 7)), jnp.float32)
    together = loading_cost(PLAIN, Performance(mass, time, work), t, w)
    alone = [cost(PLAIN, *row) for row in zip(mass, time, work, t, w, strict=True)]
    np.testing.assert_allclose(together, jnp.stack(alone), rtol=1e-6)


def test_gradient_against_finite_differences():
    with jax.enable_x64(True):
        point = [jnp.asarray(v) for v in (2.5, 9.0, 310.0, 25.0, 280.0)]
        assert_gradient(lambda p: cost(PLAIN, *p), point, step=1e-4)


def test_an_empty_bucket_has_a_finite_cost_and_gradient():
    for mass in (0.0, 1e-6):
        value, gradient = jax.value_and_grad(lambda m: cost(PLAIN, m, 8.0, 200.0))(mass)
        assert jnp.isfinite(value)
        assert jnp.isfinite(gradient)
        # As much as many good loads, so that it never pays.
        assert value > 10 * cost(PLAIN, 4.0, 8.0, 200.0)
    # Away from zero the gradient says to take more.
    assert jax.grad(lambda m: cost(PLAIN, m, 8.0, 200.0))(0.05) < -10.0
