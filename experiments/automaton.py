"""The quick automaton against the converged one on random digs, and what each ingredient gains."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments._common.results import main
from wlplan.constants import CELL_SIZE
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.site.soil import GRAVEL
from wlplan.studies.bench.digs import Dig, random_digs
from wlplan.terrain.automaton import DEFAULT_SCHEDULE, Schedule, converged, settle, steepest_slope
from wlplan.terrain.heightmap import sample
from wlplan.types import Pile

SEED, DIGS, SMOKE_DIGS = 0, 100, 6
# Of digs on which no schedule was chosen, judged on the whole pile.
OTHER_SEED = 3
# The reference is run until it is this close to the angle of repose [rad].
REFERENCE_TOLERANCE = math.radians(0.01)
# A cell counts as disturbed where it moved by more than this [m].
DISTURBED = 1e-3
# Runs of every schedule on every dig, of which the quickest counts: the rest is noise.
RUNS, SMOKE_RUNS = 5, 1

# Rounds are only stopped by the tolerance: schedules without momentum or levels need many.
_WITHOUT_LIMIT = dataclasses.replace(DEFAULT_SCHEDULE, most_rounds=2000)
SCHEDULES = {
    "default": DEFAULT_SCHEDULE,
    "levels, no momentum": dataclasses.replace(_WITHOUT_LIMIT, momentum=0.0),
    "momentum, no levels": dataclasses.replace(_WITHOUT_LIMIT, sweeps=(40,)),
    "two levels": dataclasses.replace(_WITHOUT_LIMIT, sweeps=(6, 8)),
    "four levels": dataclasses.replace(_WITHOUT_LIMIT, sweeps=(6, 8, 12, 12)),
    "more on the coarsest": dataclasses.replace(_WITHOUT_LIMIT, sweeps=(6, 8, 24)),
    "twice the sweeps": dataclasses.replace(_WITHOUT_LIMIT, sweeps=(12, 16, 24)),
    "four times": dataclasses.replace(_WITHOUT_LIMIT, sweeps=(24, 32, 48)),
    "momentum 0.8": dataclasses.replace(_WITHOUT_LIMIT, momentum=0.8),
    "momentum 0.9": dataclasses.replace(_WITHOUT_LIMIT, momentum=0.9),
    "momentum 0.97": dataclasses.replace(_WITHOUT_LIMIT, momentum=0.97),
}
SMOKE_SCHEDULES = ("default", "levels, no momentum", "momentum, no levels")
PLAIN = "plain sweeps"

# The profile that is drawn: along the heading, from this far before the dig location to this far
# behind it [m].
_FROM, _TO = -1.5, 6.5


def run(preset: str) -> dict[str, Any]:
    """Settles the windows of random digs with every schedule and compares with the reference."""
    smoke = preset == "smoke"
    digs = random_digs(SMOKE_DIGS if smoke else DIGS, SEED)
    references = [_reference(dig) for dig in digs]
    tolerance = DEFAULT_SCHEDULE.tolerance
    plain = jax.jit(functools.partial(converged, tolerance=tolerance))
    rows = [_judged(PLAIN, plain, None, digs, references, smoke)]
    for name, schedule in SCHEDULES.items():
        if smoke and name not in SMOKE_SCHEDULES:
            continue
        rows.append(_judged(name, _settles(schedule), schedule, digs, references, smoke))
    taken = [float((dig.before.height - dig.dug.height).sum()) for dig in digs]
    largest = int(np.argmax(taken))
    return {
        "digs": len(digs),
        "seed": SEED,
        "repose_degrees": math.degrees(GRAVEL.repose_angle),
        "tolerance_degrees": math.degrees(tolerance),
        "reference": {
            "tolerance_degrees": math.degrees(REFERENCE_TOLERANCE),
            "steepest_slope_degrees": max(_slope(h) for h in references),
            "relative_volume_change": max(
                _volume_change(dig, h) for dig, h in zip(digs, references, strict=True)
            ),
        },
        "rows": rows,
        "whole": _whole(SMOKE_DIGS if smoke else DIGS),
        "profile": _profile(digs[largest], references[largest]),
    }


def _whole(count: int) -> dict[str, Any]:
    """Whole piles after a loading, avalanches beyond the first window included."""
    errors, slopes, volumes, beyond = [], [], [], 0
    for dig in random_digs(count, OTHER_SEED):
        before, found = (np.asarray(p.height, np.float64) for p in (dig.pile, dig.after))
        inside = tuple(
            slice(int(i), int(i) + n) for i, n in zip(dig.start, dig.dug.height.shape, strict=True)
        )
        hole, rest = before.copy(), np.ones(before.shape, bool)
        hole[inside], rest[inside] = np.asarray(dig.dug.height), False
        reference = _at_rest(dig.pile, hole)
        moved = np.maximum(np.abs(hole - before), np.abs(found - before)) > DISTURBED
        errors.append(float(np.abs(found - reference)[moved].mean()))
        slopes.append(_slope(found))
        volumes.append(abs(float(found.sum() - hole.sum())) / float(hole.sum()))
        beyond += bool((moved & rest).any())
    return {
        "digs": count,
        "seed": OTHER_SEED,
        "error": _spread(errors),
        "steepest_slope_degrees": max(slopes),
        "relative_volume_change": max(volumes),
        "beyond_the_window": beyond,
    }


def _reference(dig: Dig) -> np.ndarray:
    """The window of a dig by the converged automaton."""
    return _at_rest(dig.dug, dig.dug.height)


def _at_rest(pile: Pile, height: Any) -> np.ndarray:
    """The converged automaton, in float64: its many sweeps would round the volume off."""
    with jax.enable_x64(True):
        wide = pile.replace(
            height=jnp.asarray(np.asarray(height), jnp.float64),
            origin=jnp.asarray(np.asarray(pile.origin), jnp.float64),
        )
        return np.asarray(_converged(wide).height)


_converged = jax.jit(functools.partial(converged, tolerance=REFERENCE_TOLERANCE))


def _judged(
    name: str,
    automaton: Callable[[Pile], Pile],
    schedule: Schedule | None,
    digs: list[Dig],
    references: list[np.ndarray],
    smoke: bool,
) -> dict[str, Any]:
    """Time, slope, volume and error of an automaton over all digs; schedule None: plain sweeps."""
    jax.block_until_ready(automaton(digs[0].dug))
    found, seconds = [], []
    for dig in digs:
        spent = []
        for _ in range(SMOKE_RUNS if smoke else RUNS):
            start = time.perf_counter()
            after = jax.block_until_ready(automaton(dig.dug))
            spent.append(time.perf_counter() - start)
        found.append(np.asarray(after.height, np.float64))
        seconds.append(min(spent))
    errors = [_error(dig, h, r) for dig, h, r in zip(digs, found, references, strict=True)]
    row: dict[str, Any] = {
        "name": name,
        "sweeps": None if schedule is None else schedule.sweeps,
        "momentum": 0.0 if schedule is None else schedule.momentum,
        "milliseconds": _spread([1e3 * s for s in seconds]),
        "steepest_slope_degrees": max(_slope(h) for h in found),
        "relative_volume_change": max(
            _volume_change(dig, h) for dig, h in zip(digs, found, strict=True)
        ),
        "error": _spread(errors),
        "errors": errors,
    }
    if schedule is not None:
        rounds = _rounds(digs, schedule)
        row |= {"rounds": _spread(rounds), "each_rounds": rounds}
    return row


def _settles(schedule: Schedule) -> Callable[[Pile], Pile]:
    return jax.jit(lambda pile: settle(pile, schedule=schedule).pile)


def _rounds(digs: list[Dig], schedule: Schedule) -> list[int]:
    """Rounds that each dig takes."""
    rounds = jax.jit(lambda pile: settle(pile, schedule=schedule).rounds)
    return [int(rounds(dig.dug)) for dig in digs]


def _spread(values: Sequence[float]) -> dict[str, float]:
    low, median, high = (float(v) for v in np.percentile(values, (10, 50, 90)))
    return {
        "median": median,
        "mean": float(np.mean(values)),
        "p10": low,
        "p90": high,
        "most": float(max(values)),
    }


def _slope(height: np.ndarray) -> float:
    """Steepest slope [degree]."""
    return math.degrees(steepest_slope(Pile(jnp.asarray(height, jnp.float32), CELL_SIZE)))


def _volume_change(dig: Dig, after: np.ndarray) -> float:
    before = np.asarray(dig.dug.height, np.float64).sum()
    return abs(float(after.sum() - before)) / float(before)


def _error(dig: Dig, found: np.ndarray, reference: np.ndarray) -> float:
    """Mean absolute difference from the reference over the disturbed cells [m]."""
    before = np.asarray(dig.before.height, np.float64)
    changes = [np.abs(h - before) for h in (np.asarray(dig.dug.height), found, reference)]
    disturbed = np.max(changes, axis=0) > DISTURBED
    return float(np.abs(found - reference)[disturbed].mean())


def _profile(dig: Dig, reference: np.ndarray) -> dict[str, list[float]]:
    """Heights along the heading through a dig [m]."""
    along = jnp.linspace(_FROM, _TO, 151)
    x = dig.pose.x + along * jnp.cos(dig.pose.heading)
    y = dig.pose.y + along * jnp.sin(dig.pose.heading)
    surfaces = {
        "before": dig.before.height,
        "dug": dig.dug.height,
        "settled": _settles(DEFAULT_SCHEDULE)(dig.dug).height,
        "converged": jnp.asarray(reference, jnp.float32),
    }
    lines = {name: sample(surface, dig.dug, x, y) for name, surface in surfaces.items()}
    return {name: np.round(line, 5).tolist() for name, line in {"along": along, **lines}.items()}


_ORANGE, _BLUE, _GREY, _INK = "#d97a1f", "#1f5fa8", "#8a8a8a", "#1d2733"
_STYLES: dict[str, dict[str, Any]] = {
    "before": {"color": _GREY, "ls": "-"},
    "converged": {"color": _BLUE, "ls": "-", "lw": 3.0},
    "settled": {"color": _ORANGE, "ls": "--", "lw": 1.8},
    "dug": {"color": _INK, "ls": ":"},
}


def draw(folder: Path) -> None:
    """A profile through one dig, the errors of all, and what each ingredient gains."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    result = json.loads((folder / "automaton.json").read_text())
    figure = Figure(figsize=(8.4, 6.0), layout="constrained")
    panels = figure.subplot_mosaic([["profile", "profile"], ["errors", "schedules"]])
    _draw_profile(panels["profile"], result["profile"])

    (default,) = (row for row in result["rows"] if row["name"] == "default")
    centimetres = 100.0 * np.array(default["errors"])
    panel = panels["errors"]
    panel.hist(centimetres, bins=np.linspace(0.0, centimetres.max(), 25).tolist(), color=_ORANGE)
    panel.axvline(np.median(centimetres), color=_INK, ls="--", label="median")
    locator = panel.yaxis.get_major_locator()
    assert isinstance(locator, MaxNLocator)
    locator.set_params(integer=True)
    panel.set_xlim(0.0)
    panel.set_xlabel("mean error where disturbed [cm]")
    panel.set_ylabel("digs")
    panel.set_title(f"Error of {result['digs']} digs", fontsize=10)
    panel.legend(frameon=False)

    panel = panels["schedules"]
    rows = result["rows"][::-1]
    times = [row["milliseconds"]["median"] for row in rows]
    colours = [_ORANGE if row is default else _BLUE for row in rows]
    panel.barh([row["name"] for row in rows], times, color=colours)
    for k, (row, milliseconds) in enumerate(zip(rows, times, strict=True)):
        label = f" {100.0 * row['error']['median']:.1f} cm"
        panel.text(milliseconds, k, label, va="center", fontsize=8)
    panel.set_xlim(0.0, 1.2 * max(times))
    panel.set_xlabel("run time, median [ms]")
    title = f"To within {result['tolerance_degrees']:g}° of repose, with error"
    panel.set_title(title, fontsize=10)
    write_bytes_atomic(folder / "automaton.png", png_bytes(figure))


def _draw_profile(panel: Any, lines: dict[str, list[float]]) -> None:
    for name, style in _STYLES.items():
        panel.plot(lines["along"], lines[name], label=name, **style)
    panel.set_aspect("equal")
    panel.set_xlim(_FROM, _TO)
    panel.set_xlabel("distance along the heading [m]")
    panel.set_ylabel("height [m]")
    panel.legend(frameon=False)
    panel.set_title("Profile through the largest dig", fontsize=10)


if __name__ == "__main__":
    main("automaton", run, draw)
