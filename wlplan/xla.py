"""What XLA has to be helped with: several rollouts side by side, and results that are kept.

A CPU gains nothing from a batch of rollouts, which only takes longer to compile and waits for its
slowest member; but each of its cores can run one.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.types import PyTree


class EachRow:
    """`function(shared, row)` for several rows: pytrees whose leaves have one more leading axis.

    On a CPU the rows are shared out among its cores, elsewhere they are one `vmap`.

    Args:
        function: Pure function of what the rows share and of one row.
    """

    def __init__(self, function: Callable[[Any, Any], Any]):
        self._one = jax.jit(function)
        self._batch = jax.jit(jax.vmap(function, in_axes=(None, 0)))
        self._ran: set[Any] = set()

    def __call__(self, shared: Any, rows: Any) -> Any:
        """The results, leaves with the leading axis of the rows."""
        if jax.default_backend() != "cpu":
            return self._batch(shared, rows)
        count = len(jax.tree.leaves(rows)[0])
        members = [jax.tree.map(lambda leaf, k=k: leaf[k], rows) for k in range(count)]
        results = []
        kind = _kind(shared, members[0])
        if kind not in self._ran:
            # Alone, so that it is compiled once.
            results.append(jax.block_until_ready(self._one(shared, members.pop(0))))
            self._ran.add(kind)
        # The precision is a setting of the thread.
        double = jnp.zeros(()).dtype == np.float64

        def run(member: Any) -> Any:
            with jax.enable_x64(double):
                return jax.block_until_ready(self._one(shared, member))

        results += _threads().map(run, members)
        # By numpy: another number of rows would be compiled anew.
        return jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *results)


def stored(values: PyTree, wanted: Bool[Array, ""], *, otherwise: float = 0.0) -> PyTree:
    """Arrays as they are, or filled with a number where they are not wanted.

    On a CPU XLA computes an array anew in each operation that uses it, and for each element of a
    larger array that it is part of. A branch makes it store the array. On other devices, where a
    branch costs more than it saves, nothing is done.

    Args:
        values: Pytree of arrays.
        wanted: Must not be known when compiling.
        otherwise: The number.
    """
    if jax.default_backend() != "cpu":
        return values

    def unwanted(values: PyTree) -> PyTree:
        return jax.tree.map(lambda leaf: jnp.full_like(leaf, otherwise), values)

    return lax.cond(wanted, lambda values: values, unwanted, values)


def kept(values: PyTree, source: Float[Array, ""]) -> PyTree:
    """`stored` for arrays that are wanted unless a number they come from is NaN; then so are they.

    Args:
        values: Pytree of arrays.
        source: For instance one of the heights; not of a single member of a batch, since a branch
            that differs among members is no branch.
    """
    return stored(values, source == source, otherwise=float("nan"))


def floats(values: np.ndarray) -> Array:
    """float32, or float64 under `jax_enable_x64`, without a warning from the conversion."""
    return jnp.asarray(values.astype(jnp.zeros(()).dtype))


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores())


def _kind(*arguments: Any) -> Any:
    leaves, tree = jax.tree.flatten(arguments)
    return tree, tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
