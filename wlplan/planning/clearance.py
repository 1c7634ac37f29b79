"""How near the outline of a loader comes to what it must not touch, exactly, on the host."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from wlplan.planning.lane import LANE_END
from wlplan.site.machine import WheelLoader
from wlplan.site.receiver import truck_outline
from wlplan.types import Pile

# Obstacles further from a place than this are not looked at [m], so no clearance is larger.
FARTHEST = 5.0


def clearance(
    points: Float[np.ndarray, "n 4"],
    dig: Float[np.ndarray, "3"],
    blocked: Bool[np.ndarray, "nx ny"],
    pile: Pile,
    receiver: Float[np.ndarray, "3"],
    machine: WheelLoader,
) -> float:
    """Least distance from the outline to anything on the way and in the approach lane [m].

    Negative where the outline is in something, by how deep; at most `FARTHEST`. In the lane the
    pile ahead does not count.

    Args:
        points: Of the way, as of `points_of`.
        dig: x [m], y [m] and heading [rad] of the dig pose.
        blocked: Cells that must not be touched, on the grid of a pile.
        pile: With that grid.
        receiver: x [m], y [m] and heading [rad].
        machine: What drives.
    """
    half_cell = 0.5 * pile.cell_size
    half, side = 0.5 * machine.length, 0.5 * machine.bucket_width
    back = -machine.approach_distance - half
    least = way_clearance(points, blocked, pile, receiver, machine)
    cells, truck = _places(blocked, pile), _truck(receiver, pile.cell_size, machine)
    for others, width in ((cells, half_cell), (truck, 0.0)):
        ahead, _ = _to_frame(dig, others).T
        behind = others[ahead <= -LANE_END - half_cell]
        least = min(least, _distance(dig, behind, back, -LANE_END, side) - width)
    return least


def way_clearance(
    points: Float[np.ndarray, "n 4"],
    blocked: Bool[np.ndarray, "nx ny"],
    pile: Pile,
    receiver: Float[np.ndarray, "3"],
    machine: WheelLoader,
) -> float:
    """Least distance from the outline to anything on the way alone, as `clearance` [m]."""
    half, side = 0.5 * machine.length, 0.5 * machine.bucket_width
    cells, truck = _places(blocked, pile), _truck(receiver, pile.cell_size, machine)
    reach = half + side + FARTHEST
    low, high = points[:, :2].min(axis=0) - reach, points[:, :2].max(axis=0) + reach
    near = cells[((cells >= low) & (cells <= high)).all(axis=1)]
    least = FARTHEST
    for place in points[:, :3]:
        least = min(least, _distance(place, near, -half, half, side) - 0.5 * pile.cell_size)
        # The raised bucket reaches over the truck.
        least = min(least, _distance(place, truck, -half, half - machine.overhang, side))
    return least


def _places(blocked: Bool[np.ndarray, "nx ny"], pile: Pile) -> Float[np.ndarray, "k 2"]:
    """The middles of cells [m]."""
    places: np.ndarray = np.argwhere(blocked) * pile.cell_size + np.asarray(pile.origin, float)
    return places


def _truck(
    receiver: Float[np.ndarray, "3"], spacing: float, machine: WheelLoader
) -> Float[np.ndarray, "k 2"]:
    """Places all over the truck [m]."""
    near, far, along = truck_outline(machine)
    spread = np.meshgrid(
        np.linspace(near, far, 2 + int((far - near) / spacing)),
        np.linspace(-along, along, 2 + int(2.0 * along / spacing)),
        indexing="ij",
    )
    return _from_frame(receiver, np.stack([axis.ravel() for axis in spread], axis=-1))


def _distance(
    place: Float[np.ndarray, "3"],
    points: Float[np.ndarray, "n 2"],
    rear: float,
    front: float,
    side: float,
) -> float:
    """Distance from a rectangle to the nearest of some points, negative inside it [m]."""
    if not len(points):
        return np.inf
    ahead, left = _to_frame(place, points).T
    over = np.stack([np.maximum(rear - ahead, ahead - front), np.abs(left) - side])
    apart = np.hypot(*np.maximum(over, 0.0)) + np.minimum(over.max(axis=0), 0.0)
    return float(apart.min())


def _to_frame(
    place: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    c, s = np.cos(place[2]), np.sin(place[2])
    turned: np.ndarray = (points - place[:2]) @ np.array([[c, -s], [s, c]])
    return turned


def _from_frame(
    place: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    c, s = np.cos(place[2]), np.sin(place[2])
    turned: np.ndarray = place[:2] + points @ np.array([[c, s], [-s, c]])
    return turned
