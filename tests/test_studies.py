"""Studies of differentiability: laws and closed forms on functions that are known."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import wlplan
from wlplan import studies
from wlplan.errors import InputError
from wlplan.planning.job import make_job
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose

MATRIX = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, -0.3], [0.0, -0.3, 3.0]])
SLOPE = np.array([1.0, -2.0, 0.5])
AT = np.array([0.3, -0.2, 0.1])


def quadratic(x: jax.Array) -> jax.Array:
    matrix, slope = (jnp.asarray(part, x.dtype) for part in (MATRIX, SLOPE))
    return 0.5 * x @ matrix @ x + slope @ x


def several(x: jax.Array) -> jax.Array:
    return jnp.stack([quadratic(x), -2.0 * quadratic(x)])


def jump(x: jax.Array) -> jax.Array:
    """Falls by 1 at x = 0, and does not change anywhere else."""
    return jnp.where(x[0] > 0.0, -1.0, 0.0)


def kinked(x: jax.Array) -> jax.Array:
    return jnp.abs(x[0])


def wavy(x: jax.Array) -> jax.Array:
    """A slope of 1, and teeth on it that are 10 times as steep."""
    return x[0] + 0.01 * jnp.sin(1000.0 * x[0])


def valley(x: jax.Array) -> jax.Array:
    return (x[..., 0] - 1.0) ** 2 + 4.0 * (x[..., 1] + 0.5) ** 2


# --- lines


def test_the_line_of_a_quadratic_has_its_values_and_derivatives() -> None:
    places = np.linspace(-1.0, 2.0, 7)
    with jax.enable_x64(True):
        found = studies.line(several, AT, SLOPE, places)
    points = AT + places[:, None] * SLOPE
    values = 0.5 * np.einsum("ni,ij,nj->n", points, MATRIX, points) + points @ SLOPE
    slopes = (points @ MATRIX + SLOPE) @ SLOPE
    np.testing.assert_allclose(found.value, np.stack([values, -2.0 * values], axis=1))
    np.testing.assert_allclose(found.derivative, np.stack([slopes, -2.0 * slopes], axis=1))


def test_a_study_is_pure_and_maps_over_points() -> None:
    points = jnp.stack([jnp.zeros(3), jnp.ones(3)])
    places = jnp.linspace(0.0, 1.0, 4)
    mapped = jax.vmap(lambda at: studies.line(quadratic, at, jnp.ones(3), places).value)(points)
    for at, row in zip(points, mapped, strict=True):
        alone = studies.line(quadratic, at, jnp.ones(3), places).value
        np.testing.assert_allclose(row, alone, rtol=1e-6)


# --- landscapes


def test_the_landscape_of_a_separable_function_is_a_sum_of_its_parts() -> None:
    first, second = np.linspace(-1.0, 2.0, 5), np.linspace(-1.0, 1.0, 3)
    axes = np.eye(2)
    found = studies.landscape(valley, np.zeros(2), (axes[0], axes[1]), first, second)
    wanted = ((first - 1.0) ** 2)[:, None] + 4.0 * (second + 0.5) ** 2
    np.testing.assert_allclose(found.value, wanted, atol=1e-5)


def test_the_descent_ends_in_the_valley_and_its_visits_cost_what_is_there() -> None:
    axes, starts = np.eye(2), np.array([[-1.0, 1.0], [2.5, 0.5]])
    path = studies.descent_path(
        valley, np.zeros(2), (axes[0], axes[1]), starts, iterations=60, length=0.2
    )
    np.testing.assert_allclose(path.place[:, 0], starts)
    np.testing.assert_allclose(path.cost, valley(path.place), rtol=1e-5)
    np.testing.assert_allclose(path.best, [[1.0, -0.5]] * 2, atol=0.05)


# --- smoothing


@pytest.mark.parametrize("order", ["zeroth", "first", "mixed"])
def test_the_smoothed_gradient_of_a_quadratic_is_the_exact_one(order: str) -> None:
    with jax.enable_x64(True):
        found = studies.smoothed_gradient(several, AT, width=0.7, pairs=8, order=order, seed=3)
    exact = MATRIX @ AT + SLOPE
    np.testing.assert_allclose(found.gradient, [exact, -2.0 * exact], rtol=1e-10)
    np.testing.assert_allclose(found.variance, 0.0, atol=1e-20)


def test_at_a_jump_first_order_is_blind_and_zeroth_order_sees_it() -> None:
    """The smoothed jump is -Φ(x / w): its derivative at 0 is -1 / (w √2π)."""
    width, at = 0.5, np.zeros(2)
    wanted = -1.0 / (width * math.sqrt(2.0 * math.pi))
    found: dict[str, Any] = {
        order: studies.smoothed_gradient(jump, at, width=width, pairs=2000, order=order)
        for order in ("zeroth", "first", "mixed")
    }
    np.testing.assert_array_equal(found["first"].gradient, 0.0)
    assert found["first"].variance == 0.0
    error = math.sqrt(float(found["zeroth"].variance))
    assert error < 0.05 * abs(wanted)
    np.testing.assert_allclose(found["zeroth"].gradient, [wanted, 0.0], atol=4.0 * error)
    # Weighed by variance alone it is as blind; within two standard errors of the truth it is not.
    alone = studies.mixed_order(found["zeroth"], found["first"], bias=math.inf)
    np.testing.assert_array_equal(alone.gradient, 0.0)
    away = np.linalg.norm(found["mixed"].gradient - found["zeroth"].gradient)
    np.testing.assert_allclose(away, 2.0 * error, rtol=1e-3)


def test_the_mixture_takes_what_varies_less() -> None:
    """Teeth make derivatives vary, so the values have more to say; on a slope it is either."""
    settings: dict[str, Any] = {"width": 1.0, "pairs": 200}
    at = np.zeros(2)
    zeroth = studies.smoothed_gradient(wavy, at, order="zeroth", **settings)
    first = studies.smoothed_gradient(wavy, at, order="first", **settings)
    mixed = studies.smoothed_gradient(wavy, at, order="mixed", **settings)
    assert float(zeroth.variance) < 1e-3 < 0.1 < float(first.variance)
    assert float(mixed.first_share) < 0.01
    assert float(mixed.variance) <= float(zeroth.variance)
    np.testing.assert_allclose(zeroth.gradient, [1.0, 0.0], atol=0.01)
    share = float(zeroth.variance / (zeroth.variance + first.variance))
    np.testing.assert_allclose(mixed.first_share, share, rtol=1e-4)


def test_the_variance_is_that_of_repeated_estimates() -> None:
    def estimate(seed: jax.Array) -> studies.SmoothedGradient:
        return studies.smoothed_gradient(
            jump, jnp.zeros(2), width=0.5, pairs=40, order="zeroth", seed=seed
        )

    many = jax.vmap(estimate)(jnp.arange(400))
    spread = np.var(many.gradient, axis=0, ddof=1).sum()
    np.testing.assert_allclose(np.mean(many.variance), spread, rtol=0.15)


def test_differences_stand_for_derivatives() -> None:
    """So the studies pass a function that has none."""
    matrix = np.random.default_rng(0).normal(size=(2, 2, 3))

    def multiply(x: Any) -> np.ndarray:
        product: np.ndarray = np.einsum("kij,...ij->...k", matrix, np.asarray(x))
        return product

    def linear(x: jax.Array) -> jax.Array:
        shape = jax.ShapeDtypeStruct((2,), x.dtype)
        found: jax.Array = jax.pure_callback(multiply, shape, x, vmap_method="expand_dims")
        return found

    with jax.enable_x64(True):
        at = np.zeros((2, 3))
        function = studies.Differenced(linear)
        np.testing.assert_allclose(function.jacobian(jnp.asarray(at)), matrix, rtol=1e-8)
        found = studies.line(function, at, matrix[1], np.linspace(0.0, 1.0, 3))
    wanted = np.tensordot(matrix, matrix[1], axes=2)
    np.testing.assert_allclose(found.derivative, np.tile(wanted, (3, 1)), rtol=1e-8)


# --- roughness


def test_the_rest_of_smooth_kinked_and_broken_functions_shrinks_as_it_should() -> None:
    widths, at, along = np.array([0.5, 0.05]), np.zeros(1), np.ones(1)
    cubic = studies.roughness(lambda x: x[0] ** 3 + 2.0 * x[0], at, along, widths)
    np.testing.assert_allclose(cubic.rest[0] / cubic.rest[1], 1e3, rtol=1e-2)
    kink = studies.roughness(kinked, at, along, widths)
    np.testing.assert_allclose(kink.rest[0] / kink.rest[1], 10.0, rtol=1e-3)
    broken = studies.roughness(jump, at, along, widths)
    np.testing.assert_allclose(broken.rest[0] / broken.rest[1], 1.0, rtol=1e-3)
    assert broken.share[1] > 0.2 > 0.01 > cubic.share[1]


def test_a_parabola_has_no_rest_and_its_own_slope() -> None:
    widths = np.array([0.1, 1.0])
    with jax.enable_x64(True):
        found = studies.roughness(several, AT, SLOPE, widths)
    slope = (MATRIX @ AT + SLOPE) @ SLOPE
    np.testing.assert_allclose(found.slope, [[slope, -2.0 * slope]] * 2)
    np.testing.assert_allclose(found.rest, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.share, 0.0, atol=1e-12)


# --- loadings


class Shrinking(struct.PyTreeNode):
    """A loading takes a part of what is left, or of what there was: with memory or without."""

    memory: Any = 1.0

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile, with less of it, and what was taken."""
        part = 0.1 + 0.05 * action.delta_bk
        mass = part * pile.height.sum() * pile.cell_size**2
        after = pile.replace(height=pile.height * (1.0 - self.memory * part))
        return after, Performance(mass=mass, time=10.0 + pose.heading, work=100.0 * action.k_bm)


