"""Loading cycles simulated by the discrete-element engine: the recipe of a reference data set.

Piles are planes, cones and wedges of 20 to 30 degrees with low bumps; each is dug twice, the second
time where the first loading left its toe. With `--lane ridge` each is dug once, over a ridge that
lies in the approach lane, and with `--lane free` by the same actions without it. Every cycle is
drawn from the seed and its own number, so a file that was begun is gone on with, and grows by one
cycle at a time.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.dem_reference import MACHINE
from wlplan.constants import ACTION_HIGH, ACTION_LOW, J_PER_KJ, KG_PER_TONNE
from wlplan.engines.dem import columns, process
from wlplan.engines.dem.cycle import CycleRecord
from wlplan.engines.dem.grains import DemSettings
from wlplan.engines.dem.loader import RECORDED
from wlplan.errors import InputError
from wlplan.io import write_bytes_atomic
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL

MACHINES = {"reference": MACHINE, "wa320": WA320}
"""Machines by name: "reference" has the constants of the cycles in tests/references."""
SHAPES = ("plane", "cone", "wedge")
# Ranges of the slope and of the direction of the pile's face [rad] and of the bumps [m].
_SLOPE = (math.radians(20.0), math.radians(30.0))
_INCIDENCE = (math.radians(-10.0), math.radians(10.0))
_BUMPS = (0.03, 0.15)
# Radius of the cone's foot, the ridge's fall to its sides in parts of its slope, highest pile [m].
_CONE, _RIDGE, _HIGHEST = 5.0, 0.35, 2.75
# Cosine waves that the bumps consist of, the spread of their wave numbers [1/m], and the height
# over the floor at which they have their full size [m].
_WAVES, _WAVE_NUMBER, _FULL = 6, 1.6, 0.5
# The second loading begins this far before the pile is as high as a toe, on average over the
# bucket's width [m].
_BEFORE_TOE, _TOE = 0.15, 0.15
LANES = ("short", "ridge", "free")
"""What the cycles have of the approach lane: its end, all of it with a ridge, or all of it free."""
# Rows of a map that reaches back to where the approach begins.
_LANE_ROWS = 126
# Ridges: height and length [m], slope of their sides [rad], direction against across the lane
# [rad], and distance of the crest before the dig location and of the foot from its other end [m].
_RIDGE_HEIGHT, _RIDGE_LENGTH = (0.2, 0.6), (1.5, 4.0)
_RIDGE_SLOPE, _RIDGE_TURN = math.radians(28.0), math.radians(60.0)
_RIDGE_NEAREST, _LANE_END = 1.0, 4.6
# Maps are saved as multiples of this [m].
_UNIT = 1e-3
# Longest record of a cycle that is saved, in rows of 0.04 s.
_ROWS = 640


def seed_surface(
    rng: np.random.Generator, shape: str, rows: int = columns.CELLS
) -> tuple[np.ndarray, dict[str, float]]:
    """A pile in the frame of its dig location on the grid of `wlplan.engines.dem.columns`.

    Args:
        rng: Source of its slope, direction and bumps.
        shape: One of `SHAPES`.
        rows: Of the map.

    Returns:
        Heights [m], and what was drawn: slope and incidence [degree], bumps [m].
    """
    slope, incidence = rng.uniform(*_SLOPE), rng.uniform(*_INCIDENCE)
    bumps = rng.uniform(*_BUMPS)
    x, y = np.meshgrid(*columns.axes(rows), indexing="ij")
    ahead = x * math.cos(incidence) + y * math.sin(incidence)
    aside = -x * math.sin(incidence) + y * math.cos(incidence)
    if shape == "cone":
        ahead = _CONE - np.hypot(ahead - _CONE, aside)
    elif shape == "wedge":
        ahead = ahead - _RIDGE * np.abs(aside)
    height = math.tan(slope) * ahead
    waves = np.zeros_like(height)
    for _ in range(_WAVES):
        kx, ky = rng.normal(0.0, _WAVE_NUMBER, 2)
        waves += np.cos(kx * x + ky * y + rng.uniform(0.0, 2.0 * math.pi))
    waves *= bumps / math.sqrt(_WAVES / 2.0) * np.clip(height / _FULL, 0.0, 1.0)
    drawn = {
        "slope_deg": math.degrees(slope),
        "incidence_deg": math.degrees(incidence),
        "bumps_m": bumps,
    }
    return np.clip(height + waves, 0.0, _HIGHEST), drawn


def ridge(rng: np.random.Generator) -> tuple[np.ndarray, dict[str, float]]:
    """A ridge of soil in the approach lane, on a level floor.

    Args:
        rng: Source of its height, length, direction and place.

    Returns:
        Heights on the grid of `wlplan.engines.dem.columns` with the rows of the lane [m], and what
        was drawn: height, length, distance and offset to the left [m], turn [degree].
    """
    high, length = rng.uniform(*_RIDGE_HEIGHT), rng.uniform(*_RIDGE_LENGTH)
    turn, left = rng.uniform(-_RIDGE_TURN, _RIDGE_TURN), rng.uniform(-0.7, 0.7)
    foot = high / math.tan(_RIDGE_SLOPE)
    before = rng.uniform(_RIDGE_NEAREST, _LANE_END - foot)
    x, y = np.meshgrid(*columns.axes(_LANE_ROWS), indexing="ij")
    across = math.cos(turn) * (x + before) + math.sin(turn) * (y - left)
    along = -math.sin(turn) * (x + before) + math.cos(turn) * (y - left)
    # It ends as steeply as its sides.
    away = np.hypot(across, np.maximum(np.abs(along) - 0.5 * length, 0.0))
    drawn = {
        "ridge_m": high,
        "ridge_length_m": length,
        "ridge_before_m": before,
        "ridge_left_m": left,
        "ridge_turn_deg": math.degrees(turn),
    }
    return np.maximum(high - math.tan(_RIDGE_SLOPE) * away, 0.0), drawn


def at_new_toe(height: np.ndarray, width: float) -> np.ndarray:
    """The same pile in the frame of a dig location at the toe that is there now.

    Args:
        height: Heights on the grid of `wlplan.engines.dem.columns` [m].
        width: Of the bucket [m].
    """
    x, y = columns.axes()
    profile = height[:, np.abs(y) < 0.5 * width].mean(axis=1)
    fine = np.arange(-1.0, 3.0, 0.05)
    high = np.interp(fine, x, profile) > _TOE
    toe = float(fine[np.argmax(high)]) - _BEFORE_TOE
    moved = np.stack([np.interp(x + toe, x, column) for column in height.T], axis=1)
    # Spill behind the dig location is not part of the pile.
    return np.where(x[:, None] < -0.5, 0.0, moved)


def action_of(rng: np.random.Generator) -> np.ndarray:
    """A random action in its box."""
    return rng.uniform(ACTION_LOW, ACTION_HIGH)


def next_cycle(
    seed: int, number: int, repeats: int, done: Sequence[dict[str, Any]], lane: str = "short"
) -> tuple[np.ndarray, np.ndarray, int, dict[str, Any]]:
    """Surface, action, packing and origin of a cycle.

    Args:
        seed: Of the whole file.
        number: Of the cycle.
        repeats: 0 for two loadings of each pile; otherwise every first loading is simulated with so
            many packings.
        done: Rows of the cycles before.
        lane: One of `LANES`; unless it is "short", every pile is loaded from once.
    """
    if lane != "short":
        return _lane_cycle(seed, number, lane == "ridge")
    each = repeats or 2
    pile, turn = divmod(number, each)
    rng = np.random.default_rng([seed, pile])
    shape = SHAPES[pile % len(SHAPES)]
    surface, drawn = seed_surface(rng, shape)
    actions = [action_of(rng) for _ in range(2)]
    if repeats:
        action, packing, turn_in_pile = actions[0], turn, 0
    else:
        # Another packing for every cycle, or scatter would be mistaken for effects.
        action, packing, turn_in_pile = actions[turn], number, turn
        if turn:
            surface = at_new_toe(done[-1]["h1_cg"] * _UNIT, WA320.bucket_width)
    origin = {
        **drawn,
        "pile_id": f"{seed}-{pile}",
        "cycle_in_pile": turn_in_pile,
        "packing": packing,
        "shape": shape,
    }
    return surface, action, packing, origin


def _lane_cycle(
    seed: int, number: int, is_there: bool
) -> tuple[np.ndarray, np.ndarray, int, dict[str, Any]]:
    """As `next_cycle`, with all of the approach lane; the same cycle with and without its ridge."""
    rng = np.random.default_rng([seed, number])
    shape = SHAPES[number % len(SHAPES)]
    surface, drawn = seed_surface(rng, shape, _LANE_ROWS)
    action = action_of(rng)
    heap, of_ridge = ridge(rng)
    origin = {
        **drawn,
        **of_ridge,
        "pile_id": f"{seed}-{number}",
        "cycle_in_pile": 0,
        "packing": number,
        "shape": shape,
    }
    return np.maximum(surface, heap) if is_there else surface, action, number, origin


def row_of(cycle: CycleRecord, action: np.ndarray, origin: dict[str, Any]) -> dict[str, Any]:
    """What the file says of one cycle."""

    def small(height: np.ndarray) -> np.ndarray:
        return np.round(height / _UNIT).astype(np.int16)

    record = np.full((_ROWS, len(RECORDED)), np.nan, np.float32)
    record[: len(cycle.record)] = cycle.record[:_ROWS]
    works = np.array([cycle.work_drive, cycle.work_boom, cycle.work_bucket, cycle.work_slip])
    return {
        "h0": small(cycle.envelope_before),
        "h1": small(cycle.envelope_after),
        "h0_cg": small(cycle.before),
        "h1_cg": small(cycle.after),
        "action": action,
        "mass_t": cycle.mass / KG_PER_TONNE,
        "time_s": cycle.time,
        "work_kJ": works[:3].sum() / J_PER_KJ,
        "work_with_slip_kJ": works.sum() / J_PER_KJ,
        "work_parts_kJ": works / J_PER_KJ,
        "fill_time_s": cycle.fill_time,
        "stop_reason": cycle.stop_reason,
        "tip_at_stop": np.array([cycle.tip_x, cycle.tip_z]),
        "cleared_t": cycle.cleared * GRAVEL.density / KG_PER_TONNE,
        "lost_t": cycle.lost * GRAVEL.density / KG_PER_TONNE,
        "spheres": cycle.spheres,
        "traj": record,
        **origin,
    }


def read_rows(path: Path, recipe: dict[str, Any]) -> list[dict[str, Any]]:
    """Cycles that a file has already.

    Raises:
        InputError: If it was begun with another recipe or cannot be read.
    """
    if not path.exists():
        return []
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            columns_of = {name: archive[name] for name in archive}
        begun = json.loads(str(columns_of["recipe"]))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: cannot be read as cycles ({error}): name another file."
        ) from error
    if begun != recipe:
        raise InputError(
            f"{path}: was begun with another seed, machine or number of repeats: name another "
            f"file, or give the same options."
        )
    count = len(columns_of["mass_t"])
    rows = {name: values for name, values in columns_of.items() if name not in _CONSTANT}
    rows["traj"] = _padded(rows["traj"])
    return [{name: values[n] for name, values in rows.items()} for n in range(count)]


_CONSTANT = ("recipe", "unit_m", "grid_x", "grid_y", "action_names", "traj_names", "parts_names")


def _padded(records: np.ndarray) -> np.ndarray:
    width = ((0, 0), (0, _ROWS - records.shape[1]), (0, 0))
    return np.pad(records, width, constant_values=np.nan)


def write_rows(path: Path, rows: Sequence[dict[str, Any]], recipe: dict[str, Any]) -> None:
    """Writes all cycles as one compressed file, in one piece or not at all."""
    fields = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    longest = int((~np.isnan(fields["traj"][:, :, 0])).sum(axis=1).max())
    fields["traj"] = fields["traj"][:, :longest]
    x, y = columns.axes(fields["h0"].shape[1])
    content = io.BytesIO()
    np.savez_compressed(
        content,
        allow_pickle=False,
        **fields,
        recipe=json.dumps(recipe),
        unit_m=_UNIT,
        grid_x=x,
        grid_y=y,
        action_names=np.array(["delta_bm", "k_bm", "delta_bk", "k_bk"]),
        traj_names=np.array(RECORDED),
        parts_names=np.array(["drive", "boom", "bucket", "slip"]),
    )
    write_bytes_atomic(path, content.getvalue())


def collect(
    path: Path, *, seed: int, cycles: int, repeats: int, machine: str, lane: str = "short"
) -> int:
    """Simulates cycles until a file has as many as are wanted; a line on stderr for each.

    Args:
        path: File to begin or to go on with.
        seed: Of the piles and the actions.
        cycles: How many the file shall have.
        repeats: As of `next_cycle`.
        machine: A name of `MACHINES`.
        lane: One of `LANES`.

    Returns:
        How many were simulated.

    Raises:
        InputError: If the engine is missing or fails; what was simulated is in the file.
    """
    digs: WheelLoader = MACHINES[machine]
    recipe = {"seed": seed, "repeats": repeats, "machine": dataclasses.asdict(digs)}
    if lane != "short":
        recipe["lane"] = lane
    rows = read_rows(path, recipe)
    begun = len(rows)
    for number in range(begun, cycles):
        surface, action, packing, origin = next_cycle(seed, number, repeats, rows, lane)
        cycle = process.play(
            surface, action, machine=digs, soil=GRAVEL, settings=DemSettings(packing=packing)
        )
        rows.append(row_of(cycle, action, origin))
        write_rows(path, rows, recipe)
        row = rows[-1]
        sys.stderr.write(
            f"cycle {number + 1}/{cycles}: {row['mass_t']:.2f} t, {row['time_s']:.2f} s, "
            f"{row['work_kJ']:.0f} kJ, {row['stop_reason']}\n"
        )
    return len(rows) - begun


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; exit code 0, or 2 with one line on stderr."""
    parser = argparse.ArgumentParser(prog="python -m experiments.dem_cycles")
    parser.add_argument("--out", type=Path, required=True, help=".npz file; gone on with if there")
    parser.add_argument("--seed", type=int, default=0, help="of the piles and the actions")
    parser.add_argument("--cycles", type=int, default=10, help="cycles the file shall have")
    parser.add_argument(
        "--repeats",
        type=int,
        default=0,
        help="packings in which each pile and action is simulated, instead of two loadings a pile",
    )
    parser.add_argument(
        "--lane",
        choices=LANES,
        default="short",
        help="what the cycles have of the approach lane; with `ridge` and `free`, all of it",
    )
    parser.add_argument("--machine", choices=MACHINES, default="reference", help="what digs")
    options = parser.parse_args(arguments)
    try:
        collect(
            options.out,
            seed=options.seed,
            cycles=options.cycles,
            repeats=max(options.repeats, 0),
            machine=options.machine,
            lane=options.lane,
        )
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
