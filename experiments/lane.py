"""Soil in the approach lane: the simulator beside discrete elements, with the lane and without.

Each cycle of the reference digs a pile over a ridge that lies in the lane. Beside stand the same
cycles in the simulator that meets the ridge, in the one that takes the lane as free, and, where
they were played, those of the discrete elements without the ridge. Then greedy plans, played in
both simulators: what the lane makes of whole jobs.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from experiments.dem_reference import MACHINE, UNITS, agreement
from wlplan.constants import CELL_SIZE, J_PER_KJ
from wlplan.engines.simulator import STOP_REASONS, Simulator
from wlplan.io import write_bytes_atomic
from wlplan.planning.planners import Greedy
from wlplan.report.figures import png_bytes
from wlplan.site.soil import GRAVEL
from wlplan.types import Pile, Pose, action_from

_FOLDER = Path(__file__).parents[1] / "tests" / "references"
RIDGE, FREE = _FOLDER / "dem_lane.npz", _FOLDER / "dem_lane_free.npz"
"""The cycles with the ridge, and the same without, of `experiments.dem_cycles --lane`."""
CHOSEN_ON = 2
"""Cycles that the form of the resistance in the lane was chosen on: the first."""
PILES = {"cone": "conical", "ridge": "triangular", "wedge": "wedge"}
"""Piles that plans are made for, and their kind."""
SLOPE_DEGREES, LOADS, SEEDS = 30.0, 30, (1, 2)
# A cycle of this time has stalled: it filled until its time was up [s].
_STALL = 17.0
# A load counts as another where its mass differs by more than this part.
_ANOTHER = 0.02
_COLOURS = {"meets": "#1f5fa8", "free": "#b9c4d0"}


def load(path: Path, count: int | None = None) -> dict[str, np.ndarray]:
    """Fields of the first cycles of a file; heights before in metres."""
    with np.load(path) as archive:
        cycles = {name: archive[name][:count] for name in archive if archive[name].ndim}
        unit, grid = archive["unit_m"], (archive["grid_x"], archive["grid_y"])
    first = np.array([axis[0] for axis in grid], np.float32)
    return cycles | {"h0_cg": cycles["h0_cg"] * np.float32(unit), "first": first}


def replay(cycles: dict[str, np.ndarray], *, lane_soil: bool) -> dict[str, np.ndarray]:
    """The simulator on the surfaces of the reference, with its actions and machine.

    Returns:
        mass [tonne], time [s], work without slip [kJ] and stop_reason, each of shape [cycles].
    """
    simulator = Simulator(machine=MACHINE, soil=GRAVEL, lane_soil=lane_soil)
    pose = Pose(*jnp.zeros(3))

    @jax.jit
    def one(height: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        pile = Pile(height, CELL_SIZE, jnp.asarray(cycles["first"]))
        _, performance, cycle = simulator.play(pile, pose, action_from(action))
        # The reference counts thrust times vehicle speed, boom and bucket, without slip.
        work = performance.work - cycle.work_slip / J_PER_KJ
        return jnp.stack([performance.mass, performance.time, work]), cycle.stop_reason

    played = [
        one(jnp.asarray(height), jnp.asarray(action, jnp.float32))
        for height, action in zip(cycles["h0_cg"], cycles["action"], strict=True)
    ]
    numbers = np.array([row for row, _ in played])
    stops = np.array([STOP_REASONS[int(stop)] for _, stop in played])
    return dict(zip(UNITS, numbers.T, strict=True)) | {"stop_reason": stops}


def run(preset: str) -> dict[str, Any]:
    """Plays the reference's cycles in both simulators."""
    count = 2 if preset == "smoke" else None
    cycles = load(RIDGE, count)
    ours = {
        "meets": replay(cycles, lane_soil=True),
        "free": replay(cycles, lane_soil=False),
    }
    theirs = {name: cycles[f"{name}_{unit}"] for name, unit in UNITS.items()}
    held_out = np.arange(len(theirs["mass"])) >= (0 if preset == "smoke" else CHOSEN_ON)
    result: dict[str, Any] = {
        "cycles": len(theirs["mass"]),
        "held_out": int(held_out.sum()),
        "agreement_held_out": {
            which: {n: agreement(played[n][held_out], theirs[n][held_out]) for n in UNITS}
            for which, played in ours.items()
        },
        "same_stop_reason": {
            which: int((played["stop_reason"] == cycles["stop_reason"]).sum())
            for which, played in ours.items()
        },
        "stalls": {
            which: {
                "dem": int((theirs_stall := cycles["stop_reason"] == "timeout").sum()),
                "ours": int((stalls := played["stop_reason"] == "timeout").sum()),
                "both": int((stalls & theirs_stall).sum()),
            }
            for which, played in ours.items()
        },
        "ridge": {
            name: np.round(cycles[f"ridge_{name}"], 3).tolist()
            for name in ("m", "before_m", "length_m", "left_m", "turn_deg")
        },
        "shape": cycles["shape"].tolist(),
        "dem": {n: np.round(v.astype(float), 3).tolist() for n, v in theirs.items()}
        | {"stop_reason": cycles["stop_reason"].tolist()},
        **{
            which: {n: np.round(played[n].astype(float), 3).tolist() for n in UNITS}
            | {"stop_reason": played["stop_reason"].tolist()}
            for which, played in ours.items()
        },
    }
    if FREE.exists():
        without = load(FREE, count)
        level = replay(without, lane_soil=False)
        result["without_ridge"] = {
            "dem": {
                n: np.round(without[f"{n}_{unit}"].astype(float), 3).tolist()
                for n, unit in UNITS.items()
            }
            | {"stop_reason": without["stop_reason"].tolist()},
            "ours": {n: np.round(level[n].astype(float), 3).tolist() for n in UNITS}
            | {"stop_reason": level["stop_reason"].tolist()},
        }
    result["plans"] = plans(preset)
    return result


