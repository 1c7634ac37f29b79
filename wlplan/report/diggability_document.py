"""What diggability.json says: one place for its names and units."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from wlplan.report.document import receiver_fields
from wlplan.site.receiver import Receiver
from wlplan.studies.diggability import DiggabilityMap, Foreseen
from wlplan.terrain.toes import PileToe
from wlplan.types import Action, Performance

FORMAT = "wlplan.diggability/1"


@dataclasses.dataclass(frozen=True)
class Optimised:
    """What an optimised map says beside what it yields.

    Attributes:
        fixed: The same locations with one action, along the inward normal.
        offset: Of the best heading from the inward normal [rad].
        gain: By how much the fixed action costs more [%].
        objective: What is best, by name.
    """

    fixed: DiggabilityMap
    offset: Float[np.ndarray, " n"]
    gain: Float[np.ndarray, " n"]
    objective: str


def map_fields(
    found: DiggabilityMap,
    action: Action,
    *,
    foreseen: Foreseen | None = None,
    optimised: Optimised | None = None,
    receiver: Receiver | None = None,
    piles: tuple[Sequence[PileToe], Int[np.ndarray, " n"]] | None = None,
) -> dict[str, Any]:
    """The part of a diggability.json that a map makes up, in the local frame.

    Args:
        found: The map.
        action: The fixed action.
        foreseen: What the world says besides.
        optimised: Of an optimised map.
        receiver: Where loads go, if that is known.
        piles: The piles of the scan, and which of them each location is on.

    Returns:
        `action`, `summary`, `locations` and, where there is one, `objective`, `receiver`, `piles`.
    """
    columns = _columns(found)
    if foreseen is not None and foreseen.stall_probability is not None:
        columns["stall_probability"] = np.asarray(foreseen.stall_probability, float)
    if optimised is not None:
        columns |= {"offset": np.asarray(optimised.offset, float), "gain": optimised.gain}
    count = len(columns["x"])
    locations: list[dict[str, Any]] = [
        {name: float(values[n]) for name, values in columns.items()} for n in range(count)
    ]
    parts: dict[str, dict[str, np.ndarray]] = {}
    if foreseen is not None and foreseen.deviation is not None:
        parts["deviation"] = _leaves(foreseen.deviation)
    if found.transport is not None:
        parts["transport"] = {
            name: np.asarray(getattr(found.transport, name), float)
            for name in ("time", "work", "touching")
        }
    if optimised is not None:
        assert found.action is not None
        parts["action"] = _leaves(found.action)
        fixed = _columns(optimised.fixed)
        parts["fixed"] = {q: v for q, v in fixed.items() if q not in ("x", "y", "heading")}
    for part, leaves in parts.items():
        for n, one in enumerate(locations):
            one[part] = {name: float(values[n]) for name, values in leaves.items()}
    summarised = {q: v for q, v in columns.items() if q not in ("x", "y", "heading", "offset")}
    fields: dict[str, Any] = {
        "action": {name: float(values) for name, values in _leaves(action).items()},
        "summary": {q: _summary(values) for q, values in summarised.items()},
    }
    if optimised is not None:
        fields["objective"] = optimised.objective
        fields["fixed"] = {q: _summary(values) for q, values in parts["fixed"].items()}
    if receiver is not None:
        fields["receiver"] = receiver_fields(receiver)
    if piles is not None:
        toes, number = piles
        fields["piles"] = [
            {
                **{q: getattr(toe.part, q) for q in ("x", "y", "volume", "height", "area")},
                "locations": int((number == k).sum()),
            }
            for k, toe in enumerate(toes)
        ]
        for one, k in zip(locations, number.tolist(), strict=True):
            one["pile"] = k + 1
    return {**fields, "locations": locations}


def _columns(found: DiggabilityMap) -> dict[str, np.ndarray]:
    columns = {**_leaves(found.pose), **_leaves(found.performance), "rate": found.rate}
    if found.cost is not None:
        columns["cost"] = np.asarray(found.cost, float)
    return columns


def _leaves(part: Performance | Action | Any) -> dict[str, np.ndarray]:
    """Fields of a flat pytree by name."""
    return {
        field.name: np.asarray(getattr(part, field.name), float)
        for field in dataclasses.fields(part)
    }


def _summary(values: Float[np.ndarray, " n"]) -> dict[str, float]:
    return {
        "least": float(values.min()),
        "median": float(np.median(values)),
        "mean": float(values.mean()),
        "most": float(values.max()),
    }
