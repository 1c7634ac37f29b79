"""The simulator beside closed-loop cycles of an independent discrete-element engine.

Closed loop: the same surfaces, actions and machine constants; mass, time, work, and where the soil
lies afterwards. Open loop: the bucket is led along the recorded paths, and the forces and the load
are compared. The constants of the soil were fitted to one part of the cycles and are reported on
the other; beside stands what two packings of spheres differ by, on the same surface and action.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array
from scipy import ndimage

from experiments._common.results import main
from wlplan.constants import CELL_SIZE, J_PER_KJ, KG_PER_TONNE
from wlplan.engines.simulator import STOP_REASONS, Cycle, dig, terrain, walls
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.site.machine import WA320
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton import relax
from wlplan.types import Action, Pile, action_from

_FOLDER = Path(__file__).parents[1] / "tests" / "references"
REFERENCE = _FOLDER / "dem_cycles.npz"
"""The cycles that the soil's constants were fitted to."""
HELD_OUT = _FOLDER / "dem_held_out.npz"
"""Cycles on other piles."""

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
    bucket_heaped=3.05,
)
UNITS = {"mass": "t", "time": "s", "work": "kJ"}
_ACTION = [field.name for field in dataclasses.fields(Action)]
# Soil slides in from beyond the local map: it is carried on by this many cells while it does.
_MARGIN = 10
# Forces are compared as means over this time [s], in steps of the simulator's [s].
_SMOOTHED, _STEP = 0.1, 0.02
# They are compared where the edge is in the soil [m] and moves [m/s]: a bucket that stands still is
# pressed on by springs.
_IN_SOIL, _MOVES = 0.2, 0.15
_HELD_OUT_COLOUR, _FITTED_COLOUR, _DEM_COLOUR = "#1f5fa8", "#b9c4d0", "#c8641e"


def load(path: Path, count: int | None = None) -> dict[str, np.ndarray]:
    """The first cycles of a file of references."""
    with np.load(path) as archive:
        names = [str(name) for name in archive["path_names"]]
        cycles = {n: archive[n][:count] for n in archive if archive[n].ndim and n != "path_names"}
    for name in ("h0_cg", "h1_cg"):
        cycles[name] = cycles[name].astype(np.float32) / 1000.0
    record = cycles.pop("path")
    return cycles | {f"path_{name}": record[..., k] for k, name in enumerate(names)}


def surfaces(reference: dict[str, np.ndarray]) -> jax.Array:
    """Surfaces before [m]; the reference's cells lie half a cell further along the heading."""
    return jnp.asarray(ndimage.shift(reference["h0_cg"], (0, 0.5, 0), order=1, mode="nearest"))


def replay(path: Path = REFERENCE, count: int | None = None) -> tuple[dict[str, np.ndarray], Cycle]:
    """A reference's first cycles, and ours on its surfaces, with its actions and machine."""
    reference = load(path, count)
    actions = jnp.asarray(reference["action"], jnp.float32)
    cycle = jax.jit(
        jax.vmap(
            lambda h, a: dig(h, jnp.zeros_like(h), action_from(a), machine=MACHINE, soil=GRAVEL)
        )
    )(surfaces(reference), actions)
    return reference, cycle


def slid(height: Array) -> np.ndarray:
    """Local maps after sliding, on the cells of the reference [m]."""

    def one(surface: Array) -> Array:
        pile = Pile(jnp.pad(surface, _MARGIN, mode="edge"), CELL_SIZE, jnp.zeros(2))
        return relax(pile, repose_angle=GRAVEL.repose_angle).height[
            _MARGIN:-_MARGIN, _MARGIN:-_MARGIN
        ]

    after = np.asarray(jax.jit(jax.vmap(one))(height))
    return np.asarray(ndimage.shift(after, (0, -0.5, 0), order=1, mode="nearest"))


