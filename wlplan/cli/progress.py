"""How far a long command is, and how long it took."""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.progress import TaskID

# Seconds between two lines of progress where no bar can be shown.
_PAUSE = 10.0


class Progress:
    """`progress(stage, done, total, cost)` on stderr: bars on a terminal, now and then a line."""

    def __init__(self) -> None:
        self._bars: Any = None
        self._tasks: dict[str, TaskID] = {}
        self._told: dict[str, float] = {}
        # Of each stage how much was done, and when, as it went on for the first time. What comes
        # before is compiling, or was there from an earlier run.
        self._begun: dict[str, int] = {}
        self._moving: dict[str, tuple[int, float]] = {}

    def __enter__(self) -> Progress:
        if sys.stderr.isatty():
            from rich import progress
            from rich.console import Console

            self._bars = progress.Progress(
                progress.TextColumn("{task.description:<12}"),
                progress.BarColumn(),
                progress.MofNCompleteColumn(),
                progress.TimeElapsedColumn(),
                progress.TextColumn("{task.fields[pace]}"),
                progress.TextColumn("{task.fields[cost]}"),
                console=Console(stderr=True),
                transient=True,
            )
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, stage: str, done: int, total: int, cost: float | None) -> None:
        """Show how far a stage is, and the cost reached if there is one."""
        text = "" if cost is None else f"cost {cost:.3f}"
        now = time.monotonic()
        pace = self._pace(stage, done, total, now)
        if self._bars is not None:
            fields = {"cost": text, "pace": pace}
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(stage, total=total, **fields)
            self._bars.update(self._tasks[stage], completed=done, total=total, **fields)
            return
        if stage in self._told and done < total and now - self._told[stage] < _PAUSE:
            return
        self._told[stage] = now
        line = ", ".join(filter(None, (f"{stage} {done}/{total}", text, pace)))
        print(line, file=sys.stderr, flush=True)

    def _pace(self, stage: str, done: int, total: int, now: float) -> str:
        """How many a second, and how long it will still take; nothing while that is not known."""
        if done <= self._begun.setdefault(stage, done):
            return ""
        first, since = self._moving.setdefault(stage, (done, now))
        if done <= first or now <= since:
            return ""
        rate = (done - first) / (now - since)
        left = math.ceil((total - done) / rate)
        wait = f"{left // 60} min {left % 60:02d} s" if left >= 60 else f"{left} s"
        return f"{rate:.3g} a second, {wait} left"


# Begin and end of everything that JAX has traced and compiled so far [s], of `time.perf_counter`.
_compilations: list[tuple[float, float]] = []


def _on_duration(event: str, duration_secs: float, **_: str | int) -> None:
    if event.startswith("/jax/core/compile/"):
        now = time.perf_counter()
        _compilations.append((now - duration_secs, now))


class Stopwatch:
    """Wall-clock time of a block, tracing and compiling apart from the rest.

    Attributes:
        seconds: Time of the whole block [s], once it has ended.
        compiling: Part of it that JAX traced and compiled for [s].
    """

    _listens = False

    def __enter__(self) -> Stopwatch:
        import jax

        if not Stopwatch._listens:
            jax.monitoring.register_event_duration_secs_listener(_on_duration)
            Stopwatch._listens = True
        self._first, self._begin = len(_compilations), time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.perf_counter() - self._begin
        # Stages nest: one second of compiling inside of tracing counts once.
        self.compiling, reached = 0.0, self._begin
        for begin, end in sorted(_compilations[self._first :]):
            self.compiling += max(end - max(begin, reached), 0.0)
            reached = max(reached, end)

    def text(self) -> str:
        """Both times, for people."""
        running = max(self.seconds - self.compiling, 0.0)
        return f"{self.seconds:.1f} s ({self.compiling:.1f} s compiling, {running:.1f} s running)"


def ready(result: Any) -> Any:
    """The result, once the device has computed it: for a `Stopwatch` to time all of it."""
    import jax

    return jax.block_until_ready(result)
