"""Collection in parallel: a pool of worker processes, one for each core, and its batches in order.

Threads of one process would wait for each other: Python runs in one of them at a time. And XLA
takes 1.4 times as long for a time step when it shares it out among cores, see docs/simulator.md.
So each process has one core, and what it computes does not depend on how many there are.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import wlplan
from wlplan.dataset.layout import Layout
from wlplan.dataset.variables import LOADS, VARIABLES
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError
from wlplan.xla import cores

# What makes XLA use one core in a process, and the processor whatever else there is.
_ENVIRONMENT = {"NPROC": "1", "JAX_PLATFORMS": "cpu"}


@dataclasses.dataclass(frozen=True)
class CollectionSettings:
    """What all episodes of a collection share.

    Attributes:
        simulator: The simulator.
        seed: Seed of piles, poses and actions.
        loads: Loadings to simulate of each episode.
        length: Loadings of a whole episode.
        protocol: One of `wlplan.dataset.protocols.PROTOCOLS`.
    """

    simulator: Simulator
    seed: int
    loads: int
    length: int
    protocol: str = "paper"

    def to_json(self) -> dict[str, Any]:
        """As JSON holds it; `wlplan.dataset.worker.simulator_from_json` reads the simulator."""
        parts = ("machine", "soil", "settings", "schedule")
        simulator: dict[str, Any]
        simulator = {name: dataclasses.asdict(getattr(self.simulator, name)) for name in parts}
        # Data sets from before there was a choice say nothing of it.
        if self.simulator.lane_soil:
            simulator["lane_soil"] = True
        rest = {name: getattr(self, name) for name in ("seed", "loads", "length", "protocol")}
        return {"simulator": simulator, **rest}


class FinishedEpisode(NamedTuple):
    """An episode that a worker has simulated."""

    number: int
    records: dict[str, np.ndarray]  # the variables of all its loadings, see `VARIABLES`


class WorkerProcess:
    """A process that simulates episodes: the collector's end of `wlplan.dataset.worker`.

    Raises:
        InputError: If it cannot be started.
    """

    def __init__(self) -> None:
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", _start_code()],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, **_ENVIRONMENT},
            )
        except OSError as error:
            raise InputError(
                f"No process can be started to simulate cycles ({error.strerror}): free some "
                f"memory."
            ) from error
        self._sending = threading.Lock()

    def simulate(
        self,
        settings: CollectionSettings,
        next_number: Callable[[], int | None],
        report: Callable[[FinishedEpisode | None], None],
    ) -> None:
        """Simulates episodes until there are no more, or `stop` is called.

        Args:
            settings: What the episodes share.
            next_number: Returns the number of another episode; None when there are no more.
            report: Called with None after each loading, and with each episode when it is finished.

        Raises:
            InputError: If the process ends before that.
            RuntimeError: If something fails in it; the message is its traceback.
        """
        assert self.process.stdout is not None
        self._send(settings.to_json())
        while line := self.process.stdout.readline():
            message = json.loads(line)
            if "next" in message:
                self._send({"number": next_number()})
            elif "loading" in message:
                report(None)
            elif "episode" in message:
                content = self.process.stdout.read(message["bytes"])
                with np.load(io.BytesIO(content), allow_pickle=False) as records:
                    report(FinishedEpisode(message["episode"], dict(records)))
            elif "error" in message:
                raise RuntimeError(message["error"])
            else:
                return
        raise InputError(
            f"A process that simulates cycles has ended (exit code {self.process.wait()}), perhaps "
            f"for lack of memory: the same command continues with what is stored."
        )

    def stop(self) -> None:
        """Makes `simulate` return early; to be called from another thread."""
        with contextlib.suppress(OSError):
            self._send({"stop": True})

    def close(self) -> None:
        """Ends the process and waits for it."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()

    def _send(self, message: dict[str, Any]) -> None:
        assert self.process.stdin is not None
        with self._sending, contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(json.dumps(message).encode() + b"\n")
            self.process.stdin.flush()