@pytest.fixture(scope="module")
def pile() -> Pile:
    return wlplan.seed_pile("conical", slope=math.radians(30.0), height=1.5, noise=0.0)


def plan_of(loads: int) -> LoadingPlan:
    each = jnp.full(loads, 0.3)
    pose = Pose(jnp.full(loads, -4.0), 0.2 * jnp.arange(loads, dtype=float), 0.1 * each)
    return LoadingPlan(pose, Action(each, 5.0 * each, each, 5.0 * each))


def test_steps_are_in_the_frame_of_the_pose_and_actions_stay_in_their_box() -> None:
    pose, action = Pose(1.0, 2.0, math.pi / 2.0), Action(0.35, 4.9, 0.01, 2.5)
    ahead, same = studies.moved(pose, action, jnp.asarray(studies.direction("ahead")))
    np.testing.assert_allclose([ahead.x, ahead.y, ahead.heading], [1.0, 2.2, math.pi / 2.0])
    np.testing.assert_allclose([same.k_bm, same.delta_bk], [4.9, 0.01], rtol=1e-6)
    aside, _ = studies.moved(pose, action, jnp.asarray(studies.direction("aside")))
    np.testing.assert_allclose([aside.x, aside.y], [0.8, 2.0], rtol=1e-6)
    _, most = studies.moved(pose, action, jnp.asarray(studies.direction("k_bm")))
    assert most.k_bm == 5.0
    _, least = studies.moved(pose, action, -jnp.asarray(studies.direction("delta_bk")))
    assert least.delta_bk == 0.0


