"""The line around the largest pile of a map.

Points of the plane are complex numbers x + iy [m], which numpy handles at once.
"""

from __future__ import annotations

import math

import contourpy
import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy import ndimage

from wlplan.errors import InputError

SMALLEST_VOLUME = 1.0
"""Smallest pile that is worth a bucket [m^3], a third of a heaped one."""


def largest_outline(
    above: Float[np.ndarray, "nx ny"],
    *,
    rise: float,
    origin: Float[np.ndarray, "2"],
    cell: float,
    width: float,
    smallest: float = SMALLEST_VOLUME,
) -> Complex[np.ndarray, " _"]:
    """The longest line, inside the map, around the largest pile by volume, without its hollows.

    Args:
        above: Height of the surface above the ground [m].
        rise: Height above the ground that counts as pile [m].
        origin: World position of the first cell [m].
        cell: Grid spacing [m].
        width: Of the bucket [m]: a pile that is narrower in every direction does not count.
        smallest: Volume of the smallest pile that does [m^3].

    Returns:
        Points of the line; one that does not run over the edge of the map ends where it begins.

    Raises:
        InputError: If no cell is higher than `rise`, the largest pile is not worth digging, or it
            covers the whole map.
    """
    # Only the part of the map that holds what is higher, with a border of what is not.
    higher = above > rise
    part = _bounds(higher)
    near, higher = above[part], higher[part]
    if higher.size == 0:
        raise InputError(
            f"Nothing to dig: no cell lies more than {rise:g} m above the ground; check the units "
            f"and the ground of the scan."
        )
    x, y = (origin[k] + cell * np.arange(part[k].start, part[k].stop) for k in (0, 1))
    lines = _level_lines(near, x, y, rise)
    if not _is_one_pile(lines, near, higher, cell, width, smallest):
        # Most piles are one, and to see that takes less time than to look for the largest.
        alone = _largest_alone(near, higher, rise, cell, width, smallest)
        lines = _level_lines(alone, x, y, rise)
    if not lines:
        raise InputError(
            "The pile covers the whole map, so its toe is not on it: scan a wider area, down to "
            "the floor around the pile."
        )
    return max(lines, key=lambda line: distances_along(line)[-1])


def distances_along(line: Complex[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """How far along a line each of its points lies [m]."""
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(line)))])


def _bounds(flags: Bool[np.ndarray, "nx ny"]) -> tuple[slice, slice]:
    """The part of a grid that holds all flags set, with a border of one cell inside the grid."""

    def span(indices: Int[np.ndarray, " n"], count: int) -> slice:
        if not len(indices):
            return slice(0, 0)
        return slice(max(int(indices[0]) - 1, 0), min(int(indices[-1]) + 2, count))

    nx, ny = flags.shape
    i, j = np.flatnonzero(flags.any(axis=1)), np.flatnonzero(flags.any(axis=0))
    return span(i, nx), span(j, ny)


def _level_lines(
    height: Float[np.ndarray, "n m"],
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " m"],
    level: float,
) -> list[Complex[np.ndarray, " _"]]:
    """The lines on which a surface has a height; closed ones end where they begin."""
    # contourpy's own function for this looks for masked cells, which takes as long again.
    across, up = np.meshgrid(x, y)
    generator = contourpy.SerialContourGenerator(
        across,
        up,
        height.T,
        np.asarray(False),  # no mask
        corner_mask=False,
        line_type=contourpy.LineType.Separate,
        fill_type=contourpy.FillType.OuterCode,
        quad_as_tri=False,
        z_interp=contourpy.ZInterp.Linear,
    )
    return [np.ascontiguousarray(line).view(np.complex128)[:, 0] for line in generator.lines(level)]


def _is_one_pile(
    lines: list[Complex[np.ndarray, " _"]],
    above: Float[np.ndarray, "n m"],
    higher: Bool[np.ndarray, "n m"],
    cell: float,
    width: float,
    smallest: float,
) -> bool:
    """Whether level lines are for certain the edge of a single pile that is worth digging."""
    if len(lines) != 1 or lines[0][0] != lines[0][-1] or higher[0, 0]:
        return False
    # Where cells meet at a corner only, the line does not tell whether they are one pile.
    one, other = higher[:-1] ^ higher[1:], higher[:, :-1] ^ higher[:, 1:]
    if (one[:, :-1] & one[:, 1:] & other[:-1] & other[1:]).any():
        return False
    size = cell * (max(higher.shape) - 2)
    return size >= width and bool(above[higher].sum() * cell**2 >= smallest)


def _largest_alone(
    above: Float[np.ndarray, "n m"],
    higher: Bool[np.ndarray, "n m"],
    rise: float,
    cell: float,
    width: float,
    smallest: float,
) -> Float[np.ndarray, "n m"]:
    """The surface with all piles but the largest sunk, and its hollows filled, to about the level.

    Raises:
        InputError: If the largest is not worth digging.
    """
    labels, _ = ndimage.label(higher)
    volumes = np.bincount(labels.ravel(), weights=above.ravel())[1:] * cell**2
    largest = labels == 1 + int(np.argmax(volumes))
    extent = cell * max(side.stop - side.start - 2 for side in _bounds(largest))
    if extent < width:
        extent = _largest_extent(np.argwhere(largest) * cell) + cell
    if volumes.max() < smallest or extent < width:
        raise InputError(
            f"Nothing to dig: the largest pile holds {volumes.max():.2g} m^3 and is {extent:.2g} m "
            f"long; a bucket needs {smallest:.2g} m^3 and {width:g} m."
        )
    # What is outside is in one piece, unless there are hollows or the pile runs over the edge.
    solid = largest if ndimage.label(~largest)[1] == 1 else ndimage.binary_fill_holes(largest)
    alone = np.where(solid, above, np.minimum(above, rise - 1e-6))
    return np.where(solid & ~largest, np.maximum(alone, rise + 1e-6), alone)


def _largest_extent(points: Float[np.ndarray, "n 2"]) -> float:
    """Longest side of the bounding boxes of a cloud over all directions, to 2 %."""
    angle = np.linspace(0.0, math.pi, 16, endpoint=False)
    along = points @ np.stack([np.cos(angle), np.sin(angle)])
    return float(np.max(along.max(axis=0) - along.min(axis=0)))
