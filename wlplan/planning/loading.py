"""One loading as objectives see it."""

from __future__ import annotations

from typing import Any, no_type_check

from flax import struct
from jaxtyping import Array, Float

from wlplan.site.site import Site
from wlplan.types import Action, Performance, Pile, Pose

LEAST_MASS = 0.1
"""Load below which M0 / M is held finite [tonne]: a bucket that comes back empty costs as much as
about forty good ones."""


@no_type_check
class Transport(struct.PyTreeNode):
    """From the end of a loading to the receiver and back to the start of the next approach."""

    time: Float[Array, "*n"]  # dumping included [s]
    work: Float[Array, "*n"]  # [kJ]
    # How much of the way and of the approach lane leads through what must not be touched [m].
    touching: Float[Array, "*n"] = 0.0  # type: ignore[assignment]
    # How long the loader then stands still until the next truck is there [s].
    wait: Float[Array, "*n"] = 0.0  # type: ignore[assignment]


@no_type_check
class Loading(struct.PyTreeNode):
    """One loading with all that a term of an objective may look at; scalar leaves."""

    pile: Pile  # before
    pose: Pose
    action: Action
    performance: Performance
    transport: Transport
    site: Site
    # The world that foresees or played it; what it can do: `wlplan.worlds.capabilities`.
    world: Any = None
