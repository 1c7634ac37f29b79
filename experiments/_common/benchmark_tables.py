"""The result of the benchmark of planners as tables that can be read."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from experiments._common.comparison import IN_REFEREE
from experiments._common.instances import JOBS, PILES, SITES, SMOKE_JOB

_NONE = "–"
_MEASURES = ("cost", "seconds_a_tonne", "work_a_tonne")


def tables(result: dict[str, Any]) -> str:
    """All tables of a result, in Markdown.

    Args:
        result: As `planner_benchmark.run` returns it.
    """
    rows, other = result["rows"], result["runs_with_other_settings"]
    parts = [
        "# Benchmark of planners",
        f"{result['runs']:,} of {result['runs_of_the_preset']:,} runs, "
        f"{other} of them with settings that their planners had before (*); means over the seeds, "
        "of which not all rows have as many. A budget is in times what greedy spends. "
        "A dash: not run.",
    ]
    for job in (SMOKE_JOB, *JOBS):
        of_job = [row for row in rows if row["job"] == job]
        if not of_job:
            continue
        if "loads" in job:
            parts += [f"## {job}: cost foreseen / in the simulator", _by_pile(of_job, _costs)]
        else:
            parts += [f"## {job}: seconds a tonne in the simulator", _by_pile(of_job, _a_tonne)]
            if job == "empty":
                parts += ["Loads, minutes, stalls, tonnes short:", _by_pile(of_job, _emptied)]
    parts += [
        "## Looking ahead",
        "The best planner that looks ahead beside greedy that has as much: less in the simulator "
        "[%], in pairs of the same pile and seed; mean over the piles and its interval of 95 %.",
        _gains(result["looking_ahead"], rows, ("looks ahead", "beside"), ("planner", "base")),
        "## Step by step",
        "Beside greedy with the fixed truck, on piles that have all steps: less in the simulator "
        "[%].",
        _gains(result["steps"], rows, ("planner",), ("planner",)),
    ]
    return "\n\n".join(parts) + "\n"


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _by_pile(rows: Sequence[dict[str, Any]], cell: Any) -> str:
    """One line a site, planner and budget, one column a pile, then seeds and time of a search."""
    piles = [pile for pile in PILES if any(row["pile"] == pile for row in rows)]
    lines = []
    for site in SITES:
        here = [row for row in rows if row["site"] == site]
        for planner, budget in sorted({(row["planner"], row["budget"]) for row in here}):
            own = [r for r in here if (r["planner"], r["budget"]) == (planner, budget)]
            of_piles = [[row for row in own if row["pile"] == pile] for pile in piles]
            cells = [cell(of_pile) if of_pile else _NONE for of_pile in of_piles]
            search = statistics.median(float(row["seconds"]) for row in own)
            name = planner + _mark(own)
            lines.append([site, name, str(budget), *cells, _counts(of_piles), f"{search:.0f}"])
    return _table(["truck", "planner", "budget", *piles, "seeds", "search [s]"], lines)


def _counts(parts: Sequence[Sequence[dict[str, Any]]]) -> str:
    """How many rows the parts have that have any, least and most."""
    counts = sorted({len(part) for part in parts if part})
    return "–".join(str(count) for count in counts[:: max(len(counts) - 1, 1)])


def _mark(rows: Sequence[dict[str, Any]]) -> str:
    return "" if all(row["of_today"] for row in rows) else " *"


def _mean(rows: Sequence[dict[str, Any]], value: Any) -> float:
    return statistics.fmean(float(value(row)) for row in rows)


def _costs(rows: Sequence[dict[str, Any]]) -> str:
    played = f"{_mean(rows, lambda row: row['simulator']['cost']):.2f}"
    # What is planned in the simulator is foreseen by it.
    if rows[0]["planner"].endswith(IN_REFEREE):
        return played
    return f"{_mean(rows, lambda row: row['predicted']):.2f} / {played}"


def _a_tonne(rows: Sequence[dict[str, Any]]) -> str:
    return f"{_mean(rows, lambda row: row['simulator']['time'] / row['simulator']['mass']):.2f}"


def _emptied(rows: Sequence[dict[str, Any]]) -> str:
    loads, time, stalls, missing = (
        _mean(rows, lambda row, name=name: row["simulator"][name])
        for name in ("loads", "time", "stalls", "missing")
    )
    return f"{loads:.0f}, {time / 60.0:.1f}, {stalls:.0f}, {missing:.1f}"


def _gains(
    gains: Sequence[dict[str, Any]],
    rows: Sequence[dict[str, Any]],
    heads: Sequence[str],
    names: Sequence[str],
) -> str:
    lines = []
    for gain in gains:
        planners = []
        for name in names:
            budget = gain["budget"] if name == "planner" else 1
            case = gain["job"], gain["site"], gain[name], budget
            planners.append(gain[name] + _mark([row for row in rows if _case(row) == case]))
        measures = [_interval(gain[measure]) for measure in _MEASURES]
        place = [gain["job"], gain["site"], *planners, str(gain["budget"])]
        counts = str(gain["cost"]["piles"]), str(gain["pairs"])
        lines.append([*place, *counts, *measures])
    sizes = ["budget", "piles", "pairs"]
    return _table(["job", "truck", *heads, *sizes, "cost", "time a tonne", "work a tonne"], lines)


def _case(row: dict[str, Any]) -> tuple[str, str, str, int]:
    return row["job"], row["site"], row["planner"], row["budget"]


def _interval(of: dict[str, Any]) -> str:
    half = "" if of["half"] is None else f" ± {of['half']:.1f}"
    return f"{of['mean']:.1f}{half}".replace("-", "−")
