"""A process that plays rollouts for a collector, on one core: `python -m wlplan.dataset.worker`.

It talks in lines of JSON over its standard input and output, see `wlplan.dataset.crew`, and ends
when its input does: so it does not outlive its collector, however that ends.
"""

from __future__ import annotations

import io
import json
import os
import queue
import signal
import sys
import threading
import traceback
from typing import IO, Any

import numpy as np

from wlplan.dataset.protocol import Rollout
from wlplan.dataset.workbench import Bench
from wlplan.engines.simulator import Simulator
from wlplan.engines.simulator.cycle import Settings
from wlplan.site.machine import WheelLoader
from wlplan.site.soil import Soil
from wlplan.terrain.automaton import Schedule


def main() -> None:
    """Plays one session after the other until the input ends."""
    # Ctrl-C goes to the whole group; what it means is up to the collector.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Whatever a library prints must not mix with the messages.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    _Worker(sys.stdin.buffer, out).run()


class _Worker:
    """The sessions of a worker.

    Args:
        source: Messages of the collector.
        target: Messages to it.
    """

    def __init__(self, source: IO[bytes], target: IO[bytes]):
        self.source, self.target = source, target
        self.messages: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.stopped = threading.Event()

    def run(self) -> None:
        """Plays; ends the process when the input ends."""
        threading.Thread(target=self._listen, daemon=True).start()
        while True:
            session = self.messages.get()
            self.stopped.clear()
            try:
                self._play(session)
            except Exception:
                self._tell({"error": traceback.format_exc()})
            else:
                self._tell({"done": True})

    def _listen(self) -> None:
        for line in self.source:
            message = json.loads(line)
            if "stop" in message:
                self.stopped.set()
            else:
                self.messages.put(message)
        os._exit(0)

    def _tell(self, message: dict[str, Any], content: bytes = b"") -> None:
        try:
            self.target.write(json.dumps(message).encode() + b"\n" + content)
            self.target.flush()
        except OSError:
            os._exit(0)

    def _play(self, session: dict[str, Any]) -> None:
        simulator = simulator_from(session["simulator"])

        def take() -> Rollout | None:
            self._tell({"ask": True})
            number = self.messages.get()["number"]
            if number is None:
                return None
            seed, loads = session["seed"], session["loads"]
            rest = {name: session[name] for name in ("length", "protocol")}
            return Rollout(number, seed, loads, simulator, **rest)

        def put(rollout: Rollout | None) -> None:
            if rollout is None:
                self._tell({"played": True})
                return
            content = io.BytesIO()
            np.savez(content, **rollout.records())  # type: ignore[arg-type]
            self._tell({"rollout": rollout.number, "bytes": content.tell()}, content.getvalue())

        Bench(simulator, take, put, self.stopped).run()


def simulator_from(parts: dict[str, Any]) -> Simulator:
    """The simulator whose parts are named, each with its fields, as JSON holds them."""
    schedule = parts["schedule"] | {"sweeps": tuple(parts["schedule"]["sweeps"])}
    return Simulator(
        machine=WheelLoader(**parts["machine"]),
        soil=Soil(**parts["soil"]),
        settings=Settings(**parts["settings"]),
        schedule=Schedule(**schedule),
    )


if __name__ == "__main__":
    main()
