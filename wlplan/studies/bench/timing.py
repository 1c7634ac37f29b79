"""Compile time and run time, apart: warm up, wait for the device, median and spread."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Timing:
    """Wall-clock time of repeated runs [s]: median, 10th and 90th percentile."""

    median: float
    low: float
    high: float
    repeats: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Timing:
        """The statistics of single runs."""
        low, median, high = (float(v) for v in np.percentile(np.asarray(seconds), (10, 50, 90)))
        return cls(median, low, high, len(seconds))


class Timed(NamedTuple):
    """A function's run time, and what it returned for each case."""

    timing: Timing
    results: list[Any]


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], float]:
    """The function compiled for these arguments, and the seconds that tracing and compiling took.

    Args:
        function: Pure JAX function.
        arguments: Of the shapes and types that it will be called with.
    """
    start = time.perf_counter()
    executable = jax.jit(function).lower(*arguments).compile()
    return executable, time.perf_counter() - start


def timed(
    functions: Sequence[Callable[..., Any]],
    cases: Sequence[tuple[Any, ...]],
    *,
    seconds: float,
    least: int = 1,
    most: int = 100,
    warm: bool = False,
) -> list[Timed]:
    """Times functions side by side: all of them on every case in turn, again and again.

    So whatever else slows the machine down meets all of them alike. Each is first called once to
    warm up, which does not count, unless all are warm already.

    Args:
        functions: What to time; results that the device still computes are waited for.
        cases: Arguments of the calls.
        seconds: After this time no further pass over the cases begins [s].
        least: Passes that are made in any case.
        most: Passes at most.
        warm: Whether all of them have been called before.
    """
    for function in () if warm else functions:
        jax.block_until_ready(function(*cases[0]))
    times: list[list[float]] = [[] for _ in functions]
    results: list[list[Any]] = [[] for _ in functions]
    begin = time.perf_counter()
    passes = 0
    while passes < least or (passes < most and time.perf_counter() - begin < seconds):
        for case in cases:
            for function, spent, kept in zip(functions, times, results, strict=True):
                start = time.perf_counter()
                result = jax.block_until_ready(function(*case))
                spent.append(time.perf_counter() - start)
                if passes == 0:
                    kept.append(result)
        passes += 1
    return [Timed(Timing.of(t), r) for t, r in zip(times, results, strict=True)]
