"""The toe of a pile: where a loader drives up to it, and which way it then heads."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy import ndimage

from wlplan.checks import check_pile
from wlplan.errors import InputError
from wlplan.site.machine import WA320, WheelLoader
from wlplan.terrain.outlines import SMALLEST_VOLUME, distances_along, largest_outline
from wlplan.terrain.standing import standing
from wlplan.types import Pile, Pose

TOE_RISE = 0.15
"""Rise over the ground that counts as the toe [m]."""

# Steps in which the way to a point of the toe is looked at [m].
LANE_STEP = 0.25
# Spacing of the points of a toe contour [m].
CONTOUR_SPACING = 0.1


@dataclasses.dataclass(frozen=True)
class ToeContour:
    """The edge of a pile, world frame, as points a fixed step apart with the pile on their left."""

    points: Float[np.ndarray, "n 2"]  # [m]
    heading: Float[np.ndarray, " n"]  # into the pile [rad], counter-clockwise from +x
    length: float  # [m]
    closed: bool  # False where the pile runs over the edge of the map
    accessible: Bool[np.ndarray, " n"]  # a bucket can start here on ground that the scan saw


def toe_contour(
    pile: Pile,
    *,
    rise: float = TOE_RISE,
    machine: WheelLoader = WA320,
    smallest: float = SMALLEST_VOLUME,
) -> ToeContour:
    """Trace the toe of the largest pile, by volume, on the grid.

    The toe is where the surface stands `rise` above the ground. Hollows inside the pile are not
    part of it. Where the pile runs over the edge of the map, the longest part inside is kept.

    A heading is the inward normal of the chord over one bucket width. A point is accessible if the
    cutting edge of a bucket there lies inside the map, the scan saw its cell, the surface a bucket
    length ahead is still higher than `rise` above the ground, and nothing stands in the way of a
    loader that comes straight on, over its length and as wide as the bucket.

    Args:
        pile: One pile, not a batch.
        rise: Height above the ground that counts as pile [m].
        machine: What digs: a bucket has to fit, and to find pile over the length of its floor.
        smallest: Volume from which a pile counts [m^3].

    Raises:
        InputError: If there is nothing to dig: no cell higher than `rise`, less volume, or a
            footprint narrower than the bucket in every direction.
    """
    if not 0.0 < rise < math.inf:
        raise InputError(f"The rise is {rise:g} m: it has to be positive.")
    cell = pile.cell_size
    check_pile(pile)
    # A level floor is not made: every loading of a data set comes this way.
    ground = None if pile.ground is None else np.asarray(pile.ground, np.float64)
    above = np.asarray(pile.height, np.float64)
    if ground is not None:
        above = above - ground
    origin = np.asarray(pile.origin, np.float64)
    width = machine.bucket_width
    line = largest_outline(
        above, rise=rise, origin=origin, cell=cell, width=width, smallest=smallest
    )
    closed = bool(line[0] == line[-1]) and len(line) > 2

    marks = distances_along(line)
    length = float(marks[-1])
    count = max(round(length / CONTOUR_SPACING), 8)

    def along(distance: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Points at distances along the line [m]; a closed one wraps round, an open one ends."""
        inside = distance % length if closed else np.clip(distance, 0.0, length)
        points: np.ndarray = np.interp(inside, marks, line)
        return points

    at = np.linspace(0.0, length, count, endpoint=not closed)
    points = along(at)
    # Chords over one bucket width smooth out ripples.
    half = 0.5 * min(machine.bucket_width, 0.5 * length)
    chord = along(at + half) - along(at - half)
    normal = 1j * chord / np.maximum(np.abs(chord), 1e-9)
    if closed:
        # A closed line has the pile inside: the pile is on the left if it runs round to the left.
        left = float(np.sum(line[:-1].real * line[1:].imag - line[:-1].imag * line[1:].real)) > 0.0
    else:
        sides = (_sample(above, points + d * normal, origin, cell).mean() for d in (0.2, -0.2))
        left = next(sides) >= next(sides)
    if not left:
        points, normal = points[::-1], -normal[::-1]

    edge = 0.5j * machine.bucket_width * normal
    accessible = (
        _inside(points - edge, pile.height.shape, origin, cell)
        & _inside(points + edge, pile.height.shape, origin, cell)
        & (_sample(above, points + machine.bucket_depth * normal, origin, cell) > rise)
    )
    if pile.valid is not None:
        seen = np.asarray(pile.valid, np.float64)
        accessible &= _sample(seen, points, origin, cell) > 1.0 - 1e-6
    stands = None if ground is None else standing(ground, cell)
    if stands is not None and stands.any():
        # From where the rear of the loader is when it stops behind the dig location.
        rear = machine.approach_distance + 0.5 * machine.length
        ahead = np.arange(-rear, 0.5 * machine.bucket_depth, LANE_STEP)
        across = machine.bucket_width * (np.arange(0.0, 1.01, 0.125) - 0.5)
        lane = points + normal * (ahead[:, None, None] + 1j * across[:, None])
        accessible &= ~_any_near(stands, lane, origin, cell).any(axis=(0, 1))
    pairs = np.stack([points.real, points.imag], axis=-1)
    return ToeContour(pairs, np.angle(normal), length, closed, accessible)


