"""The worlds that come with the package, by name; free of JAX, so that help comes at once.

A new world is an entry here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Learned(NamedTuple):
    """A learned world, by the names under which its models ship."""

    performance: str
    pile_state: str | None = None  # None: the strip in front of the bucket
    stall: str = "stall"  # what foresees stalls


class Engine(NamedTuple):
    """A world that plays loadings without having learnt."""

    maker: str  # "module:name" of what makes it of `machine` and `soil`
    title: str  # as pages and tables say it
    is_planned_in: bool = False  # whether commands plan in it, beside playing plans there


WORLDS: dict[str, Learned | Engine] = {
    "low": Learned("psi_low"),
    "hybrid": Learned("psi_high"),
    "high": Learned("psi_high", "phi"),
    "simulator": Engine("wlplan.engines.simulator:Simulator", "the simulator", True),
    "simulator-lane": Engine(
        "wlplan.engines.simulator:with_lane_soil", "the simulator with soil in the approach lane"
    ),
    "dem": Engine("wlplan.engines.dem.world:DiscreteElements", "discrete elements"),
}
"""Worlds by name."""

ENGINES = {name: world for name, world in WORLDS.items() if isinstance(world, Engine)}
"""Those that play plans without having learnt."""

USUAL_ENGINE = "simulator"
"""What plays a plan that says nothing of an engine."""

FOR_PLANNING = tuple(
    name for name, world in WORLDS.items() if isinstance(world, Learned) or world.is_planned_in
)
"""Names of the worlds that commands plan in."""


def engine_of(document: Mapping[str, Any]) -> Engine:
    """What played a plan, by its `plan.json`; that names no engine where it was the usual one."""
    return ENGINES.get(document.get("engine", USUAL_ENGINE), ENGINES[USUAL_ENGINE])
