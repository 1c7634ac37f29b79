"""What is not soil in a scan: walls, boxes, buildings, posts.

Soil does not stand as steep as what people build. A cell that is more than a metre above all that
could lie under a slope of 60 degrees is on top of something; so is what such cells shut in at their
height, a roof for instance, and the steep face below. Lower things (kerbs, stones, a car's bonnet)
are not found, and of soil that is heaped as high as a wall the first few decimetres behind it are
taken for wall.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from wlplan.terrain.standing import lower_envelope

# Slope that no soil stands at [degrees] over more than this height [m].
_STEEP, _HIGH = 60.0, 1.0
# Behind an edge as steep as this [degrees] a top goes on at its level, this exactly [m], over this
# distance [m]: soil that leans on a wall is lower than it.
_EDGE, _FLAT, _BEHIND = 75.0, 0.12, 0.8
# Slope above which cells below a top belong to its face [degrees]: less, for noise.
_FACE = 55.0
# Tops this much higher or lower than the area that they shut in are its edge [m].
_LEVEL = 0.3
# Part of the border of an area that has to be such an edge.
_SHUT = 0.8
# Smallest structure [m^2]; what is smaller is a stray return.
_SMALLEST = 0.08
# Thickest wall, and largest post [m].
_WALL, _POST = 1.3, 0.8
# Tallest thing whose foot is looked for [m].
_TALLEST = 12.0


@dataclasses.dataclass(frozen=True)
class Structure:
    """Something that stands in a scan and is not soil.

    Attributes:
        number: Its label in the map of them.
        kind: "wall", "post", or "block" for all that is thicker.
        x: Middle of its outline [m].
        y: Likewise.
        length: Longer side of the rectangle, along the axes of its cells, that holds it [m].
        width: Shorter side [m].
        height: Its top over its lowest foot [m].
        area: That it covers [m^2].
    """

    number: int
    kind: str
    x: float
    y: float
    length: float
    width: float
    height: float
    area: float

    def text(self, place: str) -> str:
        """In words, with its place as somebody reads it."""
        size = f"{self.length:.1f} x {self.width:.1f} m, {self.height:.1f} m high"
        return f"{self.kind} {size}, at {place}"


def find_structures(
    height: Float[np.ndarray, "nx ny"],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
    valid: Bool[np.ndarray, "nx ny"] | None = None,
) -> tuple[Int[np.ndarray, "nx ny"], tuple[Structure, ...]]:
    """The label of the structure in each cell, 0 where there is none, and what they are.

    Args:
        height: Surface [m], filled where it was not seen.
        cell_size: Grid spacing [m].
        origin: x and y of the first cell [m].
        valid: Cells that the scan saw; others are no structure.
    """
    surface = np.asarray(height, np.float64)
    steepest = math.tan(math.radians(_STEEP))
    seen = np.ones(surface.shape, bool) if valid is None else np.asarray(valid)
    # Where the scan saw nothing there is nothing to stand above.
    known = np.where(seen, surface, np.inf)
    tops = _tops(known, cell_size, steepest) & seen
    if not tops.any():
        return tops.astype(np.int32), ()
    found = tops | _shut_in(tops, surface, seen)
    face = _slopes(known, cell_size) > math.tan(math.radians(_FACE))
    found = ndimage.binary_propagation(found, mask=found | (face & seen))
    found = _without_gaps(found & seen, surface)
    labels, count = ndimage.label(found, np.ones((3, 3)))
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:] * cell_size**2
    large = np.flatnonzero(areas >= _SMALLEST) + 1
    records = [
        _structure(int(number), labels == number, surface, cell_size, np.asarray(origin, float))
        for number in large
    ]
    return np.where(np.isin(labels, large), labels, 0), tuple(
        sorted(records, key=lambda one: -one.area)
    )


def _tops(
    known: Float[np.ndarray, "nx ny"], cell_size: float, steepest: float
) -> Bool[np.ndarray, "nx ny"]:
    """Cells that are higher over what lies lower around them than soil stands."""
    rise = steepest * cell_size
    seen = np.where(np.isfinite(known), known, np.nan)
    steps = [np.abs(np.diff(seen, axis=axis)) for axis in (0, 1)]
    if not any((step > rise).any() for step in steps):
        return np.zeros(known.shape, bool)
    reach = math.ceil(_TALLEST / rise)
    finite = np.isfinite(known)

    def high(rise: float) -> Bool[np.ndarray, "nx ny"]:
        # Where nothing is seen, as far as the envelope reaches, that is infinite too.
        low = np.where(finite, lower_envelope(known, rise, reach), 0.0)
        over: np.ndarray = np.where(finite, known, 0.0) - low > _HIGH
        return over

    tops = high(rise)
    if not tops.any():
        return tops
    edge_rise = math.tan(math.radians(_EDGE)) * cell_size
    edges = high(edge_rise)
    cells = 2 * round(_BEHIND / cell_size) + 1
    level = ndimage.grey_dilation(np.where(edges, known, -np.inf), size=(cells, cells))
    # Where no edge is near, the cells are too coarse for one.
    level_tops = tops & ((known > level - _FLAT) | ~np.isfinite(level))
    found: np.ndarray = edges | level_tops
    return found


def _shut_in(
    tops: Bool[np.ndarray, "nx ny"],
    surface: Float[np.ndarray, "nx ny"],
    seen: Bool[np.ndarray, "nx ny"],
) -> Bool[np.ndarray, "nx ny"]:
    """Areas around which tops stand at their own level: what these are the edge of."""
    labels, count = ndimage.label(~tops & seen)
    border, level = np.zeros(count + 1), np.zeros(count + 1)
    for here, there in _pairs():
        meets = (labels[here] > 0) & tops[there]
        area = labels[here][meets]
        on_level = np.abs(surface[there][meets] - surface[here][meets]) < _LEVEL
        border += np.bincount(area, minlength=count + 1)
        level += np.bincount(area, weights=on_level, minlength=count + 1)
    shut = (border > 0) & (level >= _SHUT * border)
    shut[0] = False
    result: np.ndarray = shut[labels]
    return result


def _pairs() -> list[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Slices that put each cell beside its neighbour on each side."""
    low, high, every = slice(None, -1), slice(1, None), slice(None)
    pairs = [((low, every), (high, every)), ((every, low), (every, high))]
    return pairs + [(b, a) for a, b in pairs]


