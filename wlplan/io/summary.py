"""What a scan holds, in numbers: volumes with their uncertainty, piles, slopes, structures.

The deviation of a volume (one standard deviation) has three parts that are taken as independent:

* noise of the cells: how much second differences of the surface scatter on the pile, which a smooth
  surface does not, times the root of its area and of the area over which noise is alike;
* the floor under the pile, which nobody saw: how much the ground around it scatters about a plane,
  averaged over the ring that the floor is interpolated from, times the area of the pile;
* cells that the scan did not see: half of what lies above the lowest seen cell at their border.

Areas over which values are alike come from the scatter of block means, as block kriging and xdem's
patches do it: the scatter of means over blocks falls with the root of their number, of independent
ones. What is wrong with a whole scan (a scale, a wrong floor) is in none of them.
"""

from __future__ import annotations

import dataclasses
import math
import os
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from wlplan.constants import KG_PER_TONNE
from wlplan.io.contents import Contents
from wlplan.io.survey import Survey, read_survey
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.grid import Grid
from wlplan.terrain.parts import Part, find_parts

# Rise over the ground that counts as pile [m], as for the toe.
_RISE = 0.15
# Width of the ring of ground around a pile that its floor rests on [m].
_RING = 2.0
# Sides of the blocks whose means are compared [cells], and fewest blocks that say anything.
_BLOCKS, _FEWEST = (2, 4, 8, 16, 32), 12
# Ground that is so much higher than the floor is something that stands [m].
_STANDING = 0.1
# Distance over which slopes are taken [m]: longer than the noise of a cell.
_SLOPE_OVER = 1.0
_NORMAL_MAD = 1.4826


def info(
    scan: str | os.PathLike[str] | Survey, *, soil: Soil = GRAVEL, **reading: Any
) -> dict[str, Any]:
    """What a scan holds.

    Args:
        scan: File of a pile, or what was read from it.
        soil: Whose density and angle of repose it is compared with.
        reading: Options of how the file is read, as of `wlplan.io.read_scan`.

    Returns:
        Numbers in SI units by name, lists of `piles` (largest first) and `structures`, and `notes`;
        places are in the coordinates of the scan.

    Raises:
        InputError: If the file cannot be used.
    """
    survey = scan if isinstance(scan, Survey) else read_survey(scan, **reading)
    grid, frame, contents = survey.grid, survey.frame, survey.contents
    height = grid.height.astype(np.float64)
    ground = height * 0.0 if grid.ground is None else grid.ground.astype(np.float64)
    above = height - ground
    labels, parts = find_parts(above, grid.cell_size, grid.origin.astype(float), rise=_RISE)
    seen = np.ones(above.shape, bool) if grid.valid is None else grid.valid
    stands = ground - contents.floor > _STANDING
    bare = seen & ~stands & (above < _RISE)
    deviations = [
        _deviation(labels == part.number, bare, above, height, seen, grid) for part in parts
    ]
    total = _combined(deviations)
    from scipy import ndimage

    free = (above > _RISE) & ~ndimage.binary_dilation(stands, iterations=_reach(grid.cell_size))
    slopes = _slopes(height, grid.cell_size)[free]
    steepest = float(np.quantile(slopes, 0.99)) if slopes.size else 0.0
    middle = float(np.median(slopes)) if slopes.size else 0.0
    first = grid.origin.astype(float)
    last = first + grid.cell_size * (np.array(grid.height.shape) - 1.0)
    low, high = (frame.scan(float(x), float(y)) for x, y in (first, last))
    volume = float(above.sum()) * grid.cell_size**2
    notes = [*survey.notes, *_steep(steepest, soil)]
    return {
        "volume": volume,
        "volume_deviation": total["all"],
        "volume_deviation_parts": {name: total[name] for name in ("noise", "floor", "unseen")},
        "tonnes": volume * soil.density / KG_PER_TONNE,
        "piles": [
            _pile(part, deviation["all"], contents, survey, labels, soil)
            for part, deviation in zip(parts, deviations, strict=True)
        ],
        "structures": [
            {
                **{
                    name: value
                    for name, value in dataclasses.asdict(one).items()
                    if name != "number"
                },
                **dict(zip(("x", "y"), frame.scan(one.x, one.y), strict=True)),
            }
            for one in contents.structures
        ],
        "steepest_slope_deg": steepest,
        "median_slope_deg": middle,
        "repose_deg": math.degrees(soil.repose_angle),
        "crs": frame.crs,
        "offset": list(frame.offset),
        "extent": [*low, *high],
        "cells": list(grid.height.shape),
        "cell_size": float(grid.cell_size),
        "unseen_area": float((~seen).sum()) * grid.cell_size**2,
        "notes": notes,
    }


def _pile(
    part: Part, deviation: float, contents: Contents, survey: Survey, labels: np.ndarray, soil: Soil
) -> dict[str, Any]:
    x, y = survey.frame.scan(part.x, part.y)
    planned = contents.planned
    return {
        "x": x,
        "y": y,
        "volume": part.volume,
        "volume_deviation": deviation,
        "tonnes": part.volume * soil.density / KG_PER_TONNE,
        "height": part.height,
        "area": part.area,
        "toe_length": _outline_length(labels == part.number) * survey.grid.cell_size,
        "planned": planned is not None
        and math.hypot(part.x - planned.x, part.y - planned.y) < survey.grid.cell_size,
    }


def _outline_length(cells: Bool[np.ndarray, "nx ny"]) -> float:
    """Length of the outline of cells, in cells; a staircase counts as the slope that it is of."""
    padded = np.pad(cells, 1).astype(float)
    dx, dy = np.gradient(padded)
    return float(np.hypot(dx, dy).sum())


