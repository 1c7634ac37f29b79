"""Slope, incidence and curvatures of surfaces whose values are known."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike, DTypeLike
from laws import assert_gradient

from wlplan.terrain.characteristics import as_vector
from wlplan.terrain.characteristics import characteristics as uncompiled
from wlplan.terrain.heightmap import local_axes
from wlplan.types import LocalHeightmap

characteristics = jax.jit(uncompiled)


def local(height: ArrayLike, dtype: DTypeLike = jnp.float32) -> LocalHeightmap:
    return LocalHeightmap(jnp.asarray(height, dtype), 0.1, 0.0)


def grid(cells: int = 36) -> tuple[np.ndarray, ...]:
    return np.meshgrid(*local_axes(cells, 0.0), indexing="ij")


@pytest.mark.parametrize("slope", [10.0, 20.0, 30.0])
@pytest.mark.parametrize("incidence", [-25.0, 0.0, 10.0, 40.0, 100.0])
def test_a_plane(slope: float, incidence: float) -> None:
    x, y = grid()
    a = math.radians(incidence)
    height = math.tan(math.radians(slope)) * (math.cos(a) * x + math.sin(a) * y)
    c = characteristics(local(height))
    assert math.degrees(c.slope) == pytest.approx(slope, abs=0.02)
    assert math.degrees(c.incidence) == pytest.approx(abs(incidence), rel=5e-3, abs=0.03)
    assert float(c.curvature_x) == pytest.approx(0.0, abs=1e-4)
    assert float(c.curvature_y) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(("kx", "ky"), [(0.2, 0.0), (0.0, -0.3), (-0.1, 0.25)])
def test_a_paraboloid_has_its_curvatures_and_convex_is_positive(kx: float, ky: float) -> None:
    x, y = grid()
    height = 0.5 * x - 0.5 * kx * x**2 - 0.5 * ky * y**2
    c = characteristics(local(height))
    assert float(c.curvature_x) == pytest.approx(kx, abs=1e-4)
    assert float(c.curvature_y) == pytest.approx(ky, abs=1e-4)


def test_a_constant_offset_changes_nothing_and_a_reflection_neither() -> None:
    rng = np.random.default_rng(0)
    x, y = grid()
    height = 0.5 * x + 0.1 * y + 0.1 * rng.random(x.shape)
    before = as_vector(characteristics(local(height)))
    np.testing.assert_allclose(before, as_vector(characteristics(local(height + 2.0))), atol=1e-5)
    np.testing.assert_allclose(
        before, as_vector(characteristics(local(height[:, ::-1]))), atol=1e-5
    )


def test_the_gradient_agrees_with_finite_differences() -> None:
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        x, y = grid(8)
        height = 0.5 * x + 0.1 * y + 0.05 * rng.random(x.shape)
        weight = jnp.asarray([1.0, -0.7, 0.3, 0.2])
        assert_gradient(
            lambda h: weight @ as_vector(characteristics(local(h, jnp.float64))),
            jnp.asarray(height),
        )


@pytest.mark.parametrize("height", [np.zeros((36, 36)), np.full((36, 36), 1.5), 0.5 * grid()[0]])
def test_flat_and_head_on_ground_have_finite_values_and_gradients(height: np.ndarray) -> None:
    slopes = jax.jit(jax.jacrev(lambda h: as_vector(characteristics(local(h)))))
    jacobian = slopes(jnp.asarray(height, jnp.float32))
    assert jnp.isfinite(jacobian).all()
    assert jnp.abs(jacobian).max() < 200.0
