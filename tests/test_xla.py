"""Rows mapped in parallel are as one after the other, and a materialized array is as it was."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike

from wlplan.parallel import ParallelMap
from wlplan.xla import cores, materialize, materialize_if


def shifted(shared: jax.Array, row: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Something that uses all of both and is not linear."""
    return {"sum": jnp.sin(row["a"] * shared).sum() + row["b"], "shape": row["a"][::-1]}


def rows(count: int, dtype: DTypeLike = np.float32) -> dict[str, jax.Array]:
    rng = np.random.default_rng(0)
    return {
        "a": jnp.asarray(rng.normal(size=(count, 3)), dtype),
        "b": jnp.asarray(rng.normal(size=count), dtype),
    }


@pytest.mark.parametrize("count", [1, 2, 7])
def test_rows_are_as_in_a_batch_and_in_their_order(count: int) -> None:
    shared = jnp.asarray([1.0, 2.0, -3.0])
    many = rows(count)
    each = ParallelMap(shifted)
    for _ in range(2):
        got = each(shared, many)
        expected = jax.vmap(shifted, in_axes=(None, 0))(shared, many)
        assert jax.tree.structure(got) == jax.tree.structure(expected)  # type: ignore[operator]
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6)


def test_rows_keep_their_precision() -> None:
    with jax.enable_x64(True):
        got = ParallelMap(shifted)(jnp.ones(3), rows(4, np.float64))
        assert got["sum"].dtype == np.float64
        expected = jax.vmap(shifted, in_axes=(None, 0))(jnp.ones(3), rows(4, np.float64))
        np.testing.assert_allclose(got["sum"], expected["sum"], rtol=1e-14)


def test_other_shapes_are_compiled_anew() -> None:
    each = ParallelMap(lambda shared, row: (shared * row).sum())
    np.testing.assert_allclose(each(jnp.float32(2.0), jnp.ones((2, 3))), [6.0, 6.0])
    np.testing.assert_allclose(each(jnp.float32(2.0), jnp.ones((2, 5))), [10.0, 10.0])


def test_an_error_in_a_row_reaches_the_caller() -> None:
    def refuses(shared: jax.Array, row: jax.Array) -> jax.Array:
        raise ValueError("no such row")

    with pytest.raises(ValueError, match="no such row"):
        ParallelMap(refuses)(jnp.zeros(1), jnp.zeros((3, 2)))


def test_what_is_materialized_is_what_it_was() -> None:
    values = {"a": jnp.arange(3.0), "b": jnp.ones((2, 2))}
    through = jax.jit(lambda values, source: materialize(values, source))
    jax.tree.map(np.testing.assert_array_equal, through(values, jnp.float32(0.0)), values)
    gradient = jax.grad(lambda a: (materialize(a**2, a[0])).sum())(jnp.arange(3.0))
    np.testing.assert_array_equal(gradient, 2.0 * np.arange(3.0))


def test_what_comes_from_nan_is_nan() -> None:
    """Not zero: that would hide it."""
    found = jax.jit(lambda x: materialize(jnp.ones(3), x))(jnp.float32(np.nan))
    assert np.isnan(found).all() or jax.default_backend() != "cpu"


def test_what_is_not_wanted_is_filled() -> None:
    fill = jax.jit(lambda wanted: materialize_if(jnp.ones(2), wanted, otherwise=5.0))
    np.testing.assert_array_equal(fill(jnp.array(True)), [1.0, 1.0])
    if jax.default_backend() == "cpu":
        np.testing.assert_array_equal(fill(jnp.array(False)), [5.0, 5.0])


def test_at_least_one_core_is_there() -> None:
    assert 1 <= cores() <= (os.cpu_count() or 1)


# Compiles for two seconds in a thread, one thing after another, and ends meanwhile.
ENDS = """
import sys, time
import jax, jax.numpy as jnp
from wlplan.parallel import Ahead, is_compiling_ahead
begun = []

def several():
    until = time.monotonic() + 2.0
    while time.monotonic() < until:
        begun.append(1)
        jax.jit(lambda x: x + len(begun))(jnp.ones(3))

Ahead().run(several)
while not begun:
    time.sleep(0.01)
assert is_compiling_ahead()
{}
"""


@pytest.mark.parametrize(
    ("ending", "code"),
    [
        ("sys.exit(5)", 5),
        ("from wlplan import cli; sys.argv[1:] = ['plan', '--loads', 'x']; cli.run()", 2),
    ],
)
def test_a_process_that_ends_while_it_compiles_ends_well(ending: str, code: int) -> None:
    program = ENDS.format(ending)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr.count("\n")) == (code, int(code == 2)), done.stderr
