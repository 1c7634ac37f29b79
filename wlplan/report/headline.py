"""What a shift boss asks first of a plan: tonnes, trucks, minutes, tonnes an hour, fuel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

from wlplan.constants import DUMP_TIME

# Diesel for the work of wheels and bucket [l/MJ]. Estimates: engines of the class burn 220 g for
# each kWh, a litre has 0.84 kg, and 60 % of what the engine gives reaches wheels and bucket.
FUEL_A_MEGAJOULE = 220.0 / 840.0 / 3.6 / 0.6

_KILO = 1000.0


def headline(document: Mapping[str, Any]) -> dict[str, float]:
    """The whole job as it was played: sums over digging, driving, dumping and waiting.

    Args:
        document: Content of a plan.json.

    Returns:
        `mass` [tonne], `loads`, `time`, `digging`, `driving`, `dumping`, `waiting` [s], `rate`
        [tonne/h], `energy` [MJ], `fuel` [l]; NaN where something is missing.
    """
    total = document.get("total") or {}
    played, transport = total.get("simulated") or {}, total.get("transport") or {}
    loads = len(document.get("loads") or ())
    mass, digging = _number(played.get("mass")), _number(played.get("time"))
    to_and_fro, waiting = _number(transport.get("time")), _number(transport.get("wait", 0.0))
    time = digging + to_and_fro + waiting
    energy = (_number(played.get("work")) + _number(transport.get("work"))) / _KILO
    dumping = DUMP_TIME * loads
    return {
        "mass": mass,
        "loads": loads,
        "time": time,
        "digging": digging,
        "driving": to_and_fro - dumping,
        "dumping": dumping,
        "waiting": waiting,
        "rate": 3600.0 * mass / time if time else math.nan,
        "energy": energy,
        "fuel": FUEL_A_MEGAJOULE * energy,
    }


def trucks_said(document: Mapping[str, Any]) -> list[str]:
    """A line for each truck: what is in it, of how much, in how many loads, and the last of them.

    Args:
        document: Content of a plan.json.
    """
    loads, lines = document.get("loads") or [], []
    for number, truck in enumerate(document.get("trucks") or [], start=1):
        mass, of = _number(truck.get("mass")), ""
        if payload := truck.get("payload"):
            of = f" of {payload:g} t ({100.0 * mass / payload:.0f} %)"
        count, last = len(truck["loads"]), math.nan
        if truck["loads"]:
            last = _number((loads[truck["loads"][-1]].get("simulated") or {}).get("mass"))
        lines.append(
            f"truck {number}: {mass:.1f} t{of} in {count} load{'s'[: count > 1]}, "
            f"the last {last:.1f} t"
        )
    return lines


def _number(value: object) -> float:
    return float(value) if isinstance(value, Real) else math.nan
