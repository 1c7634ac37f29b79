"""`.tif`, `.tiff`: GeoTIFF, one band of heights, with square cells along the axes.

Lengths are converted to metres: x and y from the unit of the reference system, heights from that of
the band, else of the system. Scale and offset of the band are applied. Nodata, NaN and cells that
the alpha band or the mask leaves out are unseen. A file without georeference is refused, since
nothing gives its cell size; so is a picture.

No file is opened but the one that is named, and a world file beside it. GDAL would open whatever
others a TIFF names for its overviews, addresses in the net too, and virtual data sets beside it.
"""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library
from wlplan.io.limits import MOST_UNPACKED, check_unpacked
from wlplan.io.reference import Reference, length_unit, reference_of
from wlplan.io.scans import Box, Heightmap, check_size, corners, nothing_inside

ENDINGS = (".tif", ".tiff")
OPTIONS = ("band", "crop")

# How TIFF and BigTIFF begin, in either order of bytes.
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# How GDAL is kept to the file itself: nothing beside it counts, and no address is connected to.
_ALONE = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
}
# Where its metadata name another file: GDAL, gcore/gdaldefaultoverviews.cpp.
_ELSEWHERE = "OVERVIEWS"
# World files of `a.tif`: six numbers, a line each.
_WORLD_FILES, _LONGEST_WORLD_FILE = (".tfw", ".tifw", ".wld", ".TFW"), 4096
# What bands of heights are called.
_HEIGHTS = re.compile(r"height|elev|altitude|\b(dsm|dtm|dem|dgm|dom|z)\b", re.IGNORECASE)
_COLOURS = {"red", "green", "blue", "palette", "hue", "saturation", "lightness", "cyan", "magenta"}
_COLOURS |= {"yellow", "black", "Y", "Cb", "Cr"}
# A value at the end of all that is this far from every other is no height [m]: a file may use one
# for its unseen cells and not say so.
_APART = 1000.0


def read(path: Path, *, band: int | None = None, crop: Box | None = None) -> Heightmap:
    """Read the heights.

    Args:
        path: File to read.
        band: Number of the band that holds them, from 1; by default the only one that can.
        crop: Rectangle outside of which nothing is read, in the coordinates of the file.

    Raises:
        InputError: If rasterio or pyproj is missing, the band is not clear or a colour, the cells
            are not square and along the axes, or the coordinates are no lengths on the ground.
    """
    with path.open("rb") as start:
        if start.read(4) not in _TIFF:
            raise InputError("is no TIFF file: give it the ending of its format.")
    # A whole path and one driver: nothing else is opened than that file, whatever its name looks
    # like.
    place = path.absolute()
    with (
        library("rasterio", install="wlplan[scan]") as rasterio,
        rasterio.Env(**_ALONE),
        rasterio.open(place, driver="GTiff") as file,
    ):
        if file.tags(ns=_ELSEWHERE):
            raise InputError("names other files for its overviews: export it again without them.")
        _check_blocks(file)
        georeference = file.transform
        if georeference.is_identity:
            georeference = _world_file(rasterio, path) or georeference
        step = georeference
        if step.is_identity:
            raise InputError(
                "has no georeference, so its cell size is unknown: add a world file beside it, or "
                "save it as .npz with a `cell_size`."
            )
        number, notes = _band(file, band)
        reference = Reference()
        if file.crs is not None:
            middle = step * (0.5 * file.width, 0.5 * file.height)
            reference = reference_of(file.crs.to_wkt(), middle)
        if unit := file.units[number - 1]:
            reference = dataclasses.replace(reference, vertical=length_unit(unit))
        horizontal, vertical, assumed = reference.factors()
        cell = abs(step.a)
        turned = max(abs(step.b), abs(step.d)) > 1e-6 * cell
        if turned or not math.isclose(cell, abs(step.e), rel_tol=1e-3):
            raise InputError("has rotated or oblong cells: resample it to square cells, north up.")
        window = None
        if crop is not None:
            window = _window(rasterio, file, crop, georeference)
            step = rasterio.windows.transform(window, georeference)
        size = (file.width, file.height) if window is None else (window.width, window.height)
        check_size(
            size,
            cell * horizontal,
            lambda: _overview(rasterio, file, number, window, georeference, (horizontal, vertical)),
        )
        raw, mask = file.read(number, window=window), _seen(file, number, window)
        scale, shift = file.scales[number - 1], file.offsets[number - 1]
        tagged = file.nodatavals[number - 1] is not None
    heights = (raw.astype(np.float64) * scale + shift) * vertical
    mask &= np.isfinite(heights)
    if not tagged:
        mask, more = _without_outlier(heights, mask, raw)
        notes += more
    # Rows run from north to south and columns from west to east, unless a step says otherwise.
    height, valid = heights.T, mask.T
    west, south = step.c, step.f
    if step.a < 0.0:
        height, valid, west = height[::-1], valid[::-1], west + step.a * len(height)
    if step.e < 0.0:
        height, valid, south = height[:, ::-1], valid[:, ::-1], south + step.e * height.shape[1]
    # A georeference names the corner of a cell, a pile its centre.
    origin = horizontal * (np.array([west, south]) + 0.5 * cell)
    return Heightmap(
        height, cell * horizontal, origin, valid, crs=reference.name, notes=(*assumed, *notes)
    )


