"""What the readers find in a file, checked and put on the grid of the models; without JAX.

The world frame of a scan is its own, x east, y north, z up, in metres. Coordinates of a survey are
too large for float32, so whole kilometres are taken off x and y when the map lies more than 10 km
from zero, and whole hundreds of metres off z when its lowest point is more than 100 m from zero:
the last digits of the survey's coordinates stay as they are.
"""

from __future__ import annotations

import dataclasses
import math
import os
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError, one_line
from wlplan.io.clouds import grid_points
from wlplan.io.contents import Contents, contents_of
from wlplan.io.files import check_is_file, named
from wlplan.io.floors import floor_of
from wlplan.io.overview import averaged, coarse_cell, where_piles_are
from wlplan.io.readers import find_reader
from wlplan.io.scans import Heightmap, PointCloud, Scan, check_size, corners, crop, real_numbers
from wlplan.io.upright import upright
from wlplan.site.frame import Frame
from wlplan.terrain.floor import fill_unseen
from wlplan.terrain.grid import Grid, regrid

# Largest difference in height on a map and largest coordinate [m]; beyond, units are wrong or a
# nodata value was taken for a height.
_MOST_RELIEF = 200.0
_FARTHEST = 1.0e8
# Coordinates above which whole kilometres, and heights above which whole hundreds of metres, are
# taken off [m]: float32 resolves 1 mm at the one and 0.01 mm at the other.
_FAR = 10_000.0
# Options that say what a scan holds, see `contents_of`.
_OF_CONTENTS = ("keep_out", "truck_area", "include", "pile")
# Slope of the ground as a whole above which a note says so [degrees].
_SLOPING = 5.0
_HIGH = 100.0
# Options that every file takes, and the part by which a crop is wider for the scan of a floor.
_ALL_TAKE = ("crop", "up")
_MARGIN = 0.1


@dataclasses.dataclass(frozen=True)
class Survey:
    """What was read from a file, on the grid of the models.

    Attributes:
        grid: Heights, the ground that cannot be moved, and what the scan saw, in a local frame.
        frame: How that lies to the coordinates of the file, and their reference system.
        notes: What was assumed, converted or left out, in words: sentences without their stops.
        contents: Structures, piles and areas; the ground of the pile holds all that is not dug.
        scanned_cell: Side of the cells before they were put on that grid [m].
    """

    grid: Grid
    frame: Frame
    notes: tuple[str, ...]
    contents: Contents
    scanned_cell: float


def read_survey(
    path: str | os.PathLike[str],
    *,
    ground: Float[np.ndarray, "nx ny"] | float | str | os.PathLike[str] | None = None,
    dtype: np.dtype | type = np.float32,
    **options: Any,
) -> Survey:
    """Read a file without JAX.

    Args:
        path: As of `wlplan.io.read_scan`, as are the others.
        ground: As there.
        dtype: Of the heights.
        options: As there.

    Raises:
        InputError: If the file cannot be used; one line that says why and what to do.
    """
    path = Path(path)
    of_contents = {name: options.pop(name) for name in _OF_CONTENTS if name in options}
    scan = _heights(path, options)
    floor: Any = ground
    if isinstance(ground, str | os.PathLike):
        floor = _ground_scan(Path(ground), scan, path, options)
    with named(path):
        return _surveyed(scan, floor, of_contents, np.dtype(dtype))


def _heights(path: Path, options: Mapping[str, Any]) -> Heightmap:
    """What a file holds, on its own grid and not yet checked."""
    reader = find_reader(path)
    check_is_file(path, "pile")
    with named(path):
        taken = getattr(reader, "OPTIONS", ())
        for name in options:
            if name not in (*taken, *_ALL_TAKE):
                raise InputError(f"there is no {name} to choose in {path.suffix} files.")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read: Any = reader.read
                # Turned first, then cropped: a reader that only crops leaves that to us.
                own = {name for name in options if name in taken}
                if "up" in options and "up" not in taken:
                    own -= {"crop"}
                scan = read(path, **{name: options[name] for name in own})
                scan = _turned_and_cropped(scan, options, taken, own)
                if isinstance(scan, PointCloud):
                    scan = grid_points(scan)
        except InputError:
            raise
        except Exception as error:
            # Damaged bytes make third-party readers raise almost anything, from zlib.error to
            # MemoryError; to the user they all mean the same.
            raise InputError(
                f"cannot be read as {path.suffix.lower()} ({one_line(error)}): the file is "
                f"damaged or cut short; copy or export it again."
            ) from error
        if not isinstance(scan, Heightmap):
            raise TypeError(f"The reader of {path} returned {scan!r}: not a Heightmap, PointCloud.")
        return scan


