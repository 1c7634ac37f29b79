"""Parameters of machines and soils: a default value with the range that it may have."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

# Width of the simulator's local map [m]: 52 columns of 0.1 m; a test compares it.
MAP_WIDTH = 5.2
# The approach starts before the local map, which begins this far behind the dig location [m]; a
# test compares it.
MAP_BEHIND = 1.0


class Range(NamedTuple):
    """Values that a parameter may have, ends included; degrees for angles, SI for all else."""

    low: float
    high: float
    unit: str

    @property
    def is_angular(self) -> bool:
        """Whether the parameter is an angle or an angular speed: in radians, written in degrees."""
        return self.unit in ("°", "°/s")


def parameter(default: float, low: float, high: float, unit: str) -> Any:
    """A field of a machine or a soil.

    We chose the ranges: wide, so that they stop typing errors and not people. Where the
    simulator itself needs a bound, the comment above the field says why.

    Args:
        default: Value of the base preset, SI units and radians.
        low: Least value, degrees for angles.
        high: Largest value, likewise.
        unit: Unit of the range.
    """
    return dataclasses.field(default=default, metadata={"range": Range(low, high, unit)})


def ranges_of(kind: type) -> dict[str, Range]:
    """The range of each parameter of a machine or soil class, by name."""
    return {field.name: field.metadata["range"] for field in dataclasses.fields(kind)}
