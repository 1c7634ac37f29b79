"""What a scan holds, in numbers: volumes with their uncertainty, piles, slopes, structures.

A volume is taken over the footprint of a pile with a skirt around it, against the floor: where the
surface lies below that it counts less than nothing, so that noise makes no volume. How well it is
known: `wlplan.terrain.volume`. What is wrong with a whole scan, a scale for instance, is not in it.
"""

from __future__ import annotations

import dataclasses
import math
import os
from typing import Any

import numpy as np
from jaxtyping import Bool

from wlplan.constants import KG_PER_TONNE
from wlplan.io.contents import Contents
from wlplan.io.survey import Survey, read_survey
from wlplan.site.soil import GRAVEL, Soil
from wlplan.terrain.parts import Part, find_parts
from wlplan.terrain.steepness import remarks_on_steepness, slopes_of_soil, steepest_of
from wlplan.terrain.volume import noise_intensity, volume_deviation

# Rise over the ground that counts as pile [m], as for the toe.
_RISE = 0.15
# Width of the skirt around what is higher than that [m].
_SKIRT = 0.5
# Ground that is so much higher than the floor is something that stands [m].
_STANDING = 0.1


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
    above, over = height - ground, height - contents.floor
    labels, parts = find_parts(above, grid.cell_size, grid.origin.astype(float), rise=_RISE)
    seen = np.ones(above.shape, bool) if grid.valid is None else grid.valid
    stands = ground - contents.floor > _STANDING
    footprints = [_footprint(labels, part.number, stands, grid.cell_size) for part in parts]
    volumes = [float(over[cells].sum()) * grid.cell_size**2 for cells in footprints]
    soil_cells = np.any([*footprints, np.zeros(above.shape, bool)], axis=0)
    intensity = noise_intensity(
        height, seen & ~stands, soil_cells, grid.cell_size, survey.scanned_cell
    )
    deviations = [
        volume_deviation(
            height,
            contents.floor,
            seen & ~stands,
            cells,
            soil_cells,
            cell=grid.cell_size,
            intensity=intensity,
        )
        for cells in footprints
    ]
    slopes = slopes_of_soil(height, ground, stands, grid.cell_size)
    steepest = steepest_of(slopes)
    middle = float(np.median(slopes)) if slopes.size else 0.0
    first = grid.origin.astype(float)
    last = first + grid.cell_size * (np.array(grid.height.shape) - 1.0)
    low, high = (frame.scan(float(x), float(y)) for x, y in (first, last))
    # The floors of all piles may be wrong the same way.
    parts_of = {
        "noise": math.hypot(*(one.noise for one in deviations)),
        "unseen": math.hypot(*(one.unseen for one in deviations)),
        "floor": sum(one.floor for one in deviations),
    }
    volume = sum(volumes)
    notes = [*survey.notes, *remarks_on_steepness(slopes, soil)]
    return {
        "volume": volume,
        "volume_deviation": math.hypot(*parts_of.values()),
        "volume_deviation_parts": parts_of,
        "tonnes": volume * soil.density / KG_PER_TONNE,
        "piles": [
            _pile(part, bulk, deviation.total, contents, survey, labels, soil)
            for part, bulk, deviation in zip(parts, volumes, deviations, strict=True)
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


def _footprint(
    labels: np.ndarray, number: int, stands: Bool[np.ndarray, "nx ny"], cell: float
) -> Bool[np.ndarray, "nx ny"]:
    """Cells of a pile with the skirt around it that belongs to no other one."""
    from scipy import ndimage

    own = labels == number
    near = ndimage.distance_transform_edt(~own) * cell <= _SKIRT
    footprint: np.ndarray = near & ~stands & (own | (labels == 0))
    return footprint


def _pile(
    part: Part,
    volume: float,
    deviation: float,
    contents: Contents,
    survey: Survey,
    labels: np.ndarray,
    soil: Soil,
) -> dict[str, Any]:
    x, y = survey.frame.scan(part.x, part.y)
    planned = contents.planned
    return {
        "x": x,
        "y": y,
        "volume": volume,
        "volume_deviation": deviation,
        "tonnes": volume * soil.density / KG_PER_TONNE,
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
