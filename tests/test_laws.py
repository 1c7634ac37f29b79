"""The checks that guard the others can fail."""

import jax
import jax.numpy as jnp
import pytest
from laws import assert_gradient, assert_no_soil_from_nowhere, assert_volume_kept

from wlplan.types import Pile


def test_the_volume_check_can_fail() -> None:
    height = jnp.ones((8, 8))
    with pytest.raises(AssertionError, match="volume"):
        assert_volume_kept(height, height.at[0, 0].add(1e-3))


def test_the_gradient_check_passes_on_a_polynomial() -> None:
    with jax.enable_x64(True):
        assert_gradient(lambda x: (x**3).sum(), jnp.asarray([0.5, -1.0, 2.0]))


def test_the_gradient_check_sees_a_wrong_gradient() -> None:
    @jax.custom_jvp
    def wrong(x: jax.Array) -> jax.Array:
        return (x**2).sum()

    # A gradient that is 0.1 % off must be found.
    wrong.defjvp(lambda p, t: (wrong(p[0]), 2.002 * (p[0] * t[0]).sum()))
    with jax.enable_x64(True), pytest.raises(AssertionError, match="differ"):
        assert_gradient(wrong, jnp.asarray([0.5, -1.0]))


def test_the_gradient_check_counts_kinks() -> None:
    with jax.enable_x64(True):
        assert assert_gradient(lambda x: jnp.abs(x).sum(), jnp.asarray([0.0, 1.0]), skip=1) == 1
        with pytest.raises(AssertionError, match="differ"):
            assert_gradient(lambda x: jnp.abs(x).sum(), jnp.asarray([0.0, 1.0]))


@pytest.mark.parametrize(
    ("mass", "height", "told"),
    [(-1.0, 1.0, "mass of -1"), (0.1, 1.0, "left the pile"), (0.2, -0.1, "below its floor")],
)
def test_the_check_on_soil_from_nowhere_can_fail(mass: float, height: float, told: str) -> None:
    before = Pile(jnp.ones((10, 10)), 0.1)
    after = before.replace(height=before.height.at[:].set(1.0 - 0.2).at[0, 0].set(height))
    density = 0.2 / float((before.height - after.height).sum() * 0.01)
    with pytest.raises(AssertionError, match=told):
        assert_no_soil_from_nowhere(before, after, mass, density=density)
    plain = before.replace(height=before.height - 0.2)
    assert_no_soil_from_nowhere(before, plain, 0.2, density=1.0)