def misplaced(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Volume between two surfaces [m^3]."""
    volume: np.ndarray = np.abs(one - other).sum(axis=(-2, -1)) * CELL_SIZE**2
    return volume


def forces(reference: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Open loop: forces on a bucket that is led along the recorded paths, and on the recorded one.

    Returns:
        `time` [s], `ours_x`, `ours_z`, `theirs_x`, `theirs_z` against travel and downward [kN],
        smoothed, and `compared`, all of shape [steps, cycles]; `load`, ours at the end [tonne].
    """
    names = ("t", "tip_x", "tip_z", "tilt", "speed", "force_x", "force_z")
    rows = [
        np.stack([reference[f"path_{name}"][k] for name in names], axis=-1)
        for k in range(len(reference["mass_t"]))
    ]
    rows = [row[~np.isnan(row[:, 0])] for row in rows]
    steps = [np.arange(row[0, 0], row[-1, 0], _STEP) for row in rows]
    longest = max(map(len, steps))
    track = np.zeros((longest, len(rows), len(names)), np.float32)
    for k, (row, times) in enumerate(zip(rows, steps, strict=True)):
        for column in range(len(names)):
            track[: len(times), k, column] = np.interp(times, row[:, 0], row[:, column])
        track[len(times) :, k] = track[len(times) - 1, k]
    count = np.array([len(times) for times in steps])

    height = terrain.rimmed(jnp.moveaxis(surfaces(reference), 0, -1))
    ground, wanted = jnp.zeros_like(height), jnp.asarray(True)
    fill = jnp.zeros((terrain.Lanes(MACHINE).count, len(rows)))
    path = jnp.asarray(track[:, :, 1:4]).at[:, :, 1].max(0.0)

    @jax.jit
    def lead(height: Array, fill: Array, path: Array) -> tuple[Array, Array, Array]:
        def step(state: tuple[Array, Array, Array], at: Array) -> tuple[Any, Any]:
            height, fill, reach = state
            wall = jnp.full_like(at[:, 0], walls.NOWHERE)
            bucket = terrain.Bucket(at[:, 0], at[:, 1], at[:, 2], wall)
            reached = jnp.maximum(reach, bucket.x)
            height, fill = terrain.move(
                *(MACHINE, GRAVEL, height, fill, ground, bucket, (reach, reached), _STEP, wanted)
            )
            met = terrain.reaction(MACHINE, GRAVEL, height, ground, fill, bucket, wanted)
            return (height, fill, reached), (met.horizontal, met.vertical, met.content_mass)

        loads: tuple[Array, Array, Array]
        _, loads = lax.scan(step, (height, fill, path[0, :, 0]), path)
        return loads

    horizontal, vertical, content = (np.asarray(v) for v in lead(height, fill, path))
    window = round(_SMOOTHED / _STEP)

    def smoothed(values: np.ndarray) -> np.ndarray:
        mean: np.ndarray
        mean = ndimage.uniform_filter1d(values / 1000.0, window, axis=0, mode="nearest")
        return mean

    within = np.arange(longest)[:, None] < count[None]
    return {
        "time": track[:, :, 0],
        "ours_x": smoothed(horizontal),
        "ours_z": smoothed(vertical),
        "theirs_x": smoothed(-track[:, :, 5]),
        "theirs_z": smoothed(-track[:, :, 6]),
        "within": within,
        "compared": within & (track[:, :, 1] > _IN_SOIL) & (track[:, :, 4] > _MOVES),
        "load": content[count - 1, np.arange(len(rows))] / KG_PER_TONNE,
    }


def _rank_correlation(one: np.ndarray, other: np.ndarray) -> float:
    first, second = (np.argsort(np.argsort(values)) for values in (one, other))
    return float(np.corrcoef(first, second)[0, 1])


def agreement(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Bias, rank correlation, and differences relative to the reference, over cycles."""
    return {
        "bias": float(ours.mean() / theirs.mean() - 1.0),
        "bias_of_median": float(np.median(ours) / np.median(theirs) - 1.0),
        "rank_correlation": _rank_correlation(ours, theirs),
        "mean_relative_difference": float(np.abs(ours / theirs - 1.0).mean()),
        "median_relative_difference": float(np.median(np.abs(ours / theirs - 1.0))),
    }


def _compared_forces(led: dict[str, np.ndarray], mass: np.ndarray) -> dict[str, Any]:
    use = led["compared"]
    result: dict[str, Any] = {}
    for axis, word in (("x", "horizontal"), ("z", "vertical")):
        ours, theirs = led[f"ours_{axis}"][use], led[f"theirs_{axis}"][use]
        result[word] = {
            "mean_ours_kN": float(ours.mean()),
            "mean_reference_kN": float(theirs.mean()),
            "rms_difference_kN": float(np.sqrt(((ours - theirs) ** 2).mean())),
            "correlation": float(np.corrcoef(ours, theirs)[0, 1]),
        }
    return result | {"load_at_the_stop": agreement(led["load"], mass)}


def _of_part(path: Path, count: int | None) -> dict[str, Any]:
    reference, cycle = replay(path, count)
    ours = {
        "mass": np.asarray(cycle.mass) / KG_PER_TONNE,
        "time": np.asarray(cycle.time),
        # The reference counts thrust times vehicle speed, boom and bucket, without slip.
        "work": np.asarray(cycle.work_drive + cycle.work_boom + cycle.work_bucket) / J_PER_KJ,
    }
    theirs = {name: reference[f"{name}_{unit}"] for name, unit in UNITS.items()}
    stops = [STOP_REASONS[int(k)] for k in cycle.stop_reason]
    volume = misplaced(slid(cycle.height), reference["h1_cg"])
    first = reference["packing"] == 0
    stalls, their_stalls = (np.array(w) == "timeout" for w in (stops, reference["stop_reason"]))
    return {
        "cycles": len(volume),
        "piles": len(set(reference["pile_id"].tolist())),
        "agreement": {name: agreement(ours[name], theirs[name]) for name in ours},
        # Repeats of one surface and action are no more evidence than one of them.
        "agreement_each_surface_once": {
            name: agreement(ours[name][first], theirs[name][first]) for name in ours
        },
        "misplaced_m3": {"mean": float(volume.mean()), "median": float(np.median(volume))},
        "stalls": {
            "ours": int(stalls.sum()),
            "reference": int(their_stalls.sum()),
            "both": int((stalls & their_stalls).sum()),
        },
        "same_stop_reason": float(np.mean(np.array(stops) == reference["stop_reason"])),
        "forces": _compared_forces(forces(reference), reference["mass_t"]),
        "repeats": _repeats(reference, ours, volume),
        "ours": {name: np.round(value, 4).tolist() for name, value in ours.items()},
        "reference": {name: np.round(value, 4).tolist() for name, value in theirs.items()},
        "misplaced": np.round(volume, 3).tolist(),
        "stop_reason": stops,
        "reference_stop_reason": reference["stop_reason"].tolist(),
    }


def _repeats(
    reference: dict[str, np.ndarray], ours: dict[str, np.ndarray], volume: np.ndarray
) -> dict[str, Any] | None:
    """How two packings of the same surface and action differ, and how we differ from them."""
    alike = [
        (i, j)
        for i, j in itertools.combinations(range(len(volume)), 2)
        if reference["pile_id"][i] == reference["pile_id"][j]
        and reference["packing"][i] != reference["packing"][j]
    ]
    if not alike:
        return None
    i, j = (np.array(side) for side in zip(*alike, strict=True))
    members = np.unique([i, j])
    after = reference["h1_cg"]
    between = float(misplaced(after[i], after[j]).mean())
    return {
        "pairs": len(alike),
        "scatter": _scatter(reference),
        "misplaced_between_packings_m3": between,
        "misplaced_ours_m3": float(volume[members].mean()),
        "ratio": float(volume[members].mean() / between),
        "median_relative_difference_between_packings": {
            name: float(
                np.median(
                    np.abs(reference[f"{name}_{unit}"][i] / reference[f"{name}_{unit}"][j] - 1)
                )
            )
            for name, unit in UNITS.items()
        },
        "median_relative_difference_ours": {
            name: float(np.median(np.abs(ours[name] / reference[f"{name}_{unit}"] - 1.0)[members]))
            for name, unit in UNITS.items()
        },
    }


def _scatter(reference: dict[str, np.ndarray]) -> dict[str, Any]:
    """Deviations and correlations of the logarithms among packings, on surfaces without a stall.

    What `wlplan.worlds.scattered` draws from.
    """
    logarithms = np.log(np.stack([reference[f"{n}_{u}"] for n, u in UNITS.items()], axis=1))
    apart, freedom = [], 0
    for surface in np.unique(reference["pile_id"]):
        members = reference["pile_id"] == surface
        packings = len(np.unique(reference["packing"][members]))
        # Two loadings of one pile are no repeats.
        repeats = (
            packings == members.sum() > 1 and not np.ptp(reference["action"][members], axis=0).any()
        )
        if repeats and not (reference["stop_reason"][members] == "timeout").any():
            apart.append(logarithms[members] - logarithms[members].mean(axis=0))
            freedom += packings - 1
    all_of_them = np.concatenate(apart or [np.zeros((0, len(UNITS)))])
    covariance = all_of_them.T @ all_of_them / max(freedom, 1)
    deviation = np.sqrt(np.diag(covariance))
    return {
        "surfaces": len(apart),
        "cycles": len(all_of_them),
        "deviation": dict(zip(UNITS, deviation.tolist(), strict=True)),
        "correlation": (covariance / np.maximum(np.outer(deviation, deviation), 1e-12)).tolist(),
    }


def _trends(parts: dict[Path, dict[str, Any]], count: int | None) -> dict[str, Any]:
    """What goes with a quick controller: rank correlations over all cycles that do not stall."""
    action = np.concatenate([load(path, count)["action"] for path in parts])
    moves = np.concatenate(
        [
            (np.array(part["stop_reason"]) != "timeout")
            & (np.array(part["reference_stop_reason"]) != "timeout")
            for part in parts.values()
        ]
    )
    result: dict[str, Any] = {"cycles": int(moves.sum())}
    for who in ("ours", "reference"):
        mass, time, work = (
            np.concatenate([part[who][name] for part in parts.values()])[moves] for name in UNITS
        )
        causes = {"time": time, **dict(zip(_ACTION, action[moves].T, strict=True))}
        effects = {"productivity": mass / time, "work_per_tonne": work / mass}
        result[who] = {
            effect: {cause: _rank_correlation(of, by) for cause, by in causes.items()}
            for effect, of in effects.items()
        }
    return result


def run(preset: str) -> dict[str, Any]:
    """Plays the reference's actions on the reference's surfaces with its machine constants."""
    count = 5 if preset == "smoke" else None
    held_out = _of_part(HELD_OUT, count)
    shown = forces(load(HELD_OUT, 1))
    end = int(shown["within"].sum())
    example = {
        name: np.round(shown[name][:end, 0], 3).tolist()
        for name in ("time", "ours_x", "theirs_x", "ours_z", "theirs_z")
    }
    fitted = _of_part(REFERENCE, count)
    trends = _trends({REFERENCE: fitted, HELD_OUT: held_out}, count)
    return {"fitted": fitted, "held_out": held_out, "trends": trends, "example": example}


def draw(folder: Path) -> None:
    """Closed loop cycle by cycle, forces over time of one dig, and misplaced soil."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "dem_reference.json").read_text())
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    axes = figure.subplots(2, 3)
    for axis, (name, unit) in zip(axes[0], UNITS.items(), strict=True):
        drawn = []
        for part, colour, label in (
            ("fitted", _FITTED_COLOUR, "fitted to"),
            ("held_out", _HELD_OUT_COLOUR, "held out"),
        ):
            ours, theirs = result[part]["ours"][name], result[part]["reference"][name]
            axis.plot(theirs, ours, "o", ms=4, color=colour, label=label)
            drawn += [*ours, *theirs]
        axis.plot([min(drawn), max(drawn)], [min(drawn), max(drawn)], color="#999999", lw=1)
        found = result["held_out"]["agreement_each_surface_once"][name]
        axis.set_title(
            f"{name}, held out: bias {100 * found['bias']:+.1f} %, "
            f"ranks {found['rank_correlation']:.2f}",
            fontsize=9,
        )
        axis.set_xlabel(f"discrete elements [{unit}]")
        axis.set_ylabel(f"this simulator [{unit}]")
        axis.set_aspect("equal", adjustable="datalim")
    axes[0, 0].legend(fontsize=8, frameon=False)
    for axis, key, word in zip(axes[1, :2], "xz", ("against travel", "downward"), strict=True):
        example = result["example"]
        axis.plot(example["time"], example[f"theirs_{key}"], color=_DEM_COLOUR, lw=1.2)
        axis.plot(example["time"], example[f"ours_{key}"], color=_HELD_OUT_COLOUR, lw=1.2)
        axis.set_xlabel("time [s]")
        axis.set_ylabel(f"force {word} [kN]")
        axis.set_title("open loop, one dig that was held out", fontsize=9)
    axes[1, 0].legend(["discrete elements", "this simulator"], fontsize=8, frameon=False)
    axis = axes[1, 2]
    for part, colour in (("fitted", _FITTED_COLOUR), ("held_out", _HELD_OUT_COLOUR)):
        masses, volumes = result[part]["reference"]["mass"], result[part]["misplaced"]
        axis.plot(masses, volumes, "o", ms=4, color=colour)
    repeats = result["held_out"]["repeats"]
    if repeats:
        level = repeats["misplaced_between_packings_m3"]
        axis.axhline(level, color=_DEM_COLOUR, lw=1)
        across = axis.get_yaxis_transform()
        axis.text(
            0.97, level - 0.03, "two packings", ha="right", va="top", fontsize=8, transform=across
        )
    axis.set_ylim(bottom=0)
    axis.set_xlabel("load, discrete elements [t]")
    axis.set_ylabel("misplaced soil [m³]")
    write_bytes_atomic(folder / "dem_reference.png", png_bytes(figure))


if __name__ == "__main__":
    main("dem_reference", run, draw)
