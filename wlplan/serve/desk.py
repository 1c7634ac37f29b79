"""Where all computing is done: one piece of work at a time, in one thread, in the order it came."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import queue
import secrets
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from wlplan.errors import InputError
from wlplan.serve.answers import Refused
from wlplan.serve.compiled import compiled, listen

# Pieces of work that may wait, and those that are remembered once they are done.
_MOST_WAITING, _REMEMBERED = 8, 64
# So often it is looked whether to wait on [s].
_LOOK = 0.2


class Telling:
    """How far a piece of work is: what begins, and the stage, as planners tell it."""

    def __init__(self) -> None:
        self._phase, self._since, self._first = "", time.monotonic(), compiled()
        self._stage: tuple[str, int, int, float | None] | None = None

    def phase(self, text: str) -> None:
        """What begins, in words."""
        self._phase, self._since, self._stage = text, time.monotonic(), None

    def __call__(self, stage: str, done: int, total: int, cost: float | None) -> None:
        """How far a stage is, and the cost reached if there is one."""
        self._stage = (stage, done, total, cost)

    def now(self) -> dict[str, Any]:
        """What is going on: `said` in words, and `done` of `total` where that is known."""
        seconds, stage = time.monotonic() - self._since, self._stage
        words = [f"{self._phase}, {seconds:.0f} s"] if self._phase else []
        if programs := compiled() - self._first:
            words.append(f"{programs} programs compiled")
        if stage is None:
            return {"said": "; ".join(words), "done": None, "total": None}
        name, done, total, cost = stage
        words.append(f"{name.replace('_', ' ')} {done} of {total}")
        if cost is not None:
            words.append(f"cost {cost:.2f}")
        return {"said": "; ".join(words), "done": done, "total": total}


@dataclasses.dataclass(eq=False)
class Job:
    """A piece of work.

    Attributes:
        work: What is done, in the thread of the desk; it is given the job itself.
        id: Under which it is asked for.
        telling: How far it is.
        stopping: Set once it is to stop.
        future: Its result, or what went wrong.
        number: Counts the jobs.
    """

    work: Callable[[Job], Any]
    number: int
    id: str = dataclasses.field(default_factory=lambda: secrets.token_hex(8))
    telling: Telling = dataclasses.field(default_factory=Telling)
    stopping: threading.Event = dataclasses.field(default_factory=threading.Event)
    future: Future[Any] = dataclasses.field(default_factory=Future)

    def stop(self) -> None:
        """Has it stop; one that waits is not begun."""
        self.stopping.set()
        self.future.cancel()

    def run(self) -> None:
        """Does it, unless nobody wants it any more."""
        if not self.future.set_running_or_notify_cancel():
            return
        try:
            result = self.work(self)
        except KeyboardInterrupt:
            self.future.set_exception(Refused(409, "stopped before there was a result."))
        except MemoryError:
            self.future.set_exception(
                InputError("out of memory: use a smaller pile, or fewer loads.")
            )
        except BaseException as error:
            self.future.set_exception(error)
        else:
            self.future.set_result(result)


class Desk:
    """The thread that computes, and what waits for it."""

    def __init__(self) -> None:
        self._jobs: collections.OrderedDict[str, Job] = collections.OrderedDict()
        self._queue: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        listen()
        self._thread = threading.Thread(target=self._work, name="desk", daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[Job], Any]) -> Job:
        """Work that is done once all that came before is.

        Raises:
            Refused: If too much waits already.
        """
        with self._lock:
            if len(self.pending()) > _MOST_WAITING:
                raise Refused(503, f"{_MOST_WAITING} requests wait already: try again later.")
            job = Job(work, next(self._numbers))
            self._jobs[job.id] = job
            done = [one.id for one in self._jobs.values() if one.future.done()]
            for name in done[: max(len(done) - _REMEMBERED, 0)]:
                del self._jobs[name]
        self._queue.put(job)
        return job

    def pending(self) -> list[Job]:
        """What is at hand and what waits, in order."""
        return [job for job in tuple(self._jobs.values()) if not job.future.done()]

    def find(self, name: str) -> Job:
        """The job of a name.

        Raises:
            Refused: If there is none.
        """
        if name not in self._jobs:
            raise Refused(404, "there is no such job, or it is long done.")
        return self._jobs[name]

    def ahead(self, job: Job) -> int:
        """How many are done before a job."""
        return sum(1 for one in self.pending() if one.number < job.number)

    def stop_all(self) -> None:
        """Has all work stop, that at hand and that which waits."""
        for job in self.pending():
            job.stop()

    def close(self, waits: Callable[[], bool] = lambda: True) -> bool:
        """Stops all work and waits for the thread to end.

        Args:
            waits: Whether it waits on; asked now and then.

        Returns:
            Whether it has ended. A process with one that has not must end by `os._exit`: a thread
            that is inside of XLA when Python goes down takes all down with a crash.
        """
        self.stop_all()
        self._queue.put(None)
        while self._thread.is_alive() and waits():
            self._thread.join(_LOOK)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            job.run()