def _any_near(
    flags: Bool[np.ndarray, "nx ny"],
    points: Complex[np.ndarray, "*n"],
    origin: Float[np.ndarray, "2"],
    cell: float,
) -> Bool[np.ndarray, "*n"]:
    """The flags of the cells at points; none outside the map."""
    i, j = (
        np.rint((v - origin[k]) / cell).astype(int)
        for k, v in enumerate((points.real, points.imag))
    )
    inside = (i >= 0) & (j >= 0) & (i < flags.shape[0]) & (j < flags.shape[1])
    i, j = np.where(inside, i, 0), np.where(inside, j, 0)
    found: np.ndarray = inside & flags[i, j]
    return found


def check_accessible(accessible: Bool[np.ndarray, " n"]) -> None:
    """Refuses a toe that a bucket can start nowhere on.

    Raises:
        InputError: If no point of it is accessible.
    """
    if not np.any(accessible):
        raise InputError(
            "A bucket can start nowhere on the toe of this pile: it lies on unseen ground or at "
            "the edge of the map; scan a wider area around the pile."
        )


def edge_poses(contour: ToeContour, locations: int) -> Pose:
    """Poses evenly spaced by arc length over the accessible part of a toe, heading inward.

    Args:
        contour: Toe of a pile.
        locations: Number of poses; more than the contour has points are interpolated.

    Raises:
        InputError: If the number is not positive, or no point of the contour is accessible.
    """
    if locations < 1:
        raise InputError(f"{locations} dig locations asked for: ask for at least one.")
    check_accessible(contour.accessible)
    points = np.flatnonzero(contour.accessible)
    # Every accessible point stands for one step of the contour, half before it and half after.
    place = (np.arange(locations) + 0.5) * points.size / locations
    nearest = points[np.floor(place).astype(int)]
    offset = place % 1.0 - 0.5
    neighbour = nearest + np.where(offset < 0.0, -1, 1)
    count = len(contour.heading)
    neighbour = neighbour % count if contour.closed else np.clip(neighbour, 0, count - 1)
    weight = np.where(contour.accessible[neighbour], np.abs(offset), 0.0)

    def between(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        mean: np.ndarray = (1.0 - weight) * values[nearest] + weight * values[neighbour]
        return mean

    heading = np.arctan2(between(np.sin(contour.heading)), between(np.cos(contour.heading)))
    # Between two points of an open contour's ends, or of a cusp, the headings may cancel.
    smooth = np.abs(_turn(contour.heading[nearest], contour.heading[neighbour])) < 0.5 * math.pi
    return Pose(
        x=between(contour.points[:, 0]),
        y=between(contour.points[:, 1]),
        heading=np.where(smooth, heading, contour.heading[nearest]),
    )


def _turn(start: Float[np.ndarray, " n"], end: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Angle from one heading to another [rad], -pi to pi."""
    turn: np.ndarray = (end - start + math.pi) % (2.0 * math.pi) - math.pi
    return turn


def _inside(
    points: Complex[np.ndarray, " n"],
    shape: tuple[int, ...],
    origin: Float[np.ndarray, "2"],
    cell: float,
) -> Bool[np.ndarray, " n"]:
    cells = (points - complex(*origin)) / cell
    i, j, last = cells.real, cells.imag, np.array(shape) - 1 + 1e-6
    inside: np.ndarray = (i >= -1e-6) & (i <= last[0]) & (j >= -1e-6) & (j <= last[1])
    return inside


def _sample(
    values: Float[np.ndarray, "nx ny"],
    points: Complex[np.ndarray, " n"],
    origin: Float[np.ndarray, "2"],
    cell: float,
) -> Float[np.ndarray, " n"]:
    """Bilinear values at points of the world; outside the map those of its edge."""
    cells = (points - complex(*origin)) / cell
    at = np.stack([cells.real, cells.imag])
    sampled: np.ndarray = ndimage.map_coordinates(values, at, order=1, mode="nearest")
    return sampled