def _steep(steepest: float, soil: Soil) -> list[str]:
    repose = math.degrees(soil.repose_angle)
    if steepest <= repose + 3.0:
        return []
    return [
        f"the pile stands at up to {steepest:.0f} degrees, the soil rests at {repose:.0f}: such "
        f"faces slide when they are dug, or choose a --soil that stands as steep"
    ]


def _deviation(
    pile: Bool[np.ndarray, "nx ny"],
    bare: Bool[np.ndarray, "nx ny"],
    above: Float[np.ndarray, "nx ny"],
    height: Float[np.ndarray, "nx ny"],
    seen: Bool[np.ndarray, "nx ny"],
    grid: Grid,
) -> dict[str, float]:
    """Standard deviation of the volume of a pile, and its parts [m^3]; see the module."""
    from scipy import ndimage

    cell = grid.cell_size
    area = float(pile.sum()) * cell**2
    # Noise: what is left of the surface when its smooth part is taken off.
    rough = height - ndimage.gaussian_filter(height, 0.5 / cell)
    inner = ndimage.binary_erosion(pile & seen, iterations=3)
    sigma = _scatter(height, inner)
    noise = sigma * math.sqrt(_alike(np.where(inner, rough, np.nan), cell) * area)
    ring = ndimage.distance_transform_edt(~pile) * cell
    ring_cells = (ring > 0.5) & (ring <= 0.5 + _RING) & bare
    floor = 0.0
    if ring_cells.sum() > 3 * _FEWEST:
        i, j = np.nonzero(ring_cells)
        basis = np.stack([np.ones(i.size), i * cell, j * cell], axis=-1)
        plane = np.linalg.lstsq(basis, height[i, j], rcond=None)[0]
        off = np.full(height.shape, np.nan)
        i, j = np.nonzero(bare)
        off[i, j] = height[i, j] - np.stack([np.ones(i.size), i * cell, j * cell], axis=-1) @ plane
        ring_area = float(ring_cells.sum()) * cell**2
        alike = min(_alike(off, cell), ring_area)
        scatter = float(np.std(off[ring_cells]))
        floor = scatter * math.sqrt(alike / ring_area) * area
    unseen = 0.0
    holes, count = ndimage.label(~seen & ndimage.binary_dilation(pile, iterations=2))
    for number in range(1, count + 1):
        hole = holes == number
        border = ndimage.binary_dilation(hole) & seen
        lowest = above[border].min() if border.any() else 0.0
        unseen += 0.5 * float(np.maximum(above[hole] - lowest, 0.0).sum()) * cell**2
    parts = {"noise": noise, "floor": floor, "unseen": unseen}
    return {**parts, "all": math.sqrt(sum(value**2 for value in parts.values()))}


def _scatter(height: Float[np.ndarray, "nx ny"], cells: Bool[np.ndarray, "nx ny"]) -> float:
    """Standard deviation of the noise of cells [m], from second differences over three cells."""
    step = 3
    found = []
    for axis in (0, 1):
        second = np.roll(height, step, axis) - 2.0 * height + np.roll(height, -step, axis)
        whole = cells & np.roll(cells, step, axis) & np.roll(cells, -step, axis)
        values = second[whole]
        if values.size >= _FEWEST:
            # A slope of constant curvature adds a constant.
            spread = _NORMAL_MAD * float(np.median(np.abs(values - np.median(values))))
            found.append(spread / math.sqrt(6.0))
    return min(found, default=0.0)


def _alike(values: Float[np.ndarray, "nx ny"], cell: float) -> float:
    """Area over which values are alike [m^2]: of a block whose mean scatters as one value does.

    Args:
        values: NaN where there is none.
        cell: Grid spacing [m].
    """
    spread = float(np.nanvar(values)) if np.isfinite(values).any() else 0.0
    largest = cell**2
    if spread == 0.0:
        return largest
    for side in _BLOCKS:
        nx, ny = (n // side for n in values.shape)
        blocks = values[: nx * side, : ny * side].reshape(nx, side, ny, side)
        finite = np.isfinite(blocks)
        number = finite.sum(axis=(1, 3))
        sums = np.where(finite, blocks, 0.0).sum(axis=(1, 3))
        full = number > 0.5 * side**2
        means = sums[full] / number[full]
        if len(means) >= _FEWEST:
            largest = max(largest, float(np.var(means)) / spread * (side * cell) ** 2)
    return largest


def _combined(deviations: list[dict[str, float]]) -> dict[str, float]:
    """Deviations of all piles together; their floors are taken as wrong the same way."""
    noise = math.sqrt(sum(one["noise"] ** 2 for one in deviations))
    floor, unseen = (sum(one[name] for one in deviations) for name in ("floor", "unseen"))
    everything = math.sqrt(noise**2 + floor**2 + unseen**2)
    return {"noise": noise, "floor": floor, "unseen": unseen, "all": everything}


def _reach(cell: float) -> int:
    """Cells from a place to either end of what its slope is taken over."""
    return max(1, round(0.5 * _SLOPE_OVER / cell))


def _slopes(height: Float[np.ndarray, "nx ny"], cell: float) -> Float[np.ndarray, "nx ny"]:
    """Slope of the surface over a metre [degrees]."""
    half = _reach(cell)
    padded = np.pad(height, half, mode="edge")
    nx, ny = height.shape
    x = padded[2 * half :, half : half + ny] - padded[:nx, half : half + ny]
    y = padded[half : half + nx, 2 * half :] - padded[half : half + nx, :ny]
    slopes: np.ndarray = np.degrees(np.arctan(np.hypot(x, y) / (2.0 * half * cell)))
    return slopes
