"""The worlds that come with the package, by name; free of JAX, so that help comes at once.

A new world is an entry here.
"""

from __future__ import annotations

from typing import NamedTuple


class Learned(NamedTuple):
    """A learned world, by the names under which its models ship."""

    performance: str
    pile_state: str | None = None  # None: the strip in front of the bucket
    stall: str = "stall"  # what foresees stalls


WORLDS: dict[str, Learned | str] = {
    "low": Learned("psi_low"),
    "hybrid": Learned("psi_high"),
    "high": Learned("psi_high", "phi"),
    # Engines: classes that are made with `machine` and `soil`.
    "simulator": "wlplan.engines.simulator:Simulator",
    "dem": "wlplan.engines.dem.world:DiscreteElements",
}
"""Worlds by name."""

ENGINES = tuple(name for name, world in WORLDS.items() if isinstance(world, str))
"""Names of the worlds that play plans without having learnt."""

# The discrete elements take minutes a loading.
FOR_PLANNING = tuple(name for name in WORLDS if name != "dem")
"""Names of the worlds that are quick enough to plan in."""