def _turned_and_cropped(
    scan: Any, options: Mapping[str, Any], taken: Collection[str], own: Collection[str]
) -> Any:
    """A scan after what its reader left of the options that all files take."""
    if isinstance(scan, PointCloud) and "up" not in taken:
        scan = upright(scan, options.get("up"))
    elif isinstance(scan, Heightmap) and options.get("up", "z") != "z" and "up" not in own:
        raise InputError("is a height map, which has z up: leave out --up.")
    if "crop" in options and "crop" not in own and isinstance(scan, Scan):
        scan = crop(scan, options["crop"])
    return scan


def _ground_scan(
    path: Path, scan: Heightmap, of: Path, options: Mapping[str, Any]
) -> tuple[Path, Heightmap]:
    """The scan of the floor under another one, which is named `of`, and its place."""
    # The same part, and a bit around it: cells at the border have neighbours there.
    options = {name: options[name] for name in _ALL_TAKE if name in options}
    if path.suffix.lower() != of.suffix.lower():
        options.pop("up", None)
    if "crop" in options:
        low, high = corners(options["crop"])
        margin = _MARGIN * (high - low)
        options["crop"] = (*(low - margin), *(high + margin))
    ground = _heights(path, options)
    if None not in (ground.crs, scan.crs) and ground.crs != scan.crs:
        raise InputError(
            f"{path}: is in {ground.crs}, but {of} in {scan.crs}: project one of them."
        )
    with named(path):
        # Checked as a pile is.
        check_size(ground.height.shape, ground.cell_size)
        seen = _valid(ground.valid, ground.height.shape)
        seen &= np.isfinite(real_numbers("height", ground.height))
        if not seen.any():
            raise InputError("no cell counts as seen: check the mask or the nodata value.")
    return path, dataclasses.replace(ground, valid=seen)


def _sloping(floor: Float[np.ndarray, "nx ny"], cell_size: float) -> tuple[str, ...]:
    """A note where the ground as a whole slopes more than yards do."""
    ground = np.asarray(floor, np.float64)
    axes = [np.linspace(-0.5 * n, 0.5 * n, n) * cell_size for n in ground.shape]
    # Least squares on a grid: the axes are apart from each other.
    rises = [(axes[k] * ground.mean(axis=1 - k)).sum() / (axes[k] ** 2).sum() for k in (0, 1)]
    slope = math.degrees(math.atan(math.hypot(*rises)))
    if slope <= _SLOPING:
        return ()
    return (f"the ground slopes by {slope:.0f} degrees: level the scan if the site does not",)


