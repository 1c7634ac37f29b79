"""One loading cycle among spheres: cut, rest, dig, rest again."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from wlplan.constants import CELL_SIZE, J_PER_KJ
from wlplan.engines.dem import columns
from wlplan.engines.dem.bucket import PLATE_RADIUS, plate_spheres, section_of
from wlplan.engines.dem.engine import Engine, open_box
from wlplan.engines.dem.grains import DemSettings
from wlplan.engines.dem.loader import FREE, RECORDED, START, BucketForce, Loader
from wlplan.engines.dem.packing import Bed, Walls, cut, in_lane
from wlplan.site.machine import WheelLoader
from wlplan.site.soil import Soil

# Time between two steps of the machine [s]: ten of the engine's, at gravel and the usual grain.
_CONTROL = 4e-3
# Rest after cutting and after digging: time with drag, drag [N s/m], time without.
_AFTER_CUT, _AFTER_DIG, _DRAG = (0.15, 0.35), (0.02, 0.60), 60.0
# What counts as in the bucket, in its own frame: from a little behind its back to a pile over its
# edge, above its floor, and a little beyond the sides [m].
_BACK, _FRONT, _FLOOR, _SIDE = 0.13, 0.60, -0.02, 0.15
# Least height of a sphere in the raised bucket, over the bucket's lowest point [m].
_LIFTED = -0.05
# Time between two rows of the record [s].
_RECORDED_EVERY = 0.04


@dataclasses.dataclass(frozen=True)
class CycleRecord:
    """The outcome of one cycle, SI units; maps are on the grid of `columns`."""

    mass: float  # in the bucket [kg]
    time: float  # from start to end position [s]
    work_drive: float  # thrust times vehicle speed [J]
    work_boom: float
    work_bucket: float
    work_slip: float  # thrust times slip speed of the wheels [J]
    fill_time: float  # from the dig location to the stop [s]
    stop_reason: str
    tip_x: float  # cutting edge at the stop [m]
    tip_z: float
    spheres: int  # of soil
    cleared: float  # bulk volume that lay in the bucket's way and was taken out before [m^3]
    lost: float  # bulk volume that flew out of the domain [m^3]
    before: np.ndarray  # column heights at rest, before the cycle [m]
    after: np.ndarray  # and after it
    envelope_before: np.ndarray  # upper surface likewise
    envelope_after: np.ndarray
    record: np.ndarray  # rows of `loader.RECORDED`

    def as_dict(self) -> dict[str, Any]:
        """What plan.json says of a cycle: SI units, but for the work of the wheels' slip [kJ]."""
        return {
            "stop_reason": self.stop_reason,
            "slip_work": self.work_slip / J_PER_KJ,
            "spheres": self.spheres,
            "cleared_volume": self.cleared,
            "lost_volume": self.lost,
        }


def play_cycle(
    bed: Bed,
    surface: np.ndarray,
    action: np.ndarray,
    *,
    machine: WheelLoader,
    soil: Soil,
    settings: DemSettings,
    walls: Walls,
) -> CycleRecord:
    """Plays one cycle.

    Args:
        bed: What the pile is cut from.
        surface: Height of the soil over a level floor on a grid of `columns` [m]. The more rows it
            has, the further behind the dig location the bucket enters.
        action: delta_bm, k_bm, delta_bk, k_bk.
        machine: What digs.
        soil: What is dug: its density, and its friction on steel.
        settings: Of the engine.
        walls: Where the domain ends.

    Raises:
        InputError: If the engine is missing, or the machine's bucket cannot be built.
    """
    density = soil.density / bed.packing
    step = settings.time_step(soil.density)
    plates = plate_spheres(machine)
    rows = len(surface)
    enters = START - columns.further(rows)
    box = _space(machine, plates, walls, enters)
    rest = _Rest(settings, walls, box, density, step)
    centre, radius = rest(*cut(bed, surface, walls, settings.packing), *_AFTER_CUT)
    blocked = in_lane(centre, machine.bucket_width, rows)
    bulk = 4.0 / 3.0 * math.pi / bed.packing
    cleared = bulk * float((radius[blocked] ** 3).sum())
    centre, radius = centre[~blocked], radius[~blocked]
    before = columns.column_height(centre, radius, bed.packing, rows)
    seen_before = columns.envelope(centre, radius, rows)

    # The machine moves once in about 4 ms, however long the engine's steps are.
    steps = max(5, 5 * round(_CONTROL / step / 5.0))
    x, _ = columns.axes(rows)
    profile = columns.centre_line(seen_before)

    def surface_at(along: float) -> float:
        return float(np.interp(along, x, profile))

    loader = Loader(machine, action, surface_at, steps * step, enters)
    start = loader.linkage.points(loader.position, loader.boom, loader.tilt, plates)
    with Engine(
        np.concatenate([centre, start]),
        np.concatenate([radius, np.full(len(plates), PLATE_RADIUS)]),
        plates=len(plates),
        density=density,
        grains=settings.grains,
        box=box,
        step=step,
        bucket_friction=math.tan(soil.steel_friction),
    ) as engine:
        engine.wall_in(walls)
        engine.hold_bucket(steps)
        record = _dig(engine, loader, plates)
        after, after_radius, mass = engine.grains_now()
    loaded = _in_bucket(machine, loader, plates, after)
    load = float(mass[loaded].sum())
    loader.retreat(load)
    left, left_radius = rest(after[~loaded], after_radius[~loaded], *_AFTER_DIG)
    lost = bulk * float((radius**3).sum() - (left_radius**3).sum()) - load / soil.density
    return CycleRecord(
        mass=load,
        time=loader.time,
        work_drive=loader.work_drive,
        work_boom=loader.work_boom,
        work_bucket=loader.work_bucket,
        work_slip=loader.work_slip,
        fill_time=loader.stop_time - loader.dig_time,
        stop_reason=loader.stop_reason,
        tip_x=loader.stop_tip[0],
        tip_z=loader.stop_tip[1],
        spheres=len(radius),
        cleared=cleared,
        lost=lost,
        before=before,
        after=columns.column_height(left, left_radius, bed.packing, rows),
        envelope_before=seen_before,
        envelope_after=columns.envelope(left, left_radius, rows),
        record=record,
    )


