"""Piles on disk: what the readers find in a file is checked and put on the grid of the models.

The world frame of a scan is its own, x east, y north, z up, in metres. Coordinates of a survey are
too large for float32, so whole kilometres are taken off x and y when the map lies more than 10 km
from zero, and whole hundreds of metres off z when its lowest point is more than 100 m from zero:
the last digits of the survey's coordinates stay as they are.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import warnings
from collections.abc import Collection, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError, one_line
from wlplan.io.clouds import grid_points
from wlplan.io.contents import Contents, contents_of
from wlplan.io.files import check_is_file, named, write_bytes_atomic
from wlplan.io.floors import floor_of
from wlplan.io.overview import averaged, coarse_cell, where_piles_are
from wlplan.io.readers import find_reader
from wlplan.io.scans import Heightmap, PointCloud, Scan, check_size, corners, crop, real_numbers
from wlplan.io.upright import upright
from wlplan.site.frame import Frame
from wlplan.terrain.floor import fill_unseen
from wlplan.terrain.resampling import resample
from wlplan.types import Pile
from wlplan.xla import floats

# Largest difference in height on a map and largest coordinate [m]; beyond, units are wrong or a
# nodata value was taken for a height.
_MOST_RELIEF = 200.0
_FARTHEST = 1.0e8
# Coordinates above which whole kilometres, and heights above which whole hundreds of metres, are
# taken off [m]: float32 resolves 1 mm at the one and 0.01 mm at the other.
_FAR = 10_000.0
# Options that say what a scan holds, see `contents_of`.
_OF_CONTENTS = ("keep_out", "include", "pile")
# Slope of the ground as a whole above which a note says so [degrees].
_SLOPING = 5.0
_HIGH = 100.0
# Options that every file takes, and the part by which a crop is wider for the scan of a floor.
_ALL_TAKE = ("crop", "up")
_MARGIN = 0.1


def bundled_pile_path() -> Path:
    """Path of the pile that ships with the package, a published heightmap of a built soil mound."""
    return Path(str(resources.files("wlplan").joinpath("data", "marsyard2022_mound.npz")))


@dataclasses.dataclass(frozen=True)
class ScannedPile:
    """What was read from a file.

    Attributes:
        pile: The pile, on the grid of the models, in its local frame.
        frame: How that lies to the coordinates of the file, and their reference system.
        notes: What was assumed, converted or left out, in words: sentences without their stops.
        contents: Structures, piles and areas; the ground of the pile holds all that is not dug.
    """

    pile: Pile
    frame: Frame
    notes: tuple[str, ...]
    contents: Contents


def read_pile(
    path: str | os.PathLike[str],
    *,
    ground: Float[Array | np.ndarray, "nx ny"] | float | str | os.PathLike[str] | None = None,
    **options: Any,
) -> Pile:
    """Read a pile and resample it to the grid spacing of the models, 0.1 m.

    As `read_scan`, whose notes go unsaid.

    Args:
        path: As there.
        ground: As there.
        options: As there.

    Returns:
        The pile on the 0.1 m grid, with its ground.

    Raises:
        InputError: If the file cannot be used; one line that says why and what to do.
    """
    return read_scan(path, ground=ground, **options).pile


def read_scan(
    path: str | os.PathLike[str],
    *,
    ground: Float[Array | np.ndarray, "nx ny"] | float | str | os.PathLike[str] | None = None,
    **options: Any,
) -> ScannedPile:
    """Read a pile, with what is worth knowing of its file.

    The ending of the name decides the format. Height maps are `.npz`, GeoTIFF, ESRI ASCII grids and
    the maps of grid_map in recordings of ROS; point clouds LAS, LAZ, PLY, PCD, E57 and text; meshes
    OBJ and STL. Lengths in other units are converted to metres where the file names them. The
    modules of `wlplan.io.readers`, one for each format, say what a file has to hold;
    `wlplan.io.register_reader` takes more of them. The height of a cell of a point cloud is the
    median of its points, that of a mesh its highest face; cells without any are unseen, but for
    single ones amid seen cells.

    Unseen cells are filled smoothly from seen ones; a fill that the file brings is kept where it
    lies within the range of the seen heights. Coordinates far from zero: see the module.

    Args:
        path: File to read.
        ground: Floor under the pile [m] in the file's frame: a level, a map on the grid of the
            file, or the path of a scan of the floor in the same coordinates, in any format that is
            read; where that one saw nothing the floor is estimated. By default that of the file,
            else `terrain.floor.estimate_ground` finds it around the toe. It is lowered to the
            surface wherever it lies above.
        options: `crop`, the rectangle that is read: x and y of two opposite corners, in the
            coordinates of the file. `up`, the axis of a point cloud or mesh that is up, such as
            "y", which is turned to be z before anything else, the crop too. Others are for the
            reader of the format, which names them in `OPTIONS`: `band` of a GeoTIFF, `layer` of a
            grid_map. And, in the coordinates of the scan in metres, `keep_out`, a GeoJSON file of
            areas; `include`, x and y of a structure that is soil; `pile`, x and y of the pile that
            is dug, by default the largest; asked for, it is the only one that is soil.

    Returns:
        The pile on the 0.1 m grid, with its ground, and the notes.

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
        pile, frame, contents, notes = _to_pile(scan, floor, of_contents)
        notes = (*scan.notes, *notes, *_sloping(contents.floor, CELL_SIZE), *contents.notes)
        return ScannedPile(pile, frame, notes, contents)


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


def _to_pile(
    scan: Heightmap,
    ground: Array | np.ndarray | float | tuple[Path, Heightmap] | None,
    of_contents: Mapping[str, Any],
) -> tuple[Pile, Frame, Contents, tuple[str, ...]]:
    """Check a scan, fill its gaps, resample it and find what it holds; with notes of its floor."""
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
    pile = resample(
        Pile(
            height=floats(height - sea_level),
            cell_size=scan.cell_size,
            origin=floats(origin - offset),
            ground=None if floor is None else floats(floor - sea_level),
            valid=None if valid.all() else jnp.asarray(valid),
        ),
        CELL_SIZE,
    )
    given = None
    if floor is not None and not known_floor.all():
        whole = Pile(height=floats(floor), cell_size=scan.cell_size, valid=jnp.asarray(known_floor))
        given = np.asarray(resample(whole, CELL_SIZE).valid)
    contents = contents_of(
        np.asarray(pile.height, np.float64),
        None if pile.ground is None else np.asarray(pile.ground, np.float64),
        None if pile.valid is None else np.asarray(pile.valid),
        CELL_SIZE,
        np.asarray(pile.origin, np.float64),
        frame,
        known_ground=given,
        **of_contents,
    )
    surface = floats(contents.height)
    lowered = jnp.minimum(floats(contents.ground), surface)
    pile = pile.replace(height=surface, ground=lowered, cell_size=CELL_SIZE)
    return pile, frame, contents, notes


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


def write_pile(path: str | os.PathLike[str], pile: Pile) -> None:
    """Write one pile as .npz, in the format of `read_pile`, in one piece or not at all.

    The ground is always written, so that reading does not estimate it anew.

    Raises:
        InputError: If the name does not end in .npz or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise InputError(f"{path}: piles are written as .npz: choose a name with that ending.")
    fields: dict[str, Any] = {
        "height": np.asarray(pile.height),
        "cell_size": np.float64(pile.cell_size),
        "origin": np.asarray(pile.origin),
        "ground": np.asarray(pile.floor),
    }
    if pile.valid is not None:
        fields["valid"] = np.asarray(pile.valid)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **fields)
    write_bytes_atomic(path, buffer.getvalue())