def test_a_direction_of_a_plan_is_that_of_one_of_its_loads() -> None:
    rows = studies.direction("turn", load=2, loads=3)
    assert rows.shape == (3, 7)
    np.testing.assert_array_equal(np.argwhere(rows), [[1, 2]])


def test_the_yield_of_a_loading_is_what_its_world_foresees(pile: Pile) -> None:
    pose, action = Pose(-4.0, 0.0, 0.1), Action(0.3, 2.0, 0.4, 3.0)
    found = studies.LoadingYield(Shrinking(), pile, pose, action)(jnp.zeros(7))
    seen = Shrinking()(pile, pose, action)[1]
    np.testing.assert_allclose(found, [seen.mass, seen.time, seen.work], rtol=1e-6)


@pytest.mark.parametrize(("memory", "narrow"), [(0.0, None), (1.0, None), (1.0, 0.1)])
def test_later_loads_count_as_far_as_the_world_remembers(
    pile: Pile, memory: float, narrow: float | None
) -> None:
    """Of a first part p and parts q the total is V (p + (1 - m p) (1 - (1 - m q)^(n - 1)) / m)."""
    loads = (1, 2, 4)
    job = make_job(Shrinking(jnp.asarray(memory)), pile)
    found = studies.horizon(job, plan_of(4), loads, step=0.5, narrow=narrow)
    volume = float(pile.height.sum()) * pile.cell_size**2
    rate = 0.05 * studies.STEPS[studies.COMPONENTS.index("delta_bk")]
    part = 0.1 + 0.05 * 0.3
    later = memory * np.array([1.0 - (1.0 - part) ** (n - 1) for n in loads])
    wanted = np.zeros((3, 7))
    wanted[:, studies.COMPONENTS.index("delta_bk")] = rate * volume * (1.0 - later)
    mass = studies.TOTALS.index("mass")
    tolerance = 1e-4 if narrow is None else 1e-2
    np.testing.assert_allclose(found.gradient[:, mass], wanted, rtol=tolerance, atol=1e-4)
    np.testing.assert_allclose(found.difference[:, mass], wanted, rtol=1e-2, atol=1e-5)
    if memory == 0.0:
        change = np.asarray(found.gradient - found.gradient[:1])[:, :3]
        np.testing.assert_array_equal(change, 0.0)


