"""Processes that play rollouts for a collector, one for each core.

Threads of one process would wait for each other: Python runs in one of them at a time. And XLA
takes 1.4 times as long for a time step when it shares it out among cores, see docs/simulator.md.
So each process has one core, and what it computes does not depend on how many there are.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import wlplan
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError

# What makes XLA use one core in a process, and the processor whatever else there is.
_ENVIRONMENT = {"NPROC": "1", "JAX_PLATFORMS": "cpu"}


class Played(NamedTuple):
    """A rollout that a worker has played."""

    number: int
    records: dict[str, np.ndarray]  # the variables of all its loadings


@dataclasses.dataclass(frozen=True)
class Session:
    """What a worker has to know of a collection.

    Attributes:
        simulator: The simulator.
        seed: Seed of piles, poses and actions.
        loads: Loadings to play of each rollout.
        length: Loadings of a whole rollout.
        protocol: Where is dug, see `wlplan.dataset.protocol`.
    """

    simulator: Simulator
    seed: int
    loads: int
    length: int
    protocol: str = "paper"

    def message(self) -> dict[str, Any]:
        """As JSON holds it."""
        parts = ("machine", "soil", "settings", "schedule")
        simulator = {name: dataclasses.asdict(getattr(self.simulator, name)) for name in parts}
        rest = {name: getattr(self, name) for name in ("seed", "loads", "length", "protocol")}
        return {"simulator": simulator, **rest}


class Worker:
    """One process that plays rollouts.

    Raises:
        InputError: If it cannot be started.
    """

    def __init__(self) -> None:
        package = str(Path(wlplan.__file__).parents[1])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "wlplan.dataset.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(paths)},
            )
        except OSError as error:
            raise InputError(
                f"No process can be started to play cycles ({error.strerror}): free some memory."
            ) from error
        self._telling = threading.Lock()

    def play(
        self,
        session: Session,
        take: Callable[[], int | None],
        put: Callable[[Played | None], None],
    ) -> None:
        """Has rollouts played until there are no more.

        Args:
            session: What the rollouts share.
            take: Gives the number of the next; None when there are no more.
            put: Takes None for each loading played, and each rollout when it is finished.

        Raises:
            InputError: If the process ends in the middle.
            RuntimeError: If something fails in it; the message is its traceback.
        """
        assert self.process.stdout is not None
        self._tell(session.message())
        while line := self.process.stdout.readline():
            message = json.loads(line)
            if "ask" in message:
                self._tell({"number": take()})
            elif "played" in message:
                put(None)
            elif "rollout" in message:
                content = self.process.stdout.read(message["bytes"])
                with np.load(io.BytesIO(content), allow_pickle=False) as columns:
                    put(Played(message["rollout"], dict(columns)))
            elif "error" in message:
                raise RuntimeError(message["error"])
            else:
                return
        raise InputError(
            f"A process that plays cycles has ended (exit code {self.process.wait()}), perhaps for "
            f"want of memory: the same command goes on with what is stored."
        )

    def stop(self) -> None:
        """Has the session end early; for other threads than the one that plays it."""
        with contextlib.suppress(OSError):
            self._tell({"stop": True})

    def end(self) -> None:
        """Ends the process."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()

    def _tell(self, message: dict[str, Any]) -> None:
        assert self.process.stdin is not None
        with self._telling, contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(json.dumps(message).encode() + b"\n")
            self.process.stdin.flush()


@contextlib.contextmanager
def hired(count: int) -> Iterator[list[Worker]]:
    """So many workers, which end with the block."""
    workers: list[Worker] = []
    try:
        for _ in range(count):
            workers.append(Worker())
        yield workers
    finally:
        for worker in workers:
            worker.end()
