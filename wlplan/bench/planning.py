"""The simulator and the planner."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from wlplan.bench.digs import random_pose
from wlplan.bench.setup import Item, Measured, Setup, random_actions, stacked
from wlplan.bench.timing import compiled, timed
from wlplan.planner import plan_loads
from wlplan.types import Pile, action_from
from wlplan.worlds import load_world

_CYCLES, _GROUPS = 64, 4  # simulated at once, and in how many calls that are under way together
_PLANNED = 15  # loads of a plan


def _measure_cycles(setup: Setup) -> Measured:
    rng = np.random.default_rng(setup.seed)
    actions = random_actions(_CYCLES, rng)
    cycles = []
    for k in range(_CYCLES):
        pile = setup.piles[k % len(setup.piles)]
        cycles.append((pile, random_pose(pile, rng), action_from(actions[k])))
    groups = [stacked(cycles[k::_GROUPS]) for k in range(_GROUPS)]
    run, seconds = compiled(jax.vmap(load_world("simulator")), *groups[0])
    (found,) = setup.timed([lambda: [run(*group) for group in groups]], [()])
    return Measured(seconds, found.timing, {"cycles_per_second": _CYCLES / found.timing.median})


def _cold_and_warm(plan: Callable[[], Any], seconds: float) -> Measured:
    """A planner compiles on its way: what the first call takes longer counts as that."""
    start = time.perf_counter()
    jax.block_until_ready(plan())
    cold = time.perf_counter() - start
    (found,) = timed([plan], [()], seconds=seconds, warm=True)
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
    # The toe of another pile has another length, for which the planner is compiled anew.
    start = time.perf_counter()
    jax.block_until_ready(first(setup.piles[0]))
    return dataclasses.replace(
        measured, figures={"seconds_on_another_pile": time.perf_counter() - start}
    )


PLANNING = (
    Item(
        "cycles",
        f"{_CYCLES} simulated cycles, {_GROUPS} calls under way",
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
        "the first load, again, by a warm greedy planner",
        _measure_first_load,
        "planner",
        "follow-up 43 s",
        "≤ 1 s",
        most={"run": 1.0},
        long=True,
    ),
)
"""Simulated cycles, and plans."""
