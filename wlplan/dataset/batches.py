"""Batches of a data set: rollouts shared out to workers and put together in order."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable, Generator, Iterator
from typing import Any

import numpy as np

from wlplan.dataset.crew import Played, Session, Worker, hired
from wlplan.dataset.protocol import Layout
from wlplan.dataset.variables import LOADS, VARIABLES
from wlplan.xla import cores


def batches_of(
    layout: Layout,
    start: int,
    session: Session,
    progress: Callable[[int, int], None] | None,
) -> Generator[dict[str, np.ndarray]]:
    """The variables of one batch of cycles after the other, from cycle `start` of the whole on."""
    numbers = range(start // LOADS, math.ceil(layout.stop / LOADS))
    waiting, finished = iter(numbers), queue.SimpleQueue[Any]()
    lock, stopped = threading.Lock(), threading.Event()

    def take() -> int | None:
        with lock:
            return None if stopped.is_set() else next(waiting, None)

    def play(worker: Worker) -> None:
        try:
            worker.play(session, take, finished.put)
        except BaseException as error:
            finished.put(error)

    with hired(min(cores(), len(numbers))) as workers:
        threads = [
            threading.Thread(target=play, args=(worker,), name="collect", daemon=True)
            for worker in workers
        ]
        for thread in threads:
            thread.start()
        try:
            yield from _in_order(layout, start, finished, progress)
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
    finished: queue.SimpleQueue[Any],
    progress: Callable[[int, int], None] | None,
) -> Iterator[dict[str, np.ndarray]]:
    """Puts rollouts together to batches as they are finished, in whatever order they are.

    Args:
        layout: Portions of the collection.
        start: First cycle, counted in the whole.
        finished: Loadings that are played as None, rollouts that are finished, and errors.
        progress: As for `collect`.
    """
    rollouts: dict[int, Played] = {}
    played = start
    while start < layout.stop:
        stop = min(start + layout.batch_cycles, layout.stop)
        numbers = range(start // LOADS, math.ceil(stop / LOADS))
        while not all(number in rollouts for number in numbers):
            news = finished.get()
            if isinstance(news, BaseException):
                raise news
            if news is None:
                played += 1
                if progress is not None:
                    # Those of the last rollout that are cut off do not count.
                    progress(min(played, layout.stop) - layout.first, layout.size)
            else:
                rollouts[news.number] = news
        parts = [rollouts.pop(number).records for number in numbers]
        yield {n: np.concatenate([p[n] for p in parts])[: stop - start] for n in VARIABLES}
        start = stop
