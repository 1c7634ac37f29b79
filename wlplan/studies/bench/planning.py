"""The simulator and the planner."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from wlplan.dataset import collect
from wlplan.planning.plan import plan_loads
from wlplan.planning.replanning import Replanner
from wlplan.studies.bench.setup import Item, Measured, Setup
from wlplan.studies.bench.timing import Timing, timed
from wlplan.types import Pile
from wlplan.worlds.shipped import load_world

_CYCLES, _FEW_CYCLES = 3_600, 180  # that are collected, and when it has to be quick
_PLANNED = 15  # loads of a plan


def _measure_cycles(setup: Setup) -> Measured:
    cycles = _FEW_CYCLES if setup.quick else _CYCLES
    first: list[float] = []

    def progress(done: int, _: int) -> None:
        if done and not first:
            first.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        collect(Path(folder) / "data.zarr", cycles=cycles, seed=setup.seed, progress=progress)
        end = time.perf_counter()
    # Each of the processes that play compiles for itself, until the first cycle has ended.
    running = end - first[0]
    return Measured(first[0] - start, Timing.of([running]), {"cycles_per_second": cycles / running})


def _cold_and_warm(
    plan: Callable[..., Any],
    seconds: float,
    cases: Sequence[tuple[Any, ...]] = ((),),
    least: int = 1,
) -> Measured:
    """A planner compiles on its way: what the first call takes longer counts as that."""
    start = time.perf_counter()
    jax.block_until_ready(plan(*cases[0]))
    cold = time.perf_counter() - start
    (found,) = timed([plan], cases, seconds=seconds, least=least, warm=True)
    return Measured(max(cold - found.timing.median, 0.0), found.timing)


def _measure_plan(setup: Setup) -> Measured:
    simulator = load_world("simulator")

    def plan() -> Any:
        return plan_loads(
            setup.world, setup.cone, loads=_PLANNED, seed=setup.seed, referee=simulator
        ).cost

    return _cold_and_warm(plan, 0.0)


def _measure_first_load(setup: Setup) -> Measured:
    def first(pile: Pile) -> Any:
        return plan_loads(setup.world, pile, loads=1, planner="greedy", seed=setup.seed).cost

    measured = _cold_and_warm(lambda: first(setup.cone), 5.0)
    # The toe of another pile has another length, which must not matter.
    start = time.perf_counter()
    jax.block_until_ready(first(setup.piles[0]))
    return dataclasses.replace(
        measured, figures={"seconds_on_another_pile": time.perf_counter() - start}
    )


def _measure_next_load(setup: Setup) -> Measured:
    """Scans of piles of all extents, one after the other, as `Replanner` gets them."""
    replanner = Replanner(load_world("hybrid"), seed=setup.seed)

    def following(pile: Pile) -> Any:
        return replanner.next_load(pile).cost

    measured = _cold_and_warm(following, 5.0, [(pile,) for pile in setup.piles], least=3)
    assert measured.run is not None
    return dataclasses.replace(measured, figures={"nine_of_ten": measured.run.high})


PLANNING = (
    Item(
        "cycles",
        f"{_CYCLES:,} simulated cycles, collected and stored",
        _measure_cycles,
        "simulator",
        "paper 0.1 a second, prototype 185",
        "≥ 300 a second",
        least={"cycles_per_second": 300.0},
    ),
    Item(
        "plan",
        f"a plan of {_PLANNED} loads, as `wlplan plan` makes it",
        _measure_plan,
        "planner",
        "follow-up 792 s",
        "≤ 60 s",
        most={"run": 60.0},
        long=True,
    ),
    Item(
        "first-load",
        "the next load, by a warm greedy planner",
        _measure_first_load,
        "planner",
        "follow-up 43 s",
        "≤ 1 s, on any pile",
        most={"run": 1.0, "seconds_on_another_pile": 1.0},
        long=True,
    ),
    Item(
        "next-load",
        "the load after a scan, by a warm `Replanner`, map of 40 m, hybrid world",
        _measure_next_load,
        "planner",
        "follow-up 43 s",
        "≤ 0.5 s, nine of ten too",
        most={"run": 0.5, "nine_of_ten": 0.5},
        long=True,
    ),
)
"""Simulated cycles, and plans."""
