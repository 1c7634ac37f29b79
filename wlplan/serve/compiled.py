"""How many programs this process has compiled: what a first plan from a new extent waits for."""

from __future__ import annotations

import itertools

import jax

_EVENT = "/jax/core/compile/backend_compile_duration"
_numbers = itertools.count(1)
_counts: list[int] = []


def listen() -> None:
    """Counts from now on."""
    if not _counts:
        _counts.append(0)
        jax.monitoring.register_event_duration_secs_listener(_on_duration)


def compiled() -> int:
    """Programs that were compiled, or loaded, since it counts."""
    return _counts[0] if _counts else 0


def _on_duration(event: str, duration_secs: float, **labels: str | int) -> None:
    del duration_secs, labels
    if event == _EVENT:
        _counts[0] = next(_numbers)