def _slopes(known: Float[np.ndarray, "nx ny"], cell_size: float) -> Float[np.ndarray, "nx ny"]:
    """The steepest rise from or to a neighbour on a side [1]."""
    finite = np.where(np.isfinite(known), known, np.nan)
    slopes = np.zeros(known.shape)
    for here, there in _pairs():
        step = np.nan_to_num(np.abs(finite[there] - finite[here])) / cell_size
        slopes[here] = np.maximum(slopes[here], step)
    return slopes


def _without_gaps(
    found: Bool[np.ndarray, "nx ny"], surface: Float[np.ndarray, "nx ny"]
) -> Bool[np.ndarray, "nx ny"]:
    """Cells that touch at a corner only are joined by the higher one of the two between them.

    Soil that slides to any of eight neighbours would pass there.
    """
    closed = found.copy()
    for flip in (False, True):
        a, b = (closed[:, ::-1], surface[:, ::-1]) if flip else (closed, surface)
        one = a[:-1, :-1] & a[1:, 1:] & ~a[:-1, 1:] & ~a[1:, :-1]
        i, j = np.nonzero(one)
        upper = b[i, j + 1] >= b[i + 1, j]
        a[i[upper], j[upper] + 1] = True
        a[i[~upper] + 1, j[~upper]] = True
    return closed


def _structure(
    number: int,
    cells: Bool[np.ndarray, "nx ny"],
    surface: Float[np.ndarray, "nx ny"],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
) -> Structure:
    """What the cells of one structure are."""
    places = np.argwhere(cells)
    middle = places.mean(axis=0)
    # The axes of the cells; a square has none, so any will do.
    spread = np.linalg.eigh(np.cov((places - middle).T) if len(places) > 2 else np.eye(2))
    along = (places - middle) @ spread.eigenvectors
    low, high = along.min(axis=0), along.max(axis=0)
    sides = np.sort((high - low + 1.0) * cell_size)
    centre = middle + spread.eigenvectors @ (0.5 * (low + high))
    # Padded, for the edge of the map is an edge too.
    thick = 2.0 * ndimage.distance_transform_edt(np.pad(cells, 1)).max() * cell_size
    around = ndimage.binary_dilation(cells, iterations=2)
    foot = surface[around].min()
    kind = "block"
    if sides[1] <= _POST:
        kind = "post"
    elif thick <= _WALL and sides[1] > 2.0 * thick:
        kind = "wall"
    x, y = origin + centre * cell_size
    return Structure(
        number=number,
        kind=kind,
        x=float(x),
        y=float(y),
        length=float(sides[1]),
        width=float(sides[0]),
        height=float(surface[cells].max() - foot),
        area=float(cells.sum() * cell_size**2),
    )
