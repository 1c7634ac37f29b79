"""What a file of a pile holds before anything of it is checked: a height map or a point cloud.

Readers make these values and `wlplan.io.piles` makes a pile of them, so this module imports nothing
but numpy.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError

# Shortest side of a map that a bucket with its surroundings fits into [m], a little more than the
# 3.6 m window of the models, and most cells a side that are taken.
_SHORTEST_SIDE = 4.0
_MOST_CELLS = 4000
# Points that are looked at at once: what is made of them on the way stays below 200 MiB.
_AT_ONCE = 1 << 20


@dataclasses.dataclass(frozen=True)
class Heightmap:
    """A map of square cells, in the frame of the file: x east, y north, z up.

    Attributes:
        height: Surface [m], shape [nx, ny]: axis 0 is x, axis 1 is y. Cells that were not seen may
            hold anything.
        cell_size: Side of a cell [m].
        origin: x and y of the centre of cell [0, 0] [m], shape [2].
        valid: Which cells were seen, shape [nx, ny]; None if all were.
        ground: Floor under the pile [m], shape [nx, ny]; None if the file has none.
        crs: Reference system of the coordinates before they were converted to metres, such as
            "EPSG:25832"; None if the file names none.
        notes: What was assumed, converted or left out, in words: sentences without their stops.
    """

    height: np.ndarray
    cell_size: float
    origin: np.ndarray
    valid: np.ndarray | None = None
    ground: np.ndarray | None = None
    crs: str | None = None
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class PointCloud:
    """Points on the surface, in the frame of the file: x east, y north, z up.

    Attributes:
        points: x, y and z, shape [n, 3], in any order. Points that are not finite are left out.
        crs: As for a height map.
        notes: Likewise.
        scale: What `points` is multiplied by to be in metres, for x, y and z, shape [3]; None if it
            is so already. With `offset` it keeps many points as small as their file has them.
        offset: What is added then [m], shape [3]; None for nothing.
        unit: Length of the unit of x and y in the file [m], for places that are named to the user.
    """

    points: np.ndarray
    crs: str | None = None
    notes: tuple[str, ...] = ()
    scale: np.ndarray | None = None
    offset: np.ndarray | None = None
    unit: float = 1.0

    def coordinates(self, rows: slice | np.ndarray) -> np.ndarray:
        """x, y and z of some points [m], float64, shape [m, 3].

        Args:
            rows: Which of them.
        """
        places = real_numbers("points", self.points[rows])
        if self.scale is not None:
            places = places * self.scale
        return places if self.offset is None else places + self.offset

    def parts(self) -> Iterator[slice]:
        """All rows, as many at once as fit into little memory."""
        for start in range(0, len(self.points), _AT_ONCE):
            yield slice(start, min(start + _AT_ONCE, len(self.points)))


Scan: TypeAlias = Heightmap | PointCloud
"""What a reader returns."""


Box: TypeAlias = tuple[float, float, float, float]
"""A rectangle: x and y of a corner and of the opposite one, in the unit of the file."""


def crop(scan: Scan, box: Box) -> Scan:
    """The part of a scan inside a rectangle.

    Args:
        scan: Heights on a grid, or points.
        box: The rectangle; cells whose centres lie inside it are kept.

    Raises:
        InputError: If nothing lies inside.
    """
    if isinstance(scan, PointCloud):
        if np.ndim(scan.points) != 2 or not len(scan.points):
            return scan
        inside = np.concatenate(
            [points_inside(scan.coordinates(part), box) for part in scan.parts()]
        )
        if not inside.any():
            ends = [_ends(scan.coordinates(part)) for part in scan.parts()]
            low, high = np.array(ends)[:, 0].min(axis=0), np.array(ends)[:, 1].max(axis=0)
            raise nothing_inside(low, high)
        return dataclasses.replace(scan, points=scan.points[inside])
    low, high = corners(box)
    origin, sides = np.asarray(scan.origin, np.float64), np.array(scan.height.shape[:2])
    first = np.clip(np.ceil((low - origin) / scan.cell_size), 0, sides).astype(int)
    stop = np.clip(np.floor((high - origin) / scan.cell_size) + 1, 0, sides).astype(int)
    if (first >= stop).any():
        raise nothing_inside(origin, origin + (sides - 1) * scan.cell_size)
    part = tuple(slice(a, b) for a, b in zip(first, stop, strict=True))
    maps: dict[str, Any] = {
        name: None if (field := getattr(scan, name)) is None else field[part]
        for name in ("height", "valid", "ground")
    }
    return dataclasses.replace(scan, origin=origin + first * scan.cell_size, **maps)


def _ends(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest finite x, y and z; infinite, the wrong way round, where none is."""
    finite = np.isfinite(places)
    return (
        np.where(finite, places, np.inf).min(axis=0),
        np.where(finite, places, -np.inf).max(axis=0),
    )


