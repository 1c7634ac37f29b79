"""Several rollouts side by side: the same as one after the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wlplan.compilation import EachRow


def shifted(shared, row):
    """Something that uses all of both and is not linear."""
    return {"sum": jnp.sin(row["a"] * shared).sum() + row["b"], "shape": row["a"][::-1]}


def rows(count, dtype=np.float32):
    rng = np.random.default_rng(0)
    return {
        "a": jnp.asarray(rng.normal(size=(count, 3)), dtype),
        "b": jnp.asarray(rng.normal(size=count), dtype),
    }


@pytest.mark.parametrize("count", [1, 2, 7])
def test_rows_are_as_in_a_batch_and_in_their_order(count):
    shared = jnp.asarray([1.0, 2.0, -3.0])
    many = rows(count)
    each = EachRow(shifted)
    for _ in range(2):
        got = each(shared, many)
        expected = jax.vmap(shifted, in_axes=(None, 0))(shared, many)
        assert jax.tree.structure(got) == jax.tree.structure(expected)
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6)


def test_rows_keep_their_precision():
    with jax.enable_x64(True):
        got = EachRow(shifted)(jnp.ones(3), rows(4, np.float64))
        assert got["sum"].dtype == np.float64
        expected = jax.vmap(shifted, in_axes=(None, 0))(jnp.ones(3), rows(4, np.float64))
        np.testing.assert_allclose(got["sum"], expected["sum"], rtol=1e-14)


def test_other_shapes_are_compiled_anew():
    each = EachRow(lambda shared, row: (shared * row).sum())
    np.testing.assert_allclose(each(jnp.float32(2.0), jnp.ones((2, 3))), [6.0, 6.0])
    np.testing.assert_allclose(each(jnp.float32(2.0), jnp.ones((2, 5))), [10.0, 10.0])


def test_an_error_in_a_row_reaches_the_caller():
    def refuses(shared, row):
        raise ValueError("no such row")

    with pytest.raises(ValueError, match="no such row"):
        EachRow(refuses)(jnp.zeros(1), jnp.zeros((3, 2)))
