"""Laws of the performance predictor: positive, bounded, finite gradients, alike in every mode."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from wlplan.errors import InputError
from wlplan.models.architecture import ACTIVATIONS
from wlplan.models.layers import soft_clamp
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import INPUTS, OUTPUTS
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.types import LocalHeightmap, Performance

LOW = np.array([0.2, 0.0, -0.3, -0.2, 0.0, 0.0, 0.0, 0.0], np.float32)
HIGH = np.array([0.6, 1.5, 0.3, 0.4, 0.7, 5.0, 0.7, 5.0], np.float32)
OUT_LOW = np.array([0.3, 6.5, 120.0], np.float32)
OUT_HIGH = np.array([4.8, 19.5, 1300.0], np.float32)


def model_of(
    seed: int = 0, hidden: tuple[int, ...] = (32, 32), **settings: Any
) -> LowPerformanceModel:
    graph, params = nnx.split(nnx.jit(lambda: PsiLow(hidden, rngs=nnx.Rngs(seed), **settings))())
    # Large output weights, so that the untrained network asks for negative loads too.
    output: Any = params["output"]
    output["kernel"][...] = 20.0 * output["kernel"][...]
    inputs, outputs = (Normaliser.of(np.stack(rows)) for rows in ((LOW, HIGH), (OUT_LOW, OUT_HIGH)))
    return LowPerformanceModel(params, inputs, outputs, graph)


def inputs_of(count: int, seed: int = 0, wild: float = 0.0) -> tuple[jax.Array, jax.Array]:
    unit = np.random.default_rng(seed).uniform(-wild, 1.0 + wild, (count, INPUTS))
    values = (LOW + (HIGH - LOW) * unit).astype(np.float32)
    return jnp.asarray(values[:, :4]), jnp.asarray(values[:, 4:])


def as_rows(performance: Performance) -> jax.Array:
    return jnp.stack(jax.tree.leaves(performance), axis=-1)


def total(model: LowPerformanceModel, characteristics: jax.Array, action: jax.Array) -> jax.Array:
    p = model.of_view(characteristics, action)
    return p.mass / 3.0 + p.time / 10.0 + p.work / 400.0


@pytest.fixture(scope="module")
def model() -> LowPerformanceModel:
    return model_of()


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("hidden", [(8,), (16, 8), (8, 8, 8)])
def test_the_architectures_of_the_grid_search(hidden: tuple[int, ...], activation: str) -> None:
    def build() -> PsiLow:
        return PsiLow(hidden, activation=activation, rngs=nnx.Rngs(0))

    assert jax.eval_shape(lambda: build()(jnp.zeros((5, INPUTS)))).shape == (5, OUTPUTS)
    sizes = sum(leaf.size for leaf in jax.tree.leaves(nnx.state(nnx.eval_shape(build), nnx.Param)))
    widths = (INPUTS, *hidden, OUTPUTS)
    assert sizes == sum((n + 1) * m for n, m in itertools.pairwise(widths))


def test_dropout_acts_in_training_alone() -> None:
    network = PsiLow((64,), rngs=nnx.Rngs(0))
    x = jnp.ones(INPUTS)
    np.testing.assert_array_equal(network(x), network(x))
    one, other = (network(x, rngs=nnx.Rngs(dropout=seed)) for seed in (1, 2))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(
    "settings", [{"activation": "tanh"}, {"hidden": ()}, {"hidden": (0,)}, {"dropout": 1.0}]
)
def test_an_architecture_without_sense_is_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(InputError) as error:
        PsiLow(rngs=nnx.Rngs(0), **settings)
    assert "\n" not in str(error.value)


def test_a_batch_equals_its_members(model: LowPerformanceModel) -> None:
    characteristics, action = inputs_of(7)
    batch = jax.jit(jax.vmap(model.of_view))(characteristics, action)
    single = [model.of_view(c, a) for c, a in zip(characteristics, action, strict=True)]
    np.testing.assert_allclose(
        as_rows(batch), np.stack([as_rows(p) for p in single]), rtol=2e-5, atol=1e-4
    )


def test_a_model_is_a_pytree_that_passes_through_jit(model: LowPerformanceModel) -> None:
    characteristics, action = inputs_of(1)
    call = jax.jit(lambda m, c, a: m.of_view(c, a))
    first = call(model, characteristics[0], action[0])
    call(model_of(seed=1), characteristics[0], action[0])
    # Other weights are no other program.
    assert call._cache_size() == 1  # type: ignore[attr-defined]
    np.testing.assert_allclose(
        as_rows(first), as_rows(model.of_view(characteristics[0], action[0])), rtol=1e-5
    )


@pytest.mark.parametrize("wild", [0.0, 1.0, 100.0, 1e6])
def test_outcomes_are_positive_and_finite(model: LowPerformanceModel, wild: float) -> None:
    rows = np.asarray(as_rows(jax.vmap(model.of_view)(*inputs_of(300, wild=wild))))
    assert np.all(np.isfinite(rows))
    assert np.all(rows >= 0.001 * (OUT_HIGH - OUT_LOW))


def test_far_out_the_network_promises_nothing_new(model: LowPerformanceModel) -> None:
    sides = np.random.default_rng(0).choice([-1.0, 1.0], (50, INPUTS))
    far, farther = ((LOW + out * (HIGH - LOW) * sides).astype(np.float32) for out in (1e2, 1e6))
    rows = [as_rows(jax.vmap(model.of_view)(x[:, :4], x[:, 4:])) for x in (far, farther)]
    np.testing.assert_allclose(rows[0], rows[1], rtol=1e-5)


def test_the_network_does_ask_for_negative_loads(model: LowPerformanceModel) -> None:
    """Otherwise the test above would not test the floor."""
    characteristics, action = inputs_of(300)
    unit = jax.vmap(model.inputs.normalise)(jnp.concatenate([characteristics, action], axis=1))
    network = nnx.merge(model.graph, model.params)
    assert np.any(jax.vmap(model.outputs.denormalise)(network(unit)) < 0.0)


def test_the_floor_leaves_the_range_of_the_data_alone() -> None:
    params = model_of().params
    output: Any = params["output"]
    output["kernel"][...] = 0.0 * output["kernel"][...]
    output["bias"][...] = jnp.array([0.5, 0.0, 1.0])
    flat = model_of().replace(params=params)
    rows = as_rows(flat.of_view(*(part[0] for part in inputs_of(1))))
    np.testing.assert_allclose(rows, [2.55, 6.5, 1300.0], rtol=1e-3)


@pytest.mark.parametrize("wild", [0.0, 1.0, 1e6])
def test_gradients_are_finite_everywhere(model: LowPerformanceModel, wild: float) -> None:
    gradient = jax.jit(jax.vmap(jax.grad(total, argnums=(1, 2)), in_axes=(None, 0, 0)))
    for part in gradient(model, *inputs_of(200, wild=wild)):
        assert np.all(np.isfinite(part))
    at_border = gradient(model, jnp.asarray([LOW[:4], HIGH[:4]]), jnp.asarray([LOW[4:], HIGH[4:]]))
    for part in at_border:
        assert np.all(np.isfinite(part))
        assert np.all(np.any(part != 0.0, axis=1))


def test_gradients_equal_finite_differences_in_float64(model: LowPerformanceModel) -> None:
    with jax.enable_x64(True):
        characteristics, action = (np.asarray(v, np.float64)[:5] for v in inputs_of(5))
        model = model_of()

        @jax.jit
        def f(both: jax.Array) -> jax.Array:
            return total(model, both[:4], both[4:])

        reverse_mode, forward_mode = jax.jit(jax.grad(f)), jax.jit(jax.jacfwd(f))
        for row in np.concatenate([characteristics, action], axis=1):
            x = jnp.asarray(row)
            assert f(x).dtype == jnp.float64
            got, forward = reverse_mode(x), forward_mode(x)
            np.testing.assert_allclose(got, forward, rtol=1e-9, atol=1e-12)
            step = 1e-6
            want = [(f(x + step * e) - f(x - step * e)) / (2 * step) for e in np.eye(INPUTS)]
            np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-7)


def test_a_local_heightmap_is_seen_by_its_characteristics(model: LowPerformanceModel) -> None:
    rise = np.broadcast_to(0.05 * np.arange(36.0)[:, None], (36, 36)).astype(np.float32)
    local = LocalHeightmap(jnp.asarray(rise), 0.1, 0.0)
    action = inputs_of(1)[1][0]
    want = model.of_view(as_vector(characteristics(local)), action)
    np.testing.assert_array_equal(as_rows(model(local, action)), as_rows(want))
    for wrong in (
        LocalHeightmap(jnp.zeros((52, 52)), 0.1, 0.0),
        LocalHeightmap(jnp.zeros((36, 36)), 0.2, 0.0),
    ):
        with pytest.raises(InputError, match="cells=36"):
            model(wrong, action)


def test_the_soft_clamp_is_the_identity_inside_and_smooth_at_the_border() -> None:
    inside = jnp.linspace(0.0, 1.0, 11)
    np.testing.assert_array_equal(soft_clamp(inside), inside)
    far = soft_clamp(jnp.array([-1e9, -10.0, 10.0, 1e9]))
    np.testing.assert_allclose(far, [-0.25, -0.25, 1.25, 1.25], rtol=1e-6)
    points = jnp.array([-1e-3, 0.0, 1e-3, 0.5, 1.0 - 1e-3, 1.0, 1.0 + 1e-3])
    slope = jax.vmap(jax.grad(lambda v: soft_clamp(v[None])[0]))(points)
    np.testing.assert_allclose(slope, 1.0, atol=1e-4)
    values = soft_clamp(jnp.linspace(-2.0, 3.0, 400))
    # But for rounding: how XLA's exponential rounds depends on how it is compiled.
    assert np.all(np.diff(values) >= -np.finfo(np.float32).eps)
