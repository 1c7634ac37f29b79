"""Fixed and optimised diggability maps, foreseen and played: does the gain survive?

Thirty locations around each of three piles: the paper's action along the inward normal, and the
best heading and action of each location, by the hybrid world. Both are played in the simulator, on
the pile as it stands. Then the fixed action takes over one decision of the best at a time, which
says what was wrong with it where it did badly.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, new_figure, tidy
from wlplan.studies.diggability import PAPER_ACTION, DiggabilityMap, foreseen_on_map
from wlplan.studies.optimised_diggability import LocalSearch, OptimisedMap, optimised_map
from wlplan.terrain.characteristics import characteristics
from wlplan.terrain.heightmap import sample_local
from wlplan.types import Action, Performance, Pile, Pose

LOCATIONS, FEW = 30, 3
# What the fixed action takes over from the best, one at a time.
DECISIONS = ("heading", "delta_bm", "k_bm", "delta_bk", "k_bk")
# A loading that takes longer was ended by the limit of time, or nearly [s].
STALLED = 15.0


def piles() -> dict[str, Pile]:
    """The pile that comes with the package, a cone and a ridge."""
    cone, ridge = (
        wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(30.0), height=4.0, seed=1))
        for kind in ("conical", "triangular")
    )
    return {"bundled": wlplan.read_pile(bundled_pile_path()), "cone": cone, "ridge": ridge}


def run(preset: str) -> dict[str, Any]:
    """Maps in the hybrid world, played in the simulator."""
    smoke = preset == "smoke"
    search = LocalSearch(actions=4, steps=2) if smoke else LocalSearch()
    locations = FEW if smoke else LOCATIONS
    hybrid, simulator = wlplan.load_world("hybrid"), wlplan.load_world("simulator")
    found: dict[str, Any] = {}
    for name, pile in piles().items():
        start = time.perf_counter()
        maps = optimised_map(hybrid, pile, locations=locations, search=search)
        mapped = time.perf_counter() - start
        parts: dict[str, Any] = {
            part: _part(simulator, hybrid, pile, one)
            for part, one in (("fixed", maps.fixed), ("best", maps.best))
        }
        for decision in DECISIONS if name == "bundled" else ():
            pose, action = _with(maps, decision)
            parts[f"fixed but {decision}"] = {
                "played": _columns(_played(simulator, pile, pose, action))
            }
        found[name] = {
            **_columns(maps.fixed.pose),
            "face": _columns(_faces(pile, maps.fixed.pose)),
            "offset": _rounded(maps.offset),
            "action": _columns(maps.best.action),
            **parts,
            "map_seconds": mapped,
        }
        say(f"{name} {json.dumps(_summary(found[name]))}")
        if smoke:
            break
    return {
        "action": {name: float(value) for name, value in dataclasses.asdict(PAPER_ACTION).items()},
        "piles": found,
        "summary": {name: _summary(one) for name, one in found.items()},
    }


def _part(simulator: Any, hybrid: Any, pile: Pile, found: DiggabilityMap) -> dict[str, Any]:
    """What was foreseen of a map, and what was played."""
    known = foreseen_on_map(hybrid, pile, found)
    return {
        "foreseen": _columns(found.performance),
        "played": _columns(_played(simulator, pile, found.pose, found.action)),
        "stall_probability": _rounded(known.stall_probability),
        "deviation": _columns(known.deviation),
    }


def _with(maps: OptimisedMap, decision: str) -> tuple[Pose, Action]:
    """The fixed decisions with one of the best."""
    pose, action = maps.fixed.pose, maps.fixed.action
    assert action is not None
    if decision == "heading":
        return maps.best.pose, action
    return pose, action.replace(**{decision: getattr(maps.best.action, decision)})


def _played(simulator: Any, pile: Pile, pose: Pose, action: Action | None) -> Performance:
    """Each location alone on the pile as it stands, one after the other."""
    rows = [
        simulator(pile, *jax.tree.map(lambda leaf, n=n: leaf[n], (pose, action)))[1]
        for n in range(len(pose.x))
    ]
    played: Performance = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    return played


def _faces(pile: Pile, pose: Pose) -> Any:
    return jax.vmap(lambda one: characteristics(sample_local(pile, one)))(pose)


def _columns(part: Any) -> dict[str, list[float]]:
    return {field.name: _rounded(getattr(part, field.name)) for field in dataclasses.fields(part)}


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.5g}") for value in np.asarray(values, float)]


def _rate(performance: Mapping[str, Any]) -> np.ndarray:
    mass, spent = (np.array(performance[q], float) for q in ("mass", "time"))
    rate: np.ndarray = 3600.0 * mass / spent
    return rate


def _summary(one: Mapping[str, Any]) -> dict[str, Any]:
    """Means over the locations of a pile, and what they gain [%]."""
    found: dict[str, Any] = {}
    for part in ("fixed", "best"):
        for kind in ("foreseen", "played"):
            values = one[part][kind]
            means = {q: float(np.mean(values[q])) for q in ("mass", "time", "work")}
            stalls = int((np.array(values["time"]) > STALLED).sum())
            rate = float(_rate(values).mean())
            found[f"{part}, {kind}"] = {**means, "rate": rate, "stalls": stalls}
    for kind in ("foreseen", "played"):
        old, new = (_rate(one[part][kind]) for part in ("fixed", "best"))
        found[f"gain, {kind}"] = {
            "of_the_mean_rate": 100.0 * float(new.mean() / old.mean() - 1.0),
            "median": 100.0 * float(np.median(new / old) - 1.0),
            "worse": int((new < old).sum()),
        }
    found["one decision of the best"] = {
        decision: float(_rate(one[f"fixed but {decision}"]["played"]).mean())
        for decision in DECISIONS
        if f"fixed but {decision}" in one
    }
    return found


def draw(folder: Path) -> None:
    """Rates around each pile, foreseen and played; and played against foreseen."""
    found = json.loads((folder / "diggability.json").read_text())["piles"]
    figure = new_figure(3.2 * len(found) + 0.6, 5.4)
    panels = figure.subplots(2, len(found), squeeze=False, sharey="row")
    colours = {"fixed": ORANGE, "best": BLUE}
    for (above, below), (name, one) in zip(panels.T, found.items(), strict=True):
        x, y = (np.array(one[q], float) for q in ("x", "y"))
        bearing = np.degrees(np.arctan2(y - y.mean(), x - x.mean()))
        order = np.argsort(bearing)
        for part, colour in colours.items():
            foreseen, played = (_rate(one[part][kind]) for kind in ("foreseen", "played"))
            above.plot(bearing[order], foreseen[order], "--", color=colour, lw=1.0)
            above.plot(bearing[order], played[order], "o-", ms=3, color=colour, lw=1.2, label=part)
            below.plot(foreseen, played, "o", ms=4, color=colour, alpha=0.7)
        most = max(float(_rate(one[p][k]).max()) for p in colours for k in ("foreseen", "played"))
        below.plot([0.0, most], [0.0, most], color=FAINT, lw=0.8)
        above.set_title(name, fontsize=9)
        above.set_xticks([-180, -90, 0, 90, 180], ["W", "S", "E", "N", "W"])
        above.set_xlabel("side of the pile", fontsize=8)
        below.set_xlabel("rate foreseen [t/h]", fontsize=8)
        tidy(above)
        tidy(below)
    panels[0, 0].set_ylabel("rate [t/h]; dashed: foreseen", fontsize=8)
    panels[1, 0].set_ylabel("rate played [t/h]", fontsize=8)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    write_bytes_atomic(folder / "diggability.png", png_bytes(figure))


if __name__ == "__main__":
    main("diggability", run, draw)
