"""`.tif`, `.tiff`: GeoTIFF, band 1, with square cells along the axes, in metres.

Nodata and NaN are unseen. A file without georeference is refused, since nothing gives its cell
size.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library
from wlplan.io.scans import Heightmap, check_size

ENDINGS = (".tif", ".tiff")


def read(path: Path) -> Heightmap:
    """Read band 1.

    Raises:
        InputError: If there is no rasterio, or the cells are not square, along the axes and in
            metres.
    """
    with library("rasterio", install="wlplan[scan]") as rasterio, rasterio.open(path) as file:
        step = file.transform
        if step.is_identity:
            raise InputError(
                "has no georeference, so its cell size is unknown: add a world file beside it, or "
                "save it as .npz with a `cell_size`."
            )
        if file.crs is not None and (
            file.crs.is_geographic or file.crs.linear_units_factor[1] != 1
        ):
            raise InputError("is not in metres: reproject it to a metric system such as UTM.")
        cell = abs(step.a)
        turned = max(abs(step.b), abs(step.d)) > 1e-6 * cell
        if turned or not math.isclose(cell, abs(step.e), rel_tol=1e-3):
            raise InputError("has rotated or oblong cells: resample it to square cells, north up.")
        check_size((file.width, file.height), cell)
        band, mask = file.read(1), file.read_masks(1) > 0
    # Rows run from north to south and columns from west to east, unless a step says otherwise.
    height, valid = band.T, mask.T
    west, south = step.c, step.f
    if step.a < 0.0:
        height, valid, west = height[::-1], valid[::-1], west + step.a * len(height)
    if step.e < 0.0:
        height, valid, south = height[:, ::-1], valid[:, ::-1], south + step.e * height.shape[1]
    # A georeference names the corner of a cell, a pile its centre.
    origin = np.array([west, south]) + 0.5 * cell
    return Heightmap(height, cell, origin, valid & ~np.isnan(height))
