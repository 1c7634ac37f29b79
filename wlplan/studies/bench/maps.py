"""Diggability maps of a pile: one action everywhere, and the best of each location."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax

from wlplan.studies.bench.setup import Item, Measured, Setup
from wlplan.studies.bench.timing import timed
from wlplan.studies.diggability import diggability_map
from wlplan.studies.optimised_diggability import optimised_map
from wlplan.terrain.toes import toes_of
from wlplan.types import Pile, World
from wlplan.worlds.shipped import load_world

_LOCATIONS, _FEW = 150, 20  # on the pile, and when it has to be quick


def _measure(setup: Setup, mapped: Callable[..., Any]) -> Measured:
    world: World = load_world("hybrid")
    pile: Pile = setup.cone
    contours = [toe.contour for toe in toes_of(pile)]
    locations = _FEW if setup.quick else _LOCATIONS

    def map_once() -> Any:
        return mapped(world, pile, locations=locations, contour=contours)

    start = time.perf_counter()
    jax.block_until_ready(map_once())
    cold = time.perf_counter() - start
    before, calls = time.process_time(), 0

    def counted() -> Any:
        nonlocal calls
        calls += 1
        return map_once()

    (found,) = timed([counted], [()], seconds=0.5 if setup.quick else 4.0, least=3, warm=True)
    spent = (time.process_time() - before) / calls
    return Measured(
        max(cold - found.timing.median, 0.0), found.timing, {"processor_seconds": spent}
    )


def _measure_fixed(setup: Setup) -> Measured:
    return _measure(setup, diggability_map)


def _measure_optimised(setup: Setup) -> Measured:
    return _measure(setup, optimised_map)


MAPS = (
    Item(
        "map",
        f"a diggability map of {_LOCATIONS} locations, one action everywhere",
        _measure_fixed,
        "maps",
        "paper 150 inferences, no time given",
        "≤ 30 ms",
        most={"run": 0.030},
    ),
    Item(
        "map-optimised",
        f"the best heading and action of {_LOCATIONS} locations",
        _measure_optimised,
        "maps",
        "",
        "≤ 2 s",
        most={"run": 2.0},
    ),
)
"""Diggability maps."""