def _space(
    machine: WheelLoader, plates: np.ndarray, walls: Walls, enters: float = START
) -> np.ndarray:
    """Space in which the bucket stays, wherever it is turned to, with a metre around it [m]."""
    reach = float(np.hypot(plates[:, 0], plates[:, 2]).max()) + machine.tip_radius
    top = machine.pivot_height + machine.boom_length + reach
    return open_box(walls, min(FREE, enters) - reach - 1.0, top + 1.0)


def _dig(engine: Engine, loader: Loader, plates: np.ndarray) -> np.ndarray:
    """Steps machine and soil until the bucket is free; the record of the way."""
    rows: list[tuple[float, ...]] = []
    force = np.zeros(3)
    while not loader.is_free:
        place = (loader.position, loader.boom, loader.tilt)
        pin_x, pin_z = loader.linkage.pin(*place[:2])
        # The moment about the pin instead of that about the origin.
        moment = force[2] - (pin_x * force[1] - pin_z * force[0])
        loader.advance(BucketForce(float(force[0]), float(force[1]), float(moment)))
        if not rows or loader.record[0] - rows[-1][0] > _RECORDED_EVERY:
            rows.append(loader.record)
        centre = loader.linkage.points(*place, plates)
        boom, tilt = loader.boom_rate, loader.tilt_rate
        length = loader.machine.boom_length
        velocity = np.zeros_like(centre)
        velocity[:, 0] = loader.speed - length * math.sin(loader.boom) * boom
        velocity[:, 0] -= tilt * (centre[:, 2] - pin_z)
        velocity[:, 2] = length * math.cos(loader.boom) * boom + tilt * (centre[:, 0] - pin_x)
        force = engine.drag_bucket(centre, velocity)
        loader.move()
    return np.array(rows).reshape(-1, len(RECORDED))


def _in_bucket(
    machine: WheelLoader, loader: Loader, plates: np.ndarray, centre: np.ndarray
) -> np.ndarray:
    """Which spheres lie in the raised bucket."""
    place = (loader.position, loader.boom, loader.tilt)
    local = loader.linkage.in_bucket(*place, centre)
    section = section_of(machine)
    lowest = loader.linkage.points(*place, plates)[:, 2].min()
    within: np.ndarray = (local[:, 0] > section[:, 0].min() - _BACK) & (local[:, 0] < _FRONT)
    within &= (local[:, 2] > _FLOOR) & (centre[:, 2] > lowest + _LIFTED)
    within &= np.abs(local[:, 1]) < 0.5 * machine.bucket_width + _SIDE
    return within


class _Rest:
    """Lets spheres come to rest without a bucket.

    Args:
        settings: Of the engine.
        walls: Where the domain ends.
        box: Space that the spheres may fly in [m], shape [3, 2].
        density: Of the spheres themselves [kg/m^3].
        step: Time step [s].
    """

    def __init__(
        self, settings: DemSettings, walls: Walls, box: np.ndarray, density: float, step: float
    ):
        self._settings, self._walls, self._box = settings, walls, box
        self._density, self._step = density, step

    def __call__(
        self, centre: np.ndarray, radius: np.ndarray, dragged: float, free: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Centres and radii afterwards, less those that flew away.

        Args:
            centre: Centres [m], shape [n, 3].
            radius: Radii [m], shape [n].
            dragged: Time with drag [s].
            free: Time without, after it [s].
        """
        if not len(radius):
            return centre, radius
        with Engine(
            centre,
            radius,
            density=self._density,
            grains=self._settings.grains,
            box=self._box,
            step=self._step,
        ) as engine:
            engine.wall_in(self._walls)
            engine.run(dragged, drag=_DRAG)
            engine.run(free)
            after, after_radius, _ = engine.grains_now()
        return after, after_radius


def change_of(cycle: CycleRecord, density: float) -> np.ndarray:
    """What a cycle changes of the column heights, so that what leaves the pile is the load [m].

    Spheres that flew away are put back: losses are scaled, by a factor close to one.

    Args:
        cycle: The cycle.
        density: Bulk density [kg/m^3].
    """
    change = cycle.after.astype(np.float64) - cycle.before
    gain, loss = np.maximum(change, 0.0), np.maximum(-change, 0.0)
    volume = cycle.mass / density / CELL_SIZE**2
    wanted = volume + gain.sum()
    balanced: np.ndarray = gain - loss * (wanted / loss.sum() if loss.sum() > 0.0 else 0.0)
    return balanced
