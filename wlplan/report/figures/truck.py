"""The truck on a map, or an arrow towards it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from matplotlib import patches
from matplotlib.axes import Axes

from wlplan.report.figures.style import GREEN, INK, PALE
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.polygon import Polygon
from wlplan.site.receiver import Receiver, receiver_for, stands_of, truck_outline

# How far a truck may stand outside the view of the pile to widen it, as a part of the longer side;
# one further away becomes an arrow at the border.
_TRUCK_REACH = 0.75


@dataclasses.dataclass(frozen=True)
class Truck:
    """A truck that stands across the end of the loader's way; corners and points [m]."""

    receiver: Receiver
    name: str = "truck"
    machine: WheelLoader = WA320

    @property
    def ahead(self) -> Float[np.ndarray, "2"]:
        """Unit vector along the loader's heading."""
        heading = float(self.receiver.heading)
        return np.array([math.cos(heading), math.sin(heading)])

    @property
    def stand(self) -> Float[np.ndarray, "2"]:
        """Middle of the loader as it dumps."""
        return np.array([float(self.receiver.x), float(self.receiver.y)])

    @property
    def body(self) -> Float[np.ndarray, "4 2"]:
        """Corners of the body [m]."""
        return self._box(0.0, 1.0, 1.0)

    @property
    def bed(self) -> Float[np.ndarray, "4 2"]:
        """What is loaded: the body without the cab at its left end."""
        return self._box(-0.10, 0.72, 0.84)

    @property
    def cab(self) -> Float[np.ndarray, "4 2"]:
        """What stands before the bed."""
        return self._box(0.385, 0.23, 1.0)

    def _box(self, shift: float, long: float, wide: float) -> Float[np.ndarray, "4 2"]:
        near, far, half = truck_outline(self.machine)
        length, width = 2.0 * half, far - near
        left = np.array([-self.ahead[1], self.ahead[0]])
        centre = self.stand + 0.5 * (near + far) * self.ahead + shift * length * left
        along, across = 0.5 * long * length * left, 0.5 * wide * width * self.ahead
        corners: np.ndarray = centre + np.stack(
            [along + across, along - across, -along - across, across - along]
        )
        return corners

    def is_near(self, view: Float[np.ndarray, "2 2"]) -> bool:
        """Whether it stands near enough to a view to widen it."""
        reach = _TRUCK_REACH * np.ptp(view, axis=0).max()
        return bool(np.all((self.body > view[0] - reach) & (self.body < view[1] + reach)))


def trucks_of(receiver: Receiver) -> list[Truck]:
    """A truck at each of the different places of a receiver."""
    return [Truck(receiver_for(receiver, truck), who) for who, truck in stands_of(receiver)]


def draw_area(panel: Axes, area: tuple[Polygon, ...]) -> None:
    """The outlines of where trucks may stand, and of the holes in it."""
    for ring in (ring for polygon in area for ring in polygon):
        panel.add_patch(
            patches.Polygon(ring, closed=True, fill=False, edgecolor=GREEN, linewidth=1.2, zorder=5)
        )


def draw_truck(panel: Axes, truck: Truck, view: Float[np.ndarray, "2 2"]) -> None:
    """The truck to scale, or, when it stands far outside the view, an arrow towards it."""
    centre = truck.body.mean(axis=0)
    if not np.all((centre > view[0]) & (centre < view[1])):
        middle = view.mean(axis=0)
        away = centre - middle
        reach = float(np.min(0.5 * np.ptp(view, axis=0) / np.maximum(np.abs(away), 1e-9)))
        panel.annotate(
            f"{truck.name}\n{np.hypot(*away):.0f} m",
            xy=tuple(middle + 0.98 * reach * away),
            xytext=tuple(middle + 0.80 * reach * away),
            ha="center",
            va="center",
            fontsize=9,
            color=INK,
            arrowprops={"arrowstyle": "-|>", "color": INK},
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 2.0},
            zorder=10,
        )
        return
    panel.add_patch(
        patches.Polygon(
            truck.body, closed=True, facecolor=INK, edgecolor="white", linewidth=0.8, zorder=6
        )
    )
    panel.add_patch(
        patches.Polygon(truck.bed, closed=True, facecolor=PALE, edgecolor="none", zorder=7)
    )
    # Along the truck, and never upside down.
    turn = math.degrees(math.atan2(*truck.ahead[::-1])) + 90.0
    x, y = truck.bed.mean(axis=0)
    panel.text(
        x,
        y,
        truck.name,
        rotation=(turn + 90.0) % 180.0 - 90.0,
        rotation_mode="anchor",
        ha="center",
        va="center",
        fontsize=8.5,
        color=INK,
        clip_on=True,
        zorder=8,
    )
