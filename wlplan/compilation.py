"""Running several rollouts side by side.

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
