"""Planners beside greedy: rows of runs in, tables out."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

from scipy.stats import t as student

_CONFIDENCE = 0.95
# Those that do not look at more than the next load, or at nothing.
_NOT_AHEAD = ("greedy", "greedy, in the simulator", "nominal", "max load", "random search")

Key = tuple[str, str, str, int]


def _key(row: dict[str, Any]) -> Key:
    return row["pile"], row["job"], row["site"], row["seed"]


def gains(
    rows: Sequence[dict[str, Any]], planner: str, budget: int
) -> list[tuple[Key, dict[str, float]]]:
    """What a planner is better than greedy by, on the same instance and seed [%].

    Args:
        rows: All of them.
        planner: Its name.
        budget: Its budget; greedy has its own, 1.
    """
    base = {_key(row): row for row in rows if (row["planner"], row["budget"]) == ("greedy", 1)}
    found = []
    for row in rows:
        if (row["planner"], row["budget"]) != (planner, budget) or _key(row) not in base:
            continue
        greedy = base[_key(row)]
        found.append(
            (
                _key(row),
                {
                    "predicted": _less(row["predicted"], greedy["predicted"]),
                    "cost": _less(row["simulator"]["cost"], greedy["simulator"]["cost"]),
                    "picked": _less(_picked(row), _picked(greedy)),
                    "seconds_a_tonne": _less(*(_a_tonne(r, "time") for r in (row, greedy))),
                    "work_a_tonne": _less(*(_a_tonne(r, "work") for r in (row, greedy))),
                    "loads": float(row["simulator"]["loads"] - greedy["simulator"]["loads"]),
                },
            )
        )
    return found


def _less(value: float, than: float) -> float:
    return 100.0 * (than - value) / than


def _picked(row: dict[str, Any]) -> float:
    return float((row["picked"] or row["simulator"])["cost"])


def _a_tonne(row: dict[str, Any], name: str) -> float:
    return float(row["simulator"][name] / row["simulator"]["mass"])


def interval(of: Sequence[tuple[Key, dict[str, float]]], name: str) -> dict[str, Any]:
    """Mean over the piles, each by its mean over the seeds, and its confidence interval.

    Piles are what the benchmark is to speak for; seeds of one pile are not independent of it.

    Args:
        of: Gains.
        name: Of the measure.
    """
    by_pile: dict[str, list[float]] = {}
    for (pile, *_), measures in of:
        by_pile.setdefault(pile, []).append(measures[name])
    means = [statistics.fmean(values) for values in by_pile.values()]
    mean, half = statistics.fmean(means), math.nan
    if len(means) > 1:
        quantile = float(student.ppf(0.5 + 0.5 * _CONFIDENCE, len(means) - 1))
        half = quantile * statistics.stdev(means) / math.sqrt(len(means))
    return {"mean": mean, "half": None if math.isnan(half) else half, "piles": len(means)}


def by_planner(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every planner at every budget beside greedy, job by job and site by site."""
    table = []
    seen = dict.fromkeys((row["job"], row["site"], row["planner"], row["budget"]) for row in rows)
    for job, site, planner, budget in sorted(seen):
        here = [row for row in rows if (row["job"], row["site"]) == (job, site)]
        found = gains(here, planner, budget)
        if not found:
            continue
        own = [row for row in here if (row["planner"], row["budget"]) == (planner, budget)]
        measures = {name: interval(found, name) for name in found[0][1]}
        of: dict[str, float | None] = {
            "spent": statistics.median(float(row["spent"]) for row in own)
        }
        # Times tell something where nothing was compiled.
        warm = [row for row in own if not row["compiled"]]
        for name in ("seconds", "processor"):
            of[name] = statistics.median(float(r[name]) for r in warm) if warm else None
        head = {"job": job, "site": site, "planner": planner, "budget": budget}
        table.append({**head, "pairs": len(found), **of, **measures})
    return table


def looking_ahead(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What the best of the planners that look ahead is better than greedy by, job by job.

    The best is chosen by what it foresees, as a user would, and not by how it was played.
    """
    table = []
    places = dict.fromkeys((row["job"], row["site"], row["budget"]) for row in rows)
    for job, site, budget in sorted(places):
        here = [row for row in rows if (row["job"], row["site"]) == (job, site)]
        ahead = dict.fromkeys(row["planner"] for row in here if row["planner"] not in _NOT_AHEAD)
        found = {planner: gains(here, planner, budget) for planner in ahead}
        found = {planner: one for planner, one in found.items() if one}
        if not found:
            continue
        means = {planner: interval(one, "predicted")["mean"] for planner, one in found.items()}
        best = max(means, key=lambda planner: means[planner])
        measures = {name: interval(found[best], name) for name in found[best][0][1]}
        head = {"job": job, "site": site, "budget": budget, "planner": best}
        table.append({**head, "pairs": len(found[best]), **measures})
    return table


def best_plans(
    rows: Sequence[dict[str, Any]], before: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """The plan of each instance that costs least in the simulator, of rows and those known before.

    Args:
        rows: Of runs, with their plans.
        before: As this returns them.
    """
    best: dict[tuple[str, ...], dict[str, Any]] = {}
    for row in (*before, *rows):
        if row["plan"] is None:
            continue
        place = row["pile"], row["job"], row["site"]
        if place not in best or row["simulator"]["cost"] < best[place]["simulator"]["cost"]:
            kept = ("pile", "job", "site", "planner", "budget", "seed", "simulator", "plan")
            best[place] = {name: row[name] for name in kept}
    return [best[place] for place in sorted(best)]
