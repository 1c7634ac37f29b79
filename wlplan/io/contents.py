"""What a scan holds besides the pile that is dug: structures, areas that people drew, other piles.

All of it becomes part of the ground, which cannot be moved.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from wlplan.errors import InputError
from wlplan.io.areas import FOR_TRUCKS, KINDS, Area, read_areas
from wlplan.site.frame import Frame
from wlplan.site.polygon import Polygon
from wlplan.terrain.floor import estimate_ground
from wlplan.terrain.parts import Part, find_parts, part_at
from wlplan.terrain.structures import Structure, find_structures

# Rise over the ground that counts as pile [m], as for the toe.
_RISE = 0.15
# How far from a pile it may be asked for, and how many things a note names.
_NEAR, _NAMED = 5.0, 3
# How far from the scan an area for trucks may be [m].
_FARTHEST = 500.0


@dataclasses.dataclass(frozen=True)
class Contents:
    """What a scan holds.

    Attributes:
        height: Surface, with obstacles as high as they were drawn [m].
        floor: Under all that stands and lies on it, also where the surface lies lower [m].
        ground: What cannot be moved: floor, structures, and other piles than the one asked for [m].
        structures: What stands in it, largest first.
        piles: All piles, largest first.
        planned: The one that is dug; None if there is none.
        closed: Cells that nothing may drive on; None if there are none.
        truck_area: Polygons that trucks may stand in, in the local frame; None: anywhere.
        notes: In words: sentences without their stops.
    """

    height: Float[np.ndarray, "nx ny"]
    floor: Float[np.ndarray, "nx ny"]
    ground: Float[np.ndarray, "nx ny"]
    structures: tuple[Structure, ...]
    piles: tuple[Part, ...]
    planned: Part | None
    closed: Bool[np.ndarray, "nx ny"] | None
    truck_area: tuple[Polygon, ...] | None
    notes: tuple[str, ...]


def contents_of(
    height: Float[np.ndarray, "nx ny"],
    ground: Float[np.ndarray, "nx ny"] | None,
    valid: Bool[np.ndarray, "nx ny"] | None,
    cell_size: float,
    origin: Float[np.ndarray, "2"],
    frame: Frame,
    *,
    known_ground: Bool[np.ndarray, "nx ny"] | None = None,
    keep_out: str | None = None,
    truck_area: str | None = None,
    include: tuple[float, float] | None = None,
    pile: tuple[float, float] | None = None,
) -> Contents:
    """Finds what a scan holds.

    Args:
        height: Surface [m], filled where it was not seen.
        ground: Floor [m]; None: it is estimated.
        valid: Cells that the scan saw; None: all.
        cell_size: Grid spacing [m].
        origin: x and y of the first cell [m], in the local frame.
        frame: How that lies to the coordinates of the scan.
        known_ground: Where the floor is known; elsewhere it is estimated. None: everywhere.
        keep_out: File of areas, see `read_areas`.
        truck_area: File of the areas that trucks may stand in, likewise.
        include: x and y of a structure that is soil after all, in the coordinates of the scan.
        pile: x and y of the pile that is dug, likewise; None: the largest.

    Raises:
        InputError: If there is nothing at `include` or `pile`, or a file of areas cannot be used.
    """
    in_scan = origin + np.array(frame.offset[:2])
    notes: list[str] = []
    labels, found = find_structures(height, cell_size, origin, valid)
    if include is not None:
        found = _without(labels, found, frame.local(*include), cell_size, origin, frame)
    cells = np.isin(labels, [one.number for one in found])
    areas = () if keep_out is None else read_areas(Path(keep_out))
    masks = [area.cells(height.shape, cell_size, in_scan) for area in areas]
    if areas and not any(mask.any() for mask in masks):
        raise InputError(
            f"{keep_out}: no area lies in the scan, which begins at {frame.place(*origin)}: draw "
            f"the areas in the coordinates of the scan."
        )
    drawn = _union(masks, areas, ("obstacle",), height.shape)
    untouched = drawn | _union(masks, areas, ("no-dig",), height.shape)
    standing = cells | drawn
    if ground is None or known_ground is not None:
        estimated = estimate_ground(height, cell_size, valid, standing)
        known = np.zeros(height.shape, bool) if known_ground is None else known_ground
        ground = estimated if ground is None else np.where(known, ground, estimated)
    floor, ground = ground, np.minimum(ground, height)
    for area, mask in zip(areas, masks, strict=True):
        if area.kind == "obstacle" and area.height is not None:
            height = np.where(mask, np.maximum(height, ground + area.height), height)
    ground = np.where(cells | untouched, height, ground)
    if found:
        places = [one.text(frame.place(one.x, one.y)) for one in found]
        notes.append(f"left standing: {_listed(places)}; take one for soil with --include X,Y")
    for kind in KINDS:
        covered = cell_size**2 * float(_union(masks, areas, (kind,), height.shape).sum())
        if covered:
            notes.append(f"{kind}: {covered:.0f} m2 from {keep_out}")
    for_trucks = None
    if truck_area is not None:
        for_trucks = _for_trucks(truck_area, height.shape, cell_size, origin, frame)
        notes.append(f"trucks stand in {_counted(len(for_trucks), 'area')} of {truck_area}")
    of_piles, parts = find_parts(height - ground, cell_size, origin, rise=_RISE)
    planned = parts[0] if parts else None
    if pile is not None:
        place = frame.local(*pile)
        planned = part_at(parts, of_piles, cell_size, origin, place, within=_NEAR)
        if planned is None:
            raise InputError(
                f"there is no pile at {pile[0]:g}, {pile[1]:g}: {_piles(parts, None, frame)}."
            )
    if len(parts) > 1:
        further = "" if pile is not None else ", else long jobs go on to the next largest"
        notes.append(f"{_piles(parts, planned, frame)}; choose with --pile X,Y{further}")
    if pile is not None:
        others = np.isin(of_piles, [part.number for part in parts if part is not planned])
        ground = np.where(others, height, ground)
    closed = _union(masks, areas, ("no-go",), height.shape)
    return Contents(
        height=height,
        floor=floor,
        ground=ground,
        structures=found,
        piles=parts,
        planned=planned,
        closed=closed if closed.any() else None,
        truck_area=for_trucks,
        notes=tuple(notes),
    )


def _for_trucks(
    file: str,
    shape: tuple[int, ...],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
    frame: Frame,
) -> tuple[Polygon, ...]:
    """The polygons of a file of areas for trucks, in the local frame."""
    offset = np.array(frame.offset[:2])
    polygons = tuple(
        tuple(ring - offset for ring in area.rings) for area in read_areas(Path(file), FOR_TRUCKS)
    )
    last = origin + cell_size * (np.array(shape) - 1.0)
    corners = np.concatenate([ring for polygon in polygons for ring in polygon])
    away = float(np.hypot(*np.maximum(np.maximum(origin - corners, corners - last), 0.0).T).min())
    # One that encloses the scan has its corners far away.
    if away > _FARTHEST + math.hypot(*np.ptp(corners, axis=0)):
        raise InputError(
            f"{file}: the areas for trucks are {away:.0f} m from the scan, which begins at "
            f"{frame.place(*origin)}: draw them in the coordinates of the scan."
        )
    return polygons


def _counted(count: int, what: str) -> str:
    return f"the {what}" if count == 1 else f"{count} {what}s"


def _union(
    masks: list[np.ndarray], areas: tuple[Area, ...], kinds: tuple[str, ...], shape: tuple[int, ...]
) -> Bool[np.ndarray, "nx ny"]:
    """Cells of all areas of some kinds."""
    union = np.zeros(shape, bool)
    for area, mask in zip(areas, masks, strict=True):
        if area.kind in kinds:
            union |= mask
    return union


def _without(
    labels: Int[np.ndarray, "nx ny"],
    found: tuple[Structure, ...],
    place: tuple[float, float],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
    frame: Frame,
) -> tuple[Structure, ...]:
    """The structures without the one at a place x, y [m]."""

    def away(one: Structure) -> float:
        cells = origin + cell_size * np.argwhere(labels == one.number)
        return float(np.hypot(*(cells - np.array(place)).T).min())

    nearest = min(found, key=away, default=None)
    if nearest is None or away(nearest) > _NEAR:
        names = _listed([one.text(frame.place(one.x, one.y)) for one in found]) or "nothing"
        raise InputError(
            f"nothing stands at {frame.place(*place)} that could be soil; found was {names}."
        )
    return tuple(one for one in found if one is not nearest)


def _piles(parts: tuple[Part, ...], planned: Part | None, frame: Frame) -> str:
    """The piles of a scan in words."""
    names = [
        f"{part.volume:.0f} m3 at {frame.place(part.x, part.y)}"
        + (" (planned)" if part is planned else "")
        for part in parts
    ]
    count = "1 pile" if len(parts) == 1 else f"{len(parts)} piles"
    return f"{count} in the scan: {_listed(names)}" if parts else "there is no pile in the scan"


def _listed(names: list[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
