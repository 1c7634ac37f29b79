"""What is going on, how far it is, and how long it took."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from wlplan.cli.said import tell
from wlplan.cli.verbosity import is_asked

if TYPE_CHECKING:
    from rich.progress import TaskID

# Seconds between two lines of progress where no bar can be shown.
_PAUSE = 10.0
# Programs that are compiled faster than this are not worth a line [s].
_QUICK = 0.1


class Progress:
    """What is going on, on stderr: `progress(stage, done, total, cost)` and `progress.phase(text)`.

    On a terminal a line that moves says it all the time, above bars; elsewhere a line is printed
    now and then.

    Args:
        seconds: What compiling took the last time [s]; None if that is not known.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self._before = seconds
        self._live: Any = None
        self._bars: Any = None
        self._tasks: dict[str, TaskID] = {}
        self._told: dict[str, float] = {}
        # Of each stage how much was done, and when, as it went on for the first time. What comes
        # before is compiling, or was there from an earlier run.
        self._begun: dict[str, int] = {}
        self._moving: dict[str, tuple[int, float]] = {}
        self._phase, self._since = "", 0.0
        self._quiet = self._verbose = False
        self._done = threading.Event()

    def __enter__(self) -> Progress:
        self._quiet, self._verbose = is_asked("quiet"), is_asked("verbose")
        self._first = len(_compilations)
        if self._quiet:
            return self
        if not sys.stderr.isatty():
            threading.Thread(target=self._tell_now_and_then, daemon=True).start()
            return self
        from rich import progress
        from rich.console import Console, Group
        from rich.live import Live

        console = Console(stderr=True)
        self._bars = progress.Progress(
            progress.TextColumn("{task.description:<12}"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[pace]}"),
            progress.TextColumn("{task.fields[cost]}"),
            console=console,
        )
        self._live = Live(
            Group(_Now(self), self._bars), console=console, transient=True, refresh_per_second=8
        )
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        if self._live is not None:
            self._live.stop()

    def phase(self, text: str) -> None:
        """Say what begins."""
        now = time.monotonic()
        if self._verbose and self._phase:
            tell(f"{self._phase}: {now - self._since:.1f} s")
        self._phase, self._since = text, now

    def now(self) -> str:
        """What is going on, for how long, and what was compiled for it."""
        words = [f"{self._phase}, {time.monotonic() - self._since:.0f} s"] if self._phase else []
        spans = _compilations[self._first :]
        if seconds := _union(spans, 0.0):
            before = "" if self._before is None else f" ({self._before:.0f} s the last time)"
            words.append(f"compiled for {seconds:.0f} s{before}")
        return "; ".join(words)

    def __call__(self, stage: str, done: int, total: int, cost: float | None) -> None:
        """Show how far a stage is, and the cost reached if there is one."""
        if self._quiet:
            return
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
        tell(line)

    def _tell_now_and_then(self) -> None:
        """A line whenever nothing was told for a while."""
        while not self._done.wait(_PAUSE):
            # A copy: the other thread adds stages meanwhile.
            quiet = all(time.monotonic() - told > _PAUSE for told in tuple(self._told.values()))
            if quiet and self._phase and not self._done.is_set():
                tell(self.now())

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


class _Now:
    """A line that says what is going on at the moment it is drawn."""

    def __init__(self, progress: Progress) -> None:
        from rich.spinner import Spinner

        self._progress, self._spinner = progress, Spinner("dots")

    def __rich__(self) -> Any:
        self._spinner.update(text=self._progress.now())
        return self._spinner


# Begin and end of everything that JAX has traced and compiled so far [s], of `time.perf_counter`.
_compilations: list[tuple[float, float]] = []
_listens: list[bool] = []
_COMPILED = "/jax/core/compile/backend_compile_duration"


def _on_duration(event: str, duration_secs: float, **labels: str | int) -> None:
    if event.startswith("/jax/core/compile/"):
        now = time.perf_counter()
        _compilations.append((now - duration_secs, now))
        if event == _COMPILED and duration_secs > _QUICK and is_asked("verbose"):
            name = labels.get("fun_name", "a program")
            tell(f"compiled {name}: {duration_secs:.1f} s")


def listen() -> None:
    """Has JAX tell of what it compiles, from now on."""
    import jax

    if not _listens:
        _listens.append(True)
        jax.monitoring.register_event_duration_secs_listener(_on_duration)


def _union(spans: Sequence[tuple[float, float]], begin: float) -> float:
    """How long at least one of them lasted, from a moment on: they nest [s]."""
    seconds, reached = 0.0, begin
    for first, last in sorted(spans):
        seconds += max(last - max(first, reached), 0.0)
        reached = max(reached, last)
    return seconds


class Stopwatch:
    """Wall-clock time of a block, tracing and compiling apart from the rest.

    Attributes:
        seconds: Time of the whole block [s], once it has ended.
        compiling: Part of it that JAX traced and compiled for [s].
    """

    def __enter__(self) -> Stopwatch:
        listen()
        self._first, self._begin = len(_compilations), time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.perf_counter() - self._begin
        # One second of compiling inside of tracing counts once.
        self.compiling = _union(_compilations[self._first :], self._begin)

    def text(self) -> str:
        """Both times, for people."""
        running = max(self.seconds - self.compiling, 0.0)
        return f"{self.seconds:.1f} s ({self.compiling:.1f} s compiling, {running:.1f} s running)"


def ready(result: Any) -> Any:
    """The result, once the device has computed it: for a `Stopwatch` to time all of it."""
    import jax

    return jax.block_until_ready(result)