@contextlib.contextmanager
def worker_pool(count: int) -> Iterator[list[WorkerProcess]]:
    """Worker processes that are closed when the block ends."""
    workers: list[WorkerProcess] = []
    try:
        for _ in range(count):
            workers.append(WorkerProcess())
        yield workers
    finally:
        for worker in workers:
            worker.close()


def collect_batches(
    layout: Layout,
    start: int,
    settings: CollectionSettings,
    progress: Callable[[int, int], None] | None,
) -> Generator[dict[str, np.ndarray]]:
    """Simulates a shard from some cycle on, with a pool of workers.

    Args:
        layout: The shard.
        start: First cycle to simulate, counted in the whole; a batch begins with it.
        settings: What the episodes share.
        progress: As for `wlplan.dataset.collect`.

    Yields:
        The variables of one batch of cycles after the other, see `VARIABLES`.

    Raises:
        InputError: If a worker cannot be started, or ends.
    """
    numbers = range(start // LOADS, math.ceil(layout.stop / LOADS))
    waiting, news = iter(numbers), queue.SimpleQueue[Any]()
    lock, stopped = threading.Lock(), threading.Event()

    def next_number() -> int | None:
        with lock:
            return None if stopped.is_set() else next(waiting, None)

    def simulate(worker: WorkerProcess) -> None:
        try:
            worker.simulate(settings, next_number, news.put)
        except BaseException as error:
            news.put(error)

    with worker_pool(min(cores(), len(numbers))) as workers:
        threads = [
            threading.Thread(target=simulate, args=(worker,), name="collect", daemon=True)
            for worker in workers
        ]
        for thread in threads:
            thread.start()
        try:
            yield from _in_order(layout, start, news, progress)
        finally:
            stopped.set()
            for worker, thread in zip(workers, threads, strict=True):
                if thread.is_alive():
                    worker.stop()
            for thread in threads:
                thread.join()


def _in_order(
    layout: Layout,
    start: int,
    news: queue.SimpleQueue[Any],
    progress: Callable[[int, int], None] | None,
) -> Iterator[dict[str, np.ndarray]]:
    """Joins episodes to batches as they are finished, in whatever order they are.

    Args:
        layout: The shard.
        start: First cycle, counted in the whole.
        news: None for each loading, the episodes that are finished, and errors.
        progress: As for `wlplan.dataset.collect`.
    """
    episodes: dict[int, FinishedEpisode] = {}
    done = start
    while start < layout.stop:
        stop = min(start + layout.batch_cycles, layout.stop)
        numbers = range(start // LOADS, math.ceil(stop / LOADS))
        while not all(number in episodes for number in numbers):
            item = news.get()
            if isinstance(item, BaseException):
                raise item
            if item is None:
                done += 1
                if progress is not None:
                    # Those of the last episode that are cut off do not count.
                    progress(min(done, layout.stop) - layout.first, layout.size)
            else:
                episodes[item.number] = item
        parts = [episodes.pop(number).records for number in numbers]
        yield {n: np.concatenate([p[n] for p in parts])[: stop - start] for n in VARIABLES}
        start = stop


def _start_code() -> str:
    """What starts a worker: it imports from where this process does, and nowhere else.

    That is the same folders, apart from relative ones, which would mean the working directory; and
    the same package, wherever this process found it.
    """
    package = Path(wlplan.__file__).parent
    paths = [entry for entry in sys.path if os.path.isabs(entry)]
    return f"""
import sys
sys.path[:] = {paths!a}
from importlib.util import module_from_spec, spec_from_file_location
spec = spec_from_file_location(
    "wlplan", {str(package / "__init__.py")!a}, submodule_search_locations=[{str(package)!a}]
)
module = sys.modules["wlplan"] = module_from_spec(spec)
spec.loader.exec_module(module)
from wlplan.dataset.worker import main
main()
"""