def _surveyed(
    scan: Heightmap,
    ground: np.ndarray | float | tuple[Path, Heightmap] | None,
    of_contents: Mapping[str, Any],
    dtype: np.dtype,
) -> Survey:
    """Check a scan, fill its gaps, resample it and find what it holds."""
    height, origin = real_numbers("height", scan.height), real_numbers("origin", scan.origin)
    if height.ndim != 2:
        raise InputError(f"`height` has shape {height.shape}: it has to be 2-D, x by y.")
    shape = height.shape
    check_size(shape, scan.cell_size, lambda: _overview(scan, height, origin))
    if origin.shape != (2,) or not (np.abs(origin) <= _FARTHEST).all():
        raise InputError("`origin` has to be x and y of the first cell, two numbers in metres.")
    valid = _valid(scan.valid, shape)
    bad = int(np.sum(valid & ~np.isfinite(height)))
    if bad:
        raise InputError(
            f"`height` is NaN or infinite in {bad} cells that count as seen: mark them as unseen "
            f"(False in `valid`, or nodata)."
        )
    if not valid.any():
        raise InputError("no cell counts as seen: check the mask or the nodata value.")
    low, high = float(height[valid].min()), float(height[valid].max())
    if not (high - low <= _MOST_RELIEF and abs(low) <= _FARTHEST):
        raise InputError(
            f"the heights run from {low:.6g} to {high:.6g} m, which is no pile: check the units "
            f"and the nodata value."
        )
    with np.errstate(invalid="ignore"):
        known = valid | ((height >= low) & (height <= high))
    height = fill_unseen(height, known)

    floor: Any = scan.ground if ground is None else ground
    known_floor = np.ones(shape, bool)
    notes: tuple[str, ...] = ()
    if isinstance(floor, tuple):
        place, known_scan = floor
        with named(place):
            floor, notes = floor_of(known_scan, height, valid, scan.cell_size, origin)
        notes += tuple(f"of the floor: {note}" for note in known_scan.notes)
        known_floor = np.isfinite(floor)
        floor = np.where(known_floor, floor, height)
    if isinstance(floor, float | int):
        floor = np.full(shape, float(floor))
    if floor is not None:
        floor = real_numbers("ground", floor)
        if floor.shape != shape:
            raise InputError(f"`ground` has shape {floor.shape}, but `height` {shape}.")
        if not (np.abs(floor[valid] - low) <= _MOST_RELIEF).all():
            raise InputError(
                f"`ground` is NaN or more than {_MOST_RELIEF:g} m off the surface in cells that "
                f"count as seen: check its units, or leave it out."
            )
        known = np.abs(floor - low) <= _MOST_RELIEF
        floor = np.minimum(fill_unseen(floor, known), height)

    centre = origin + 0.5 * scan.cell_size * np.array(shape)
    offset = np.where(np.abs(centre) > _FAR, 1000.0 * np.floor(centre / 1000.0), 0.0)
    sea_level = 100.0 * math.floor(low / 100.0) if abs(low) > _HIGH else 0.0
    frame = Frame((float(offset[0]), float(offset[1]), sea_level), scan.crs)
    read = Grid(
        height=(height - sea_level).astype(dtype),
        cell_size=scan.cell_size,
        origin=(origin - offset).astype(dtype),
        ground=None if floor is None else (floor - sea_level).astype(dtype),
        valid=None if valid.all() else valid,
    )
    grid = regrid(read, CELL_SIZE)
    given = None
    if floor is not None and not known_floor.all():
        known_cells = Grid(floor.astype(dtype), scan.cell_size, read.origin, valid=known_floor)
        given = regrid(known_cells, CELL_SIZE).valid
    contents = contents_of(
        grid.height.astype(np.float64),
        None if grid.ground is None else grid.ground.astype(np.float64),
        grid.valid,
        CELL_SIZE,
        grid.origin.astype(np.float64),
        frame,
        known_ground=given,
        **of_contents,
    )
    surface = contents.height.astype(dtype)
    grid = dataclasses.replace(
        grid,
        height=surface,
        ground=np.minimum(contents.ground.astype(dtype), surface),
        cell_size=CELL_SIZE,
    )
    notes = (*scan.notes, *notes, *_sloping(contents.floor, CELL_SIZE), *contents.notes)
    return Survey(grid, frame, notes, contents, float(scan.cell_size))


def _overview(
    scan: Heightmap, height: Float[np.ndarray, "nx ny"], origin: Float[np.ndarray, "2"]
) -> str:
    """Where the piles are in a map that is too large."""
    shape = np.array(height.shape)
    times = max(1, round(coarse_cell(shape * scan.cell_size) / scan.cell_size))
    if origin.shape != (2,) or (shape < times).any():
        return ""
    seen = _valid(scan.valid, height.shape) & np.isfinite(height)
    means, covered = averaged(height, seen, times)
    first = origin + 0.5 * (times - 1) * scan.cell_size
    return where_piles_are(means, covered, times * scan.cell_size, first)


def _valid(valid: np.ndarray | None, shape: tuple[int, ...]) -> Bool[np.ndarray, "nx ny"]:
    if valid is None:
        return np.ones(shape, bool)
    if valid.shape != shape:
        raise InputError(f"`valid` has shape {valid.shape}, but `height` {shape}.")
    if valid.dtype != bool and not (valid.dtype.kind in "iuf" and np.isin(valid, (0, 1)).all()):
        raise InputError("`valid` holds values other than True and False: store it as bool.")
    return valid.astype(bool)