def points_inside(points: np.ndarray, box: Box) -> np.ndarray:
    """Which points, shape [n, 2] or [n, 3], lie inside a rectangle, shape [n]."""
    (low, high), places = corners(box), points[:, :2]
    inside: np.ndarray = np.asarray(((places >= low) & (places <= high)).all(axis=-1))
    return inside


def corners(box: Box) -> tuple[np.ndarray, np.ndarray]:
    """The lower left and the upper right corner of a rectangle, each [2]."""
    pair = np.asarray(box, np.float64).reshape(2, 2)
    return pair.min(axis=0), pair.max(axis=0)


def nothing_inside(low: np.ndarray, high: np.ndarray) -> InputError:
    """The complaint about a rectangle that misses a map, which spans what is given, each [2]."""
    return InputError(
        f"has nothing inside the crop: x runs from {low[0]:.10g} to {high[0]:.10g}, y from "
        f"{low[1]:.10g} to {high[1]:.10g}."
    )


def real_numbers(name: str, values: Any) -> np.ndarray:
    """A field of a file in float64, in its own shape.

    Args:
        name: What the file calls it, for the complaint.
        values: Numbers in whatever type they are stored.

    Raises:
        InputError: If they are no real numbers.
    """
    numbers: np.ndarray = np.asarray(values)
    if numbers.dtype.kind not in "iuf":
        raise InputError(f"`{name}` holds {numbers.dtype} values: store real numbers.")
    with np.errstate(invalid="ignore"):  # a NaN of damaged bytes may be a signalling one
        return numbers.astype(np.float64)


def check_size(
    shape: tuple[int, ...], cell_size: float, advice: Callable[[], str] = lambda: ""
) -> None:
    """Refuse maps that no bucket fits into and maps that no memory holds.

    Args:
        shape: Cells along x and y.
        cell_size: Side of a cell [m].
        advice: What to say after the complaint about a map that is too large, such as where the
            piles are; only then called.

    Raises:
        InputError: If the map is one of those.
    """
    if not 0.0 < cell_size < math.inf:
        raise InputError(f"the cell size is {cell_size:g} m: it has to be positive.")
    sides = [n * cell_size for n in shape]
    text = f"the map is {sides[0]:.4g} x {sides[1]:.4g} m"
    if min(sides) < _SHORTEST_SIDE or min(shape) < 2:
        raise InputError(
            f"{text}, too small for a bucket: a side needs at least {_SHORTEST_SIDE:g} m; check "
            f"the cell size and the units."
        )
    if max(*shape, *(side / CELL_SIZE for side in sides)) > _MOST_CELLS + 0.5:
        raise InputError(
            f"{text} in {shape[0]} x {shape[1]} cells: a side may have {_MOST_CELLS} cells, before "
            f"and after resampling to {CELL_SIZE:g} m; crop it to the pile (--crop), or check the "
            f"units{advice()}."
        )
