"""The piles of a map: parts that stand higher than their surroundings and hold enough to dig."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from wlplan.terrain.outlines import SMALLEST_VOLUME


@dataclasses.dataclass(frozen=True)
class Part:
    """One pile of a map.

    Attributes:
        number: Its label in the map of them.
        x: Middle of its mass [m].
        y: Likewise.
        volume: Above the ground [m^3].
        height: Of its top over the ground there [m].
        area: That it covers [m^2].
    """

    number: int
    x: float
    y: float
    volume: float
    height: float
    area: float


def find_parts(
    above: Float[np.ndarray, "nx ny"],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
    *,
    rise: float,
    smallest: float = SMALLEST_VOLUME,
) -> tuple[Int[np.ndarray, "nx ny"], tuple[Part, ...]]:
    """The piles of a map, largest first, and the label of each cell; 0 is none of them.

    Args:
        above: Height of the surface above the ground [m].
        cell_size: Grid spacing [m].
        origin: x and y of the first cell [m].
        rise: Height above the ground that counts as pile [m].
        smallest: Volume from which one counts [m^3].
    """
    labels, count = ndimage.label(above > rise)
    numbers = np.arange(1, count + 1)
    flat, height = labels.ravel(), above.ravel()
    volumes = np.bincount(flat, weights=height, minlength=count + 1)[1:] * cell_size**2
    areas = np.bincount(flat, minlength=count + 1)[1:] * cell_size**2
    found = []
    for number in numbers[volumes >= smallest]:
        i, j = np.nonzero(labels == number)
        mass = above[i, j]
        x, y = (
            float(origin[k] + cell_size * (axis * mass).sum() / mass.sum())
            for k, axis in enumerate((i, j))
        )
        volume, area = float(volumes[number - 1]), float(areas[number - 1])
        found.append(Part(int(number), x, y, volume, float(mass.max()), area))
    return labels, tuple(sorted(found, key=lambda part: -part.volume))


def part_at(
    parts: tuple[Part, ...],
    labels: Int[np.ndarray, "nx ny"],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
    place: tuple[float, float],
    *,
    within: float,
) -> Part | None:
    """The pile at a place x, y [m], or the nearest within a distance [m]; None if there is none."""
    best, least = None, within
    for part in parts:
        cells = origin + cell_size * np.argwhere(labels == part.number)
        away = float(np.hypot(*(cells - np.array(place)).T).min()) - 0.5 * cell_size
        if away <= least:
            best, least = part, away
    return best
