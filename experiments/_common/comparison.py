"""Planners beside greedy: rows of runs in, tables out."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple

from scipy.stats import t as student

IN_REFEREE = ", in the simulator"
"""Added to the name of planners that plan each load on the pile as the simulator has it."""
_CONFIDENCE = 0.95
# Those that do not look at more than the next load, or at nothing.
_NOT_AHEAD = ("greedy", f"greedy{IN_REFEREE}", "nominal", "max load", "random search")

Key = tuple[str, str, int]
"""Pile, job and seed."""


class Case(NamedTuple):
    """How runs were made."""

    site: str
    planner: str
    budget: int  # in times what greedy spends


def _case(row: dict[str, Any]) -> Case:
    return Case(row["site"], row["planner"], row["budget"])


def _key(row: dict[str, Any]) -> Key:
    return row["pile"], row["job"], row["seed"]


def gains(
    rows: Sequence[dict[str, Any]], case: Case, base: Case
) -> list[tuple[Key, dict[str, float]]]:
    """What a case is better than another by, on the same pile, job and seed [%].

    Args:
        rows: All of them.
        case: What is compared.
        base: With what.
    """
    of_base = {_key(row): row for row in rows if _case(row) == base}
    found = []
    for row in rows:
        if _case(row) != case or _key(row) not in of_base:
            continue
        other = of_base[_key(row)]
        found.append(
            (
                _key(row),
                {
                    "predicted": _less(row["predicted"], other["predicted"]),
                    "cost": _less(row["simulator"]["cost"], other["simulator"]["cost"]),
                    "picked": _less(_picked(row), _picked(other)),
                    "seconds": _less(row["simulator"]["time"], other["simulator"]["time"]),
                    "seconds_a_tonne": _less(*(_a_tonne(r, "time") for r in (row, other))),
                    "work_a_tonne": _less(*(_a_tonne(r, "work") for r in (row, other))),
                    "loads": float(row["simulator"]["loads"] - other["simulator"]["loads"]),
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


def _intervals(of: Sequence[tuple[Key, dict[str, float]]]) -> dict[str, Any]:
    return {"pairs": len(of), **{name: interval(of, name) for name in of[0][1]}}


def by_planner(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every planner at every budget beside greedy, job by job and site by site."""
    table = []
    for job, case in sorted({(row["job"], _case(row)) for row in rows}):
        here = [row for row in rows if row["job"] == job]
        found = gains(here, case, Case(case.site, "greedy", 1))
        if not found:
            continue
        own = [row for row in here if _case(row) == case]
        # Compiling not counted; not known of rows that were made before the two were told apart.
        known = [float(row["seconds"]) for row in own if "seconds" in row]
        of = {
            "spent": statistics.median(float(row["spent"]) for row in own),
            "search": statistics.median(known) if known else None,
        }
        table.append({"job": job, **case._asdict(), **of, **_intervals(found)})
    return table


def looking_ahead(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What planners that look ahead are better by than greedy, job by job and site by site.

    Once in the model alone, and once with the simulator to plan in as well, where greedy has it
    too. Of those in the model alone the best is taken, chosen by what it foresees, as a user would,
    and not by how it was played.
    """
    table = []
    places = dict.fromkeys((row["job"], row["site"], row["budget"]) for row in rows)
    for job, site, budget in sorted(places):
        here = [row for row in rows if row["job"] == job]
        of_place = [row for row in here if (row["site"], row["budget"]) == (site, budget)]
        ahead = dict.fromkeys(r["planner"] for r in of_place if r["planner"] not in _NOT_AHEAD)
        for marked in (False, True):
            base = Case(site, f"greedy{IN_REFEREE}" if marked else "greedy", 1)
            measure = "cost" if marked else "predicted"
            found = {
                planner: gains(here, Case(site, planner, budget), base)
                for planner in ahead
                if planner.endswith(IN_REFEREE) == marked
            }
            means = {
                planner: interval(one, measure)["mean"] for planner, one in found.items() if one
            }
            if means:
                best = max(means, key=lambda planner: means[planner])
                head = {"job": job, **Case(site, best, budget)._asdict()}
                table.append({**head, "base": base.planner, **_intervals(found[best])})
    return table


def steps(rows: Sequence[dict[str, Any]], cases: Sequence[Case]) -> list[dict[str, Any]]:
    """What each case is better by than the first, job by job, on the piles that have all of them.

    Args:
        rows: All of them.
        cases: One after another; those that a job has no rows of are left out.
    """
    table = []
    for job in dict.fromkeys(row["job"] for row in rows):
        here = [row for row in rows if row["job"] == job]
        known = [case for case in cases if any(_case(row) == case for row in here)]
        if not known or known[0] != cases[0]:
            continue
        whole = set.intersection(
            *({_key(row) for row in here if _case(row) == case} for case in known)
        )
        here = [row for row in here if _key(row) in whole]
        if whole:
            table += [
                {"job": job, **case._asdict(), **_intervals(gains(here, case, cases[0]))}
                for case in known
            ]
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
        # None: there was not enough for one. Of rows that were committed it is not kept.
        if not row["plan"]:
            continue
        place = row["pile"], row["job"], row["site"]
        if place not in best or row["simulator"]["cost"] < best[place]["simulator"]["cost"]:
            kept = ("pile", "job", "site", "planner", "budget", "seed", "simulator", "plan")
            best[place] = {name: row[name] for name in kept}
    return [best[place] for place in sorted(best)]
