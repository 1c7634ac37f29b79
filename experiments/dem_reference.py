"""The simulator beside 39 closed-loop cycles of an independent discrete-element engine."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from experiments.record import main
from wlplan.io import write_bytes_atomic
from wlplan.machine import GRAVEL, WA320
from wlplan.plots import png_bytes
from wlplan.simulator import STOP_REASONS, Cycle, dig
from wlplan.types import action_from

REFERENCE = Path(__file__).parents[1] / "tests" / "references" / "dem_cycles.npz"

# Constants of the reference's machine, from its description.
MACHINE = dataclasses.replace(
    WA320,
    mass=15_500.0,
    traction=0.75,
    wheel_power=110e3,
    speed_gain=2e5,
    boom_length=2.6,
    boom_low=math.asin((0.35 - 1.9) / 2.6),
    tip_radius=math.hypot(1.32, 0.35),
    tilt_end=math.radians(50.0),
    boom_speed=0.23,
    tilt_speed=0.55,
    tilt_moment=220e3,
)


def replay(count: int | None = None) -> tuple[dict[str, np.ndarray], Cycle]:
    """The reference's first cycles, and ours on its surfaces, with its actions and machine."""
    with np.load(REFERENCE) as stored:
        reference = {name: stored[name][:count] for name in stored if stored[name].ndim}
    # The reference's cells lie half a cell further along the heading than ours.
    shifted = ndimage.shift(
        reference["h0_cg"].astype(np.float32), (0, 0.5, 0), order=1, mode="nearest"
    )
    surface = jnp.asarray(shifted)
    actions = jnp.asarray(reference["action"], jnp.float32)
    cycle = jax.jit(
        jax.vmap(
            lambda h, a: dig(h, jnp.zeros_like(h), action_from(a), machine=MACHINE, soil=GRAVEL)
        )
    )(surface, actions)
    return reference, cycle


def run(preset: str) -> dict[str, Any]:
    """Plays the reference's actions on the reference's surfaces with its machine constants."""
    reference, cycle = replay(4 if preset == "smoke" else None)
    ours = {
        "mass": cycle.mass / 1e3,
        "time": cycle.time,
        # The reference counts thrust times vehicle speed, boom and bucket, without slip.
        "work": (cycle.work_drive + cycle.work_boom + cycle.work_bucket) / 1e3,
    }
    theirs = {name: reference[f"{name}_{unit}"] for name, unit in _UNITS.items()}
    return {
        "cycles": len(cycle.mass),
        "agreement": {name: _agreement(np.asarray(ours[name]), theirs[name]) for name in ours},
        "ours": {name: np.asarray(value).tolist() for name, value in ours.items()},
        "reference": {name: value.tolist() for name, value in theirs.items()},
        "stop_reason": [STOP_REASONS[int(k)] for k in cycle.stop_reason],
    }


_UNITS = {"mass": "t", "time": "s", "work": "kJ"}


def _agreement(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    ranks = [np.argsort(np.argsort(values)) for values in (ours, theirs)]
    return {
        "bias": float(ours.mean() / theirs.mean() - 1.0),
        "rank_correlation": float(np.corrcoef(*ranks)[0, 1]),
        "mean_relative_difference": float(np.abs(ours / theirs - 1.0).mean()),
        "median_relative_difference": float(np.median(np.abs(ours / theirs - 1.0))),
    }


def draw(folder: Path) -> None:
    """Ours against the reference's, cycle by cycle."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "dem_reference.json").read_text())
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    for axis, (name, unit) in zip(figure.subplots(1, 3), _UNITS.items(), strict=True):
        ours, theirs = result["ours"][name], result["reference"][name]
        low, high = min(*ours, *theirs), max(*ours, *theirs)
        axis.plot([low, high], [low, high], color="#999999", lw=1)
        axis.plot(theirs, ours, "o", ms=4, color="#1f5fa8")
        agreement = result["agreement"][name]
        axis.set_title(
            f"{name}: bias {100 * agreement['bias']:+.1f} %, "
            f"rank correlation {agreement['rank_correlation']:.2f}",
            fontsize=9,
        )
        axis.set_xlabel(f"discrete elements [{unit}]")
        axis.set_ylabel(f"this simulator [{unit}]")
        axis.set_aspect("equal", adjustable="datalim")
    write_bytes_atomic(folder / "dem_reference.png", png_bytes(figure))


if __name__ == "__main__":
    main("dem_reference", run, draw)
