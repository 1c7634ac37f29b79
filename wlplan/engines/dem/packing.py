"""Piles cut out of a settled bed of spheres."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.ndimage import map_coordinates

from wlplan.engines.dem import columns


@dataclasses.dataclass(frozen=True)
class Walls:
    """Where the domain ends: a wall ahead and one on either side; it is open behind [m]."""

    ahead: float = 6.2
    right: float = -3.1
    left: float = 3.1


@dataclasses.dataclass(frozen=True)
class Bed:
    """Spheres at rest on a floor, periodic in x and y.

    Attributes:
        centre: Centres [m], shape [n, 3]; x and y from 0 to the lengths.
        radius: Radii [m], shape [n].
        lengths: Periods along x and y [m], shape [2].
        packing: Part of the bulk volume that is solid.
    """

    centre: np.ndarray
    radius: np.ndarray
    lengths: np.ndarray
    packing: float

    @property
    def top(self) -> float:
        """Height up to which the bed is filled everywhere [m]."""
        volume = 4.0 / 3.0 * np.pi * (self.radius**3).sum()
        return float(volume / self.packing / self.lengths.prod()) - 0.5 * float(self.radius.max())


# The domain begins here, behind the bucket [m]; behind that of a map with more rows likewise.
BEHIND = -1.9
# The lane in which the bucket starts: it ends here [m], and is this much wider than the bucket on
# either side. Soil in it would overlap the bucket.
_LANE_END, _LANE_MARGIN = -0.5, 0.15
# A layer thinner than this, in mean radii, holds no spheres.
_THIN = 0.5
# Spheres whose centres lie this far over a level, in mean radii, have the volume below it.
_LIFT = 0.2


def cut(bed: Bed, surface: np.ndarray, walls: Walls, packing: int) -> tuple[np.ndarray, np.ndarray]:
    """The spheres of a bed that lie below a surface.

    Args:
        bed: Bed to cut from.
        surface: Height of the soil over the floor on a grid of `columns` [m].
        walls: Where the domain ends.
        packing: Which part of the bed the spheres come from, and whether it is mirrored.

    Returns:
        Centres [m], shape [n, 3], and radii [m], shape [n], in the frame of the dig location.
    """
    rows = len(surface)
    centre, radius = _spread(bed, walls, packing, BEHIND - columns.further(rows))
    capped = np.clip(surface, 0.0, bed.top)
    places = columns.cells_of(centre[:, 0], centre[:, 1], rows)
    over = map_coordinates(capped, places, order=1, mode="nearest")
    mean = bed.radius.mean()
    below = (centre[:, 2] < over + _LIFT * mean) & (over > _THIN * mean)
    return centre[below], radius[below]


def _spread(bed: Bed, walls: Walls, packing: int, behind: float) -> tuple[np.ndarray, np.ndarray]:
    """The bed, moved and perhaps mirrored, repeated as often as fills the domain."""
    rng = np.random.default_rng(packing)
    offset = rng.uniform(0.0, 1.0, 2) * bed.lengths
    mirrored = rng.random() < 0.5
    centre = bed.centre.copy()
    centre[:, :2] = (centre[:, :2] + offset) % bed.lengths
    if mirrored:
        centre[:, 1] = bed.lengths[1] - centre[:, 1]
    low = np.array([behind, walls.right])
    size = np.array([walls.ahead, walls.left]) - low
    copies = []
    for i in range(int(np.ceil(size[0] / bed.lengths[0]))):
        for j in range(int(np.ceil(size[1] / bed.lengths[1]))):
            shift = np.array([low[0] + i * bed.lengths[0], low[1] + j * bed.lengths[1], 0.0])
            copies.append(centre + shift)
    radius = np.tile(bed.radius, len(copies))
    centre = np.concatenate(copies)
    gap = 0.85 * radius
    inside = (centre[:, 0] > behind) & (centre[:, 0] < walls.ahead - gap)
    inside &= (centre[:, 1] > walls.right + gap) & (centre[:, 1] < walls.left - gap)
    return centre[inside], radius[inside]


def in_lane(centre: np.ndarray, width: float, rows: int = columns.CELLS) -> np.ndarray:
    """Which spheres lie where the bucket of a given width [m] starts, on a map of so many rows."""
    within: np.ndarray = (centre[:, 0] < _LANE_END - columns.further(rows)) & (
        np.abs(centre[:, 1]) < 0.5 * width + _LANE_MARGIN
    )
    return within