def _band(file: Any, wanted: int | None) -> tuple[int, tuple[str, ...]]:
    """The number of the band that holds the heights, and what is worth knowing of the choice."""
    kinds = [kind.name for kind in file.colorinterp]
    numbers = [k for k, kind in enumerate(kinds, 1) if kind not in _COLOURS and kind != "alpha"]
    if wanted is not None:
        if not 1 <= wanted <= file.count:
            raise InputError(f"has no band {wanted}: choose one of 1 to {file.count}.")
        numbers = [wanted] if wanted in numbers else []
    if not numbers:
        colours = ", ".join(kinds if wanted is None else [kinds[wanted - 1]])
        raise InputError(
            f"holds a picture ({colours}), not heights: give the elevation raster of the site."
        )
    if len(numbers) == 1:
        return numbers[0], ()
    named = [k for k in numbers if _HEIGHTS.search(file.descriptions[k - 1] or "")]
    reals = [k for k in numbers if np.dtype(file.dtypes[k - 1]).kind == "f"]
    for found in (named, reals):
        if len(found) == 1:
            return found[0], (f"band {found[0]} of {file.count} is taken for the heights",)
    raise InputError(
        f"has {file.count} bands and does not say which one holds the heights: choose it with "
        f"--band, from 1 to {file.count}."
    )


def _check_blocks(file: Any) -> None:
    """Refuse a file whose smallest part that can be read is larger than memory warrants."""
    together = file.count if file.interleaving.name == "pixel" else 1
    for (rows, columns), kind in zip(file.block_shapes, file.dtypes, strict=True):
        check_unpacked(rows * columns * np.dtype(kind).itemsize * together)


def _world_file(rasterio: Any, path: Path) -> Any:
    """The georeference of a world file beside a file; None if there is none that can be."""
    for place in (path.with_suffix(ending) for ending in _WORLD_FILES):
        try:
            with place.open("rb") as file:
                words = file.read(_LONGEST_WORLD_FILE).decode("ascii", "replace").split()
            a, d, b, e, x, y = (float(word.replace(",", ".")) for word in words[:6])
        except (OSError, ValueError):
            continue
        # It names the middle of the first cell, and not its corner.
        step = rasterio.Affine(a, b, x - 0.5 * (a + b), d, e, y - 0.5 * (d + e))
        if all(map(math.isfinite, step)):
            return step
    return None


def _window(rasterio: Any, file: Any, box: Box, step: Any) -> Any:
    """The cells whose centres lie inside a rectangle."""
    low, high = corners(box)
    ends = np.array([~step * tuple(low), ~step * tuple(high)]) - 0.5
    sides = (file.width, file.height)
    first = np.clip(np.ceil(ends.min(axis=0)), 0, sides).astype(int)
    stop = np.clip(np.floor(ends.max(axis=0)) + 1, 0, sides).astype(int)
    if (first >= stop).any():
        all_of_it = np.array([step * (0, 0), step * sides])
        raise nothing_inside(all_of_it.min(axis=0), all_of_it.max(axis=0))
    return rasterio.windows.Window(*map(int, first), *map(int, stop - first))


def _overview(
    rasterio: Any,
    file: Any,
    number: int,
    window: Any,
    georeference: Any,
    factors: tuple[float, float],
) -> str:
    """Where the piles are in a raster that is too large, read in wide cells."""
    from wlplan.io.overview import coarse_cell, where_piles_are

    horizontal, vertical = factors
    window = rasterio.windows.Window(0, 0, file.width, file.height) if window is None else window
    step = rasterio.windows.transform(window, georeference)
    # All of it would be read, for a word of advice.
    if step.a < 0.0 or step.e > 0.0 or window.width * window.height > MOST_UNPACKED:
        return ""
    cell = step.a * horizontal
    sides = np.array([window.width, window.height])
    times = max(1, round(coarse_cell(sides * cell) / cell))
    rows, columns = sides[1] // times, sides[0] // times
    window = rasterio.windows.Window(
        window.col_off, window.row_off, int(columns) * times, int(rows) * times
    )
    shape = (int(rows), int(columns))
    average = rasterio.enums.Resampling.average
    heights = file.read(
        number, window=window, out_shape=shape, resampling=average, masked=True, out_dtype=float
    )
    heights = heights * file.scales[number - 1] + file.offsets[number - 1]
    seen = ~np.ma.getmaskarray(heights) & np.isfinite(heights.filled(np.nan))
    origin = horizontal * np.array([step.c, step.f - int(rows) * times * step.a])
    return where_piles_are(
        np.where(seen, heights.filled(0.0) * vertical, 0.0)[::-1].T,
        seen[::-1].T,
        cell * times,
        origin + 0.5 * cell * times,
        unit=horizontal,
    )


def _seen(file: Any, number: int, window: Any) -> np.ndarray:
    """Cells that neither nodata nor an alpha band nor a mask leaves out, as the file has them."""
    seen: np.ndarray = file.read_masks(number, window=window) > 0
    # GDAL brings an alpha band to 8 bits, whatever that makes of small values.
    for k, kind in enumerate(file.colorinterp, 1):
        if kind.name == "alpha":
            seen = file.read(k, window=window) > 0
    return seen


def _without_outlier(
    heights: np.ndarray, seen: np.ndarray, raw: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Cells without those of a single value that lies far from all others, and a note of them."""
    values = np.unique(heights[seen])
    if len(values) < 3:
        return seen, ()
    for end, next_one in ((values[0], values[1]), (values[-1], values[-2])):
        if abs(end - next_one) > _APART:
            odd = seen & (heights == end)
            value = raw[odd].flat[0]
            return seen & ~odd, (
                f"{int(odd.sum())} cells hold {value:g} and count as unseen, though the file does "
                f"not say so",
            )
    return seen, ()
