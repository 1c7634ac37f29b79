"""What a shift boss asks first of a plan: tonnes, trucks, minutes, tonnes an hour, fuel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

from wlplan.constants import DUMP_TIME, PERCENT_90
from wlplan.report import said

# Diesel for the work of wheels and bucket [l/MJ]. Estimates: engines of the class burn 220 g for
# each kWh, a litre has 0.84 kg, and 60 % of what the engine gives reaches wheels and bucket.
FUEL_A_MEGAJOULE = 220.0 / 840.0 / 3.6 / 0.6

_KILO = 1000.0


def headline(document: Mapping[str, Any], part: str = "simulated") -> dict[str, float]:
    """The whole job: sums over digging, driving, dumping and waiting.

    Args:
        document: Content of a plan.json.
        part: "simulated" as it was played, "predicted" as it was foreseen; driving, dumping and
            waiting are those that were played.

    Returns:
        `mass` [tonne], `loads`, `time`, `digging`, `driving`, `dumping`, `waiting` [s], `rate`
        [tonne/h], `energy` [MJ], `fuel` [l]; NaN where something is missing.
    """
    total = document.get("total") or {}
    loading, transport = total.get(part) or {}, total.get("transport") or {}
    loads = len(document.get("loads") or ())
    mass, digging = _number(loading.get("mass")), _number(loading.get("time"))
    to_and_fro, waiting = _number(transport.get("time")), _number(transport.get("wait", 0.0))
    time = digging + to_and_fro + waiting
    energy = (_number(loading.get("work")) + _number(transport.get("work"))) / _KILO
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


def foreseen(document: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """What was foreseen of the whole job, and half of the interval that holds nine in ten.

    The interval is that of the ensemble alone, all loads taken to err in the same way: of digging,
    not of driving, nor of the litres that a megajoule takes.

    Args:
        document: Content of a plan.json.

    Returns:
        `mass` [tonne], `time` [s], `rate` [tonne/h], `energy` [MJ], `fuel` [l]; halves are NaN
        where no deviation is known. Empty if nothing was foreseen.
    """
    total = document.get("total") or {}
    if not total.get("predicted"):
        return {}
    job, deviation = headline(document, "predicted"), total.get("deviation") or {}
    mass, time, work = (
        PERCENT_90 * _number(deviation.get(name)) for name in ("mass", "time", "work")
    )
    relative = math.hypot(mass / (job["mass"] or math.nan), time / (job["time"] or math.nan))
    halves = {
        "mass": mass,
        "time": time,
        "rate": relative * job["rate"],
        "energy": work / _KILO,
        "fuel": FUEL_A_MEGAJOULE * work / _KILO,
    }
    return {name: (job[name], half) for name, half in halves.items()}


def key_figures(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of the headline, each with a line or two of words, for a picture.

    Args:
        document: Content of a plan.json.
    """
    job, known = headline(document), foreseen(document)
    parts = [
        f"{name} {said.number(job[name], 0)} s"
        for name in ("digging", "driving", "dumping", "waiting")
        if name != "waiting" or job[name] > 0.0
    ]
    lines = [
        (
            "mass",
            f"{said.number(job['mass'], 1)} t",
            f"in {job['loads']} load{'s'[: job['loads'] != 1]}",
        ),
        # Two in a line.
        (
            "time",
            said.minutes(job["time"]),
            ", ".join(parts[:2]) + (",\n" if parts[3:] else ", ") + ", ".join(parts[2:]),
        ),
        ("rate", f"{said.number(job['rate'], 0)} t/h", "all of that time counted"),
        (
            "energy",
            f"{said.number(job['energy'], 1)} MJ",
            f"about {said.number(job['fuel'], 1)} l of diesel",
        ),
    ]
    found = []
    for name, value, words in lines:
        if name in known and math.isfinite(known[name][1]):
            middle, half = known[name]
            digits = {"mass": 1, "rate": 0, "energy": 1}
            shown = said.number(middle, digits[name]) if name in digits else said.minutes(middle)
            unit = {"mass": " t", "time": " s", "rate": " t/h", "energy": " MJ"}[name]
            words += f"\nforeseen {shown} ± {said.half(half)}{unit}"
        found.append((value, words))
    trucks = [truck for truck in document.get("trucks") or [] if "payload" in truck]
    if trucks:
        masses = [_number(truck.get("mass")) for truck in trucks]
        least, most = (said.number(mass, 1) for mass in (min(masses), max(masses)))
        words = f"{least} to {most} t" if least != most else f"{most} t"
        count = f"{len(trucks)} truck{'s'[: len(trucks) > 1]}"
        found.insert(1, (count, f"with {words}\nof {trucks[0]['payload']:g} t"))
    return found


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