def test_no_horizon_is_longer_than_its_plan(pile: Pile) -> None:
    job = make_job(Shrinking(), pile)
    with pytest.raises(InputError, match="no 3 loads in a plan of 2"):
        studies.horizon(job, plan_of(2), (1, 3))


def test_the_cost_of_a_plan_is_that_of_playing_it(pile: Pile) -> None:
    job, plan = make_job(Shrinking(), pile), plan_of(2)
    cost = studies.PlanCost(job, plan)(jnp.zeros((2, 7)))
    np.testing.assert_allclose(cost, wlplan.play(Shrinking(), pile, plan).cost)


# --- what is refused


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: studies.direction("up"), "no component 'up'"),
        (lambda: studies.direction("turn", load=4, loads=3), "no load 4 of 3"),
        (lambda: studies.smoothed_gradient(jump, np.zeros(2), width=0.0), "width is 0"),
        (lambda: studies.smoothed_gradient(jump, np.zeros(2), width=1.0, pairs=2), "too few"),
        (
            lambda: studies.smoothed_gradient(jump, np.zeros(2), width=1.0, order="second"),
            "no order",
        ),
        (
            lambda: studies.roughness(jump, np.zeros(1), np.ones(1), np.ones(1), samples=3),
            "at least 4",
        ),
        (
            lambda: studies.descent_path(
                valley, np.zeros(2), (np.ones(2), np.ones(2)), np.zeros((1, 2)), iterations=0
            ),
            "at least 1",
        ),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(call: Any, told: str) -> None:
    with pytest.raises(InputError, match=told) as refused:
        call()
    assert "\n" not in str(refused.value)
