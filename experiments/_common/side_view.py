"""A wheel loader from the side: bucket with its load, boom, and what of the machine one expects.

Bucket, boom and pivot are where the machine's own numbers have them. Wheels, frame and cab are for
the eye alone: nothing else in wlplan knows of them.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from wlplan.engines.limits import RETREAT_SPEED
from wlplan.report.figures.style import INK
from wlplan.site.machine import WheelLoader
from wlplan.site.soil import GRAVEL

# For the eye alone [m]: brochure of the class.
_WHEELBASE, _REAR_OVERHANG, _TYRE = 3.03, 1.9, 0.74
_YELLOW, _DARK, _STEEL = "#e3b341", "#3a434d", "#5d6875"
# Back wall of the bucket over its side plates [1], and how far it leans back [rad].
_BACK, _LEAN = 1.1, math.radians(8.0)


@dataclasses.dataclass(frozen=True)
class Stance:
    """Where bucket and boom are in the vertical plane of the heading.

    Attributes:
        tip_x: Cutting edge ahead of the dig location [m].
        tip_z: Cutting edge over the ground there [m].
        tilt: Bucket over level [rad].
        boom: Boom over the horizontal [rad].
        content: Soil in the bucket in that plane [m²].
    """

    tip_x: float
    tip_z: float
    tilt: float
    boom: float
    content: float

    def pin(self, machine: WheelLoader) -> Float[np.ndarray, "2"]:
        """Where the bucket hangs on the boom: x and z [m]."""
        forward, down = machine.tip_arm
        c, s = math.cos(self.tilt), math.sin(self.tilt)
        return np.array([self.tip_x - c * forward - s * down, self.tip_z - s * forward + c * down])

    def pivot(self, machine: WheelLoader) -> Float[np.ndarray, "2"]:
        """Where the boom hangs on the machine: x and z [m]."""
        along = np.array([math.cos(self.boom), math.sin(self.boom)])
        return self.pin(machine) - machine.boom_length * along

    def carried_back(self, machine: WheelLoader, distance: float) -> Stance:
        """The same once the machine has gone back so far [m], the boom on its way to carrying."""
        seconds = distance / machine.travel_speed
        swing = RETREAT_SPEED * machine.boom_speed * seconds
        boom = self.boom + float(np.clip(machine.boom_carry - self.boom, -swing, swing))
        pivot = self.pivot(machine) - np.array([distance, 0.0])
        moved = pivot + machine.boom_length * np.array([math.cos(boom), math.sin(boom)])
        tip = moved + np.array([self.tip_x, self.tip_z]) - self.pin(machine)
        return dataclasses.replace(self, tip_x=float(tip[0]), tip_z=float(tip[1]), boom=boom)


def bucket_inside(stance: Stance, machine: WheelLoader) -> Float[np.ndarray, "3 2"]:
    """Top of the back wall, heel and cutting edge of the bucket: x and z [m]."""
    height = _BACK * machine.side_height
    corners = np.array(
        [
            [-machine.bucket_depth - height * math.sin(_LEAN), height * math.cos(_LEAN)],
            [-machine.bucket_depth, 0.0],
            [0.0, 0.0],
        ]
    )
    c, s = math.cos(stance.tilt), math.sin(stance.tilt)
    turned: np.ndarray = corners @ np.array([[c, s], [-s, c]])
    turned += np.array([stance.tip_x, stance.tip_z])
    return turned


def content_outline(
    inside: Float[np.ndarray, "3 2"], area: float, *, slope: float = GRAVEL.repose_angle
) -> Float[np.ndarray, "n 2"]:
    """The soil in a bucket: its walls below, a heap of an angle of repose above.

    The simulator knows how much lies in the bucket and not how; a heap whose ridge lies over the
    middle of the bucket is how a load looks once it rests. What is more than that runs over.

    Args:
        inside: Of the bucket, see `bucket_inside`.
        area: Of the soil [m²].
        slope: Of the heap [rad].
    """
    x = np.linspace(inside[0, 0], inside[2, 0], 201)
    floor = np.interp(x, inside[:, 0], inside[:, 1])
    ridge = 0.5 * (inside[0, 0] + inside[2, 0])
    low, high = float(inside[:, 1].min()), float(inside[:, 1].max()) + 4.0
    # The area under the heap grows with its height: halve the interval.
    for _ in range(50):
        top = 0.5 * (low + high)
        over = np.maximum(top - math.tan(slope) * np.abs(x - ridge) - floor, 0.0)
        low, high = (top, high) if np.trapezoid(over, x) < area else (low, top)
    surface = floor + np.maximum(high - math.tan(slope) * np.abs(x - ridge) - floor, 0.0)
    return np.concatenate([np.stack([x, surface], axis=1), np.stack([x, floor], axis=1)[::-1]])


def draw_loader(panel: Axes, stance: Stance, machine: WheelLoader, *, soil: str) -> None:
    """The machine, with what lies in its bucket in the colour of the soil."""
    pin, pivot = stance.pin(machine), stance.pivot(machine)
    # The front of the outline is the cutting edge of the lowered bucket.
    forward, _ = machine.tip_arm
    edge = pivot[0] + machine.boom_length * math.cos(machine.boom_low) + forward
    rear = edge - machine.length
    ground = pivot[1] - machine.pivot_height
    front_axle = rear + _REAR_OVERHANG + _WHEELBASE

    def shape(points: list[tuple[float, float]], colour: str, order: int) -> None:
        moved = np.array(points) + np.array([0.0, ground])
        panel.add_patch(Polygon(moved, facecolor=colour, edgecolor=INK, lw=0.5, zorder=order))

    joint = front_axle - 0.5 * _WHEELBASE
    # Engine hood and rear frame, cab, front frame up to the pivot.
    hood = [(rear, 0.9), (rear + 0.1, 1.9), (joint - 0.5, 2.05), (joint, 1.1), (joint, 0.65)]
    shape([*hood, (rear + 0.3, 0.6)], _YELLOW, 3)
    cab = [(joint - 0.75, 1.7), (joint - 0.6, 3.1), (joint + 0.55, 3.1), (joint + 0.75, 1.7)]
    shape([*cab, (joint + 0.55, 1.2), (joint - 0.45, 1.2)], "#cfdbe4", 2)
    front = [(joint, 0.65), (joint + 0.1, 1.2), (pivot[0] - 0.25, machine.pivot_height + 0.15)]
    front += [(pivot[0] + 0.2, machine.pivot_height + 0.1), (front_axle + 0.5, 0.6)]
    shape(front, _YELLOW, 3)
    for axle in (rear + _REAR_OVERHANG, front_axle):
        for radius, colour in ((_TYRE, _DARK), (0.42 * _TYRE, _YELLOW)):
            panel.add_patch(
                Circle(
                    (axle, ground + _TYRE),
                    radius,
                    facecolor=colour,
                    edgecolor=INK,
                    lw=0.5,
                    zorder=4,
                )
            )
    for width, colour in ((5.0, INK), (3.8, _YELLOW)):
        panel.plot(*np.stack([pivot, pin], axis=1), color=colour, lw=width, zorder=5)
    inside = bucket_inside(stance, machine)
    if stance.content > 0.0:
        heap = content_outline(inside, stance.content)
        panel.add_patch(Polygon(heap, facecolor=soil, edgecolor=INK, lw=0.4, zorder=6))
    # From the pin to the back of the bucket, and the bucket itself.
    panel.plot(*np.stack([inside[0], pin, inside[1]], axis=1), color=_STEEL, lw=1.6, zorder=6)
    panel.plot(*inside.T, color=INK, lw=2.0, solid_joinstyle="round", zorder=7)
