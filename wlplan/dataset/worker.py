"""The worker: a process that simulates episodes for a collector, on one core.

`wlplan.dataset.worker_pool` starts it and exchanges lines of JSON with it over its standard input
and output. It ends when its input does: so it does not outlive its collector, however that ends.
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

from wlplan.dataset.episode import Episode
from wlplan.dataset.vector_simulator import VectorSimulator
from wlplan.engines.simulator import Simulator
from wlplan.engines.simulator.cycle import Settings
from wlplan.site.machine import WheelLoader
from wlplan.site.soil import Soil
from wlplan.terrain.automaton import Schedule


def main() -> None:
    """Does one collection after the other until the input ends; never returns."""
    # Ctrl-C goes to the whole group; what it means is up to the collector.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Whatever a library prints must not mix with the messages.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    _Worker(sys.stdin.buffer, out).run()


class _Worker:
    """The worker's end of the exchange.

    Args:
        source: Messages of the collector.
        target: Messages to it.
    """

    def __init__(self, source: IO[bytes], target: IO[bytes]):
        self.source, self.target = source, target
        self.messages: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.stopped = threading.Event()

    def run(self) -> None:
        """Simulates whatever is asked for; ends the process when the input ends."""
        threading.Thread(target=self._listen, daemon=True).start()
        while True:
            settings = self.messages.get()
            self.stopped.clear()
            try:
                self._simulate(settings)
            except Exception:
                self._send({"error": traceback.format_exc()})
            else:
                self._send({"done": True})

    def _listen(self) -> None:
        for line in self.source:
            message = json.loads(line)
            if "stop" in message:
                self.stopped.set()
            else:
                self.messages.put(message)
        os._exit(0)

    def _send(self, message: dict[str, Any], content: bytes = b"") -> None:
        try:
            self.target.write(json.dumps(message).encode() + b"\n" + content)
            self.target.flush()
        except OSError:
            os._exit(0)

    def _simulate(self, settings: dict[str, Any]) -> None:
        simulator = simulator_from_json(settings["simulator"])

        def next_episode() -> Episode | None:
            self._send({"next": True})
            number = self.messages.get()["number"]
            if number is None:
                return None
            seed, loads = settings["seed"], settings["loads"]
            rest = {name: settings[name] for name in ("length", "protocol")}
            return Episode(number, seed, loads, simulator, **rest)

        def report(episode: Episode | None) -> None:
            if episode is None:
                self._send({"loading": True})
                return
            content = io.BytesIO()
            np.savez(content, **episode.records())  # type: ignore[arg-type]
            self._send({"episode": episode.number, "bytes": content.tell()}, content.getvalue())

        VectorSimulator(simulator, next_episode, report, self.stopped).run()


def simulator_from_json(parts: dict[str, Any]) -> Simulator:
    """The simulator of `CollectionSettings.to_json`: the fields of each of its parts."""
    schedule = parts["schedule"] | {"sweeps": tuple(parts["schedule"]["sweeps"])}
    return Simulator(
        machine=WheelLoader(**parts["machine"]),
        soil=Soil(**parts["soil"]),
        settings=Settings(**parts["settings"]),
        schedule=Schedule(**schedule),
        lane_soil=parts.get("lane_soil", False),
    )