def plans(preset: str) -> list[dict[str, Any]]:
    """Greedy plans of the low world, played with lanes taken as free and met."""
    smoke = preset == "smoke"
    planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3) if smoke else Greedy()
    world = wlplan.load_world("low")
    rows = []
    for name, kind in {"cone": "conical"}.items() if smoke else PILES.items():
        for seed in SEEDS[: 1 if smoke else None]:
            pile = wlplan.seed_pile(kind, slope=math.radians(SLOPE_DEGREES), seed=seed)
            pile = wlplan.relax(pile)
            loads = 2 if smoke else LOADS
            plan = wlplan.plan_loads(world, pile, loads=loads, planner=planner, seed=seed).plan
            performance = {
                which: wlplan.play(wlplan.load_world(engine), pile, plan).rollout.performance
                for which, engine in (("free", "simulator"), ("meets", "simulator-lane"))
            }
            masses = {which: np.asarray(one.mass) for which, one in performance.items()}
            row: dict[str, Any] = {"pile": name, "seed": seed, "loads": len(masses["free"])}
            for which, one in performance.items():
                row[which] = {n: round(float(getattr(one, n).sum()), 3) for n in UNITS}
                row[which]["stalls"] = int((np.asarray(one.time) > _STALL).sum())
            apart = np.abs(masses["meets"] / np.maximum(masses["free"], 1e-3) - 1.0)
            row["other_loads"] = int((apart > _ANOTHER).sum())
            rows.append(row)
            say(json.dumps(row))
    return rows


def draw(folder: Path) -> None:
    """Outcome of each cycle against that of the discrete elements."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "lane.json").read_text())
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    for axis, (name, unit) in zip(figure.subplots(1, 3), UNITS.items(), strict=True):
        theirs = result["dem"][name]
        drawn = list(theirs)
        for which, label in (("free", "lane taken as free"), ("meets", "lane met")):
            axis.plot(theirs, result[which][name], "o", ms=5, color=_COLOURS[which], label=label)
            drawn += result[which][name]
        axis.plot([min(drawn), max(drawn)], [min(drawn), max(drawn)], color="#999999", lw=1)
        axis.set_xlabel(f"{name}, discrete elements [{unit}]")
        axis.set_ylabel(f"this simulator [{unit}]")
        axis.set_aspect("equal", adjustable="datalim")
    figure.axes[0].legend(fontsize=8, frameon=False)
    write_bytes_atomic(folder / "lane.png", png_bytes(figure))


if __name__ == "__main__":
    main("lane", run, draw)
