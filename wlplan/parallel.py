"""Maps over cores and devices, and programs that are compiled while there is other work.

A CPU gains nothing from a batch of rollouts, which only takes longer to compile and waits for its
slowest member; but each of its cores can run one. Of several devices each takes a part of a batch.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from wlplan.traced import Traced
from wlplan.xla import cores

# The axis of a mesh of devices along which rows lie.
_ROWS = "rows"


# The name of threads that compile.
_AHEAD = "wlplan compiles ahead"


def is_compiling_ahead() -> bool:
    """Whether something is compiled ahead; a process that ends then waits, or uses `os._exit`."""
    return any(thread.name == _AHEAD for thread in threading.enumerate())


class ParallelMap:
    """A compiled `function(shared, row)`, mapped over rows in parallel.

    On a CPU each core takes one row at a time. Elsewhere the rows are one `vmap`; of several
    devices each has a part of it, and none waits for another before all are done.

    Args:
        function: Pure function of two pytrees: what all rows share, and one row.
        on_core: The same for a row on a core, not compiled as a whole; None: `function`, compiled.
    """

    def __init__(
        self,
        function: Callable[[Any, Any], Any],
        on_core: Callable[[Any, Any], Any] | None = None,
    ):
        self._one = Traced(function) if on_core is None else on_core
        self._function = function
        self._ran: set[Any] = set()

    def __call__(self, shared: Any, rows: Any) -> Any:
        """The results of all rows.

        Args:
            shared: Pytree that every call of the function gets.
            rows: Pytree whose leaves have a leading axis `n`, one entry a row.

        Returns:
            Pytree of the function's results, leaves with the same leading axis `n`.
        """
        if jax.default_backend() != "cpu" or jax.local_device_count() > 1:
            return self._over_devices(shared, rows)
        tree: Any
        leaves, tree = jax.tree.flatten(rows)
        # By numpy, as below: what picks a row would be compiled for each shape.
        leaves, count = [np.asarray(leaf) for leaf in leaves], len(leaves[0])
        members = [tree.unflatten(leaf[k] for leaf in leaves) for k in range(count)]
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

    def _over_devices(self, shared: Any, rows: Any) -> Any:
        """A batch on each device; the last row again fills up what does not come out even."""
        count, devices = len(jax.tree.leaves(rows)[0]), jax.local_device_count()
        if spare := -count % devices:
            which = np.minimum(np.arange(count + spare), count - 1)
            rows = jax.tree.map(lambda leaf: jnp.asarray(leaf)[which], rows)
        results = self._batch(shared, rows)
        if spare:
            results = jax.tree.map(lambda leaf: leaf[:count], results)
        return results

    @functools.cached_property
    def _batch(self) -> Callable[[Any, Any], Any]:
        mesh = Mesh(np.array(jax.local_devices()), (_ROWS,))
        on_each = jax.shard_map(
            jax.vmap(self._function, in_axes=(None, 0)),
            mesh=mesh,
            in_specs=(PartitionSpec(), PartitionSpec(_ROWS)),
            out_specs=PartitionSpec(_ROWS),
            # Loops begin with constants, which are the same on all devices, and end with rows.
            check_vma=False,
        )
        return jax.jit(on_each)


class Ahead:
    """Has something compiled in a thread of its own, while there is other work.

    Who needs it waits, since what two threads ask for at once is compiled twice. A process waits
    for it too before it ends: XLA would end it by a fault in the middle of compiling.
    """

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None

    def run(self, call: Callable[[], Any]) -> None:
        """Calls what compiles as it is called; what goes wrong there goes wrong later, in turn."""
        self.wait()
        double = jnp.zeros(()).dtype == np.float64

        def quietly() -> None:
            with contextlib.suppress(Exception), jax.enable_x64(double):
                call()

        self._thread = threading.Thread(target=quietly, name=_AHEAD)
        self._thread.start()

    def wait(self) -> None:
        """Until that is done; not in the thread itself."""
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()
            self._thread = None


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores())


def _kind(*arguments: Any) -> Any:
    leaves, tree = jax.tree.flatten(arguments)
    return tree, tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
