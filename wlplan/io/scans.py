"""Scans on disk: height maps and point clouds.

The world frame of a scan is its own, x east, y north, z up, in metres. Coordinates of a survey are
too large for float32, so whole kilometres are taken off x and y when the map lies more than 10 km
from zero, and whole hundreds of metres off z when its lowest point is more than 100 m from zero:
the last digits of the survey's coordinates stay as they are.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import logging
import math
import os
import struct
import warnings
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import ndimage

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.io.files import check_is_file, named, one_line, write_bytes_atomic
from wlplan.terrain.floor import estimate_ground, fill_unseen
from wlplan.terrain.resampling import resample
from wlplan.types import Pile
from wlplan.xla import floats

# Shortest side of a map that a bucket with its surroundings fits into [m], a little more than the
# 3.6 m window of the models, and most cells a side that are taken.
_SHORTEST_SIDE = 4.0
_MOST_CELLS = 4000
# Largest difference in height on a map and largest coordinate [m]; beyond, units are wrong or a
# nodata value was taken for a height.
_MOST_RELIEF = 200.0
_FARTHEST = 1.0e8
# Coordinates above which whole kilometres, and heights above which whole hundreds of metres, are
# taken off [m]: float32 resolves 1 mm at the one and 0.01 mm at the other.
_FAR = 10_000.0
_HIGH = 100.0
# A point cloud is gridded at this many times its mean spacing where that is more than a cell: two
# points a cell leave few cells empty.
_SPACINGS = 1.5


@dataclasses.dataclass(frozen=True)
class _Scan:
    """A map as a file holds it, not yet checked."""

    height: np.ndarray  # [m]
    cell_size: float  # [m]
    origin: np.ndarray  # [m]
    valid: np.ndarray | None = None
    ground: np.ndarray | None = None  # [m]


def bundled_pile_path() -> Path:
    """Path of the pile that ships with the package, a published heightmap of a built soil mound."""
    return Path(str(resources.files("wlplan").joinpath("data", "marsyard2022_mound.npz")))


def read_pile(
    path: str | os.PathLike[str],
    *,
    ground: Float[Array | np.ndarray, "nx ny"] | float | None = None,
) -> Pile:
    """Read a pile and resample it to the grid spacing of the models, 0.1 m.

    Formats, by extension:

    * `.npz`: `height` [nx, ny] [m], `cell_size` [m], optional `origin` [2] [m] (centre of cell
      [0, 0]), `valid` bool [nx, ny] and `ground` [nx, ny] [m]. Axis 0 is x, axis 1 is y.
    * `.tif`, `.tiff`: GeoTIFF, band 1, square cells along the axes, metres. Nodata and NaN are
      unseen. A file without georeference is refused, since nothing tells its cell size.
    * `.las`, `.laz`, `.ply`: point clouds, x, y, z in metres, z up. The height of a cell is the
      median of its points; cells without points are unseen, but for single ones amid seen cells.

    Unseen cells are filled smoothly from seen ones; a fill that the file brings is kept where it
    lies within the range of the seen heights. Coordinates far from zero: see the module.

    Args:
        path: File to read.
        ground: Floor under the pile [m] in the file's frame: a level, or a map on the grid of the
            file. By default that of the file, else `terrain.floor.estimate_ground` finds it around
            the toe. It is lowered to the surface wherever it lies above.

    Returns:
        The pile on the 0.1 m grid, with its ground.

    Raises:
        InputError: If the file cannot be used; one line that says why and what to do.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: unknown kind of pile file {path.suffix!r}: use one of {', '.join(_READERS)}."
        )
    check_is_file(path, "pile")
    with named(path):
        try:
            with warnings.catch_warnings(), _silent("rasterio", "laspy"):
                warnings.simplefilter("ignore")
                scan = reader(path)
        except InputError:
            raise
        except Exception as error:
            # Damaged bytes make third-party readers raise almost anything, from zlib.error to
            # MemoryError; to the user they all mean the same.
            raise InputError(
                f"cannot be read as {path.suffix.lower()} ({one_line(error)}): the file is "
                f"damaged or cut short; copy or export it again."
            ) from error
        return _to_pile(scan, ground)


def _to_pile(scan: _Scan, ground: Array | np.ndarray | float | None) -> Pile:
    """Check a scan, fill its gaps, resample it and find its ground."""
    height, origin = _real("height", scan.height), _real("origin", scan.origin)
    if height.ndim != 2:
        raise InputError(f"`height` has shape {height.shape}: it has to be 2-D, x by y.")
    shape = height.shape
    _check_size(shape, scan.cell_size)
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

    floor = scan.ground if ground is None else ground
    if isinstance(floor, float | int):
        floor = np.full(shape, float(floor))
    if floor is not None:
        floor = _real("ground", floor)
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
    origin = origin - np.where(np.abs(centre) > _FAR, 1000.0 * np.floor(centre / 1000.0), 0.0)
    sea_level = 100.0 * math.floor(low / 100.0) if abs(low) > _HIGH else 0.0
    pile = resample(
        Pile(
            height=floats(height - sea_level),
            cell_size=scan.cell_size,
            origin=floats(origin),
            ground=None if floor is None else floats(floor - sea_level),
            valid=None if valid.all() else jnp.asarray(valid),
        ),
        CELL_SIZE,
    )
    if floor is None:
        found = floats(estimate_ground(pile.height, CELL_SIZE, pile.valid))
        pile = pile.replace(ground=jnp.minimum(found, pile.height))
    return pile.replace(cell_size=CELL_SIZE)


def _check_size(shape: tuple[int, ...], cell_size: float) -> None:
    """Refuse maps that no bucket fits into and maps that no memory holds."""
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
            f"and after resampling to {CELL_SIZE:g} m; crop it to the pile, or check the units."
        )


def _valid(valid: np.ndarray | None, shape: tuple[int, ...]) -> Bool[np.ndarray, "nx ny"]:
    if valid is None:
        return np.ones(shape, bool)
    if valid.shape != shape:
        raise InputError(f"`valid` has shape {valid.shape}, but `height` {shape}.")
    if valid.dtype != bool and not (valid.dtype.kind in "iuf" and np.isin(valid, (0, 1)).all()):
        raise InputError("`valid` holds values other than True and False: store it as bool.")
    return valid.astype(bool)


def _real(name: str, values: Any) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "iuf":
        raise InputError(f"`{name}` holds {values.dtype} values: store real numbers.")
    with np.errstate(invalid="ignore"):  # a NaN of damaged bytes may be a signalling one
        return values.astype(np.float64)


def _read_npz(path: Path) -> _Scan:
    with path.open("rb") as file:
        archive = np.load(file, allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise InputError("holds a single array: save it by np.savez with height and cell_size.")
        # Every field is read here, so that damage shows up here.
        fields = {name: archive[name] for name in archive.files}
    for name in ("height", "cell_size"):
        if name not in fields:
            raise InputError(
                f"has no field `{name}`, only {sorted(fields)}: save `height` [nx, ny] in metres "
                f"and `cell_size` in metres."
            )
    cell_size = _real("cell_size", fields["cell_size"])
    if cell_size.size != 1:
        raise InputError(f"`cell_size` has shape {cell_size.shape}: it has to be one number.")
    return _Scan(
        height=fields["height"],
        cell_size=float(cell_size.reshape(())),
        origin=fields.get("origin", np.zeros(2)),
        valid=fields.get("valid"),
        ground=fields.get("ground"),
    )


def _read_geotiff(path: Path) -> _Scan:
    rasterio = _optional("rasterio")
    with rasterio.open(path) as file:
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
        _check_size((file.width, file.height), cell)
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
    return _Scan(height, cell, origin, valid & ~np.isnan(height))


def _read_las(path: Path) -> _Scan:
    laspy = _optional("laspy")
    _check_las_header(path)
    try:
        with _mute_stderr():
            # The parallel decompressor would set aside memory for as many points as a damaged
            # chunk size asks for.
            cloud = laspy.read(path, laz_backend=laspy.LazBackend.Lazrs)
    except BaseException as error:
        # A panic of the decompressor, which is written in Rust, is no `Exception`.
        if type(error).__name__ != "PanicException":
            raise
        raise RuntimeError(str(error)) from error
    return _grid(np.stack([np.asarray(cloud[axis], np.float64) for axis in "xyz"], axis=-1))


def _check_las_header(path: Path) -> None:
    """Refuse counts that the file has no room for.

    Their readers take them at their word: a damaged one runs for hours, or asks for more memory
    than there is, which ends the process.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(255).ljust(255, b"\0")
        # LAS 1.4 R15, table 3: where the points begin, the numbers of records and of points.
        start, records, record_size, points = struct.unpack_from("<IIxHI", head, 96)
        more_records, more_points = 0, 0
        if head[25] >= 4:
            more_records, more_points = struct.unpack_from("<IQ", head, 243)
        # The headers of records take 54 and 60 bytes.
        whole = head[:4] == b"LASF" and 54 * records <= start <= size - 8 >= 60 * more_records
        points = max(points, more_points)
        if whole and path.suffix.lower() == ".laz":
            # The points begin with the place of the table of chunks, which begins with a version
            # and their number; each chunk opens with a point as it is. Compression is not known
            # to save more than 99.9 %.
            file.seek(start)
            (table,) = struct.unpack("<q", file.read(8))
            whole = start < table <= size - 8 and points * record_size <= 1000 * size
            if whole:
                file.seek(table)
                _, chunks = struct.unpack("<II", file.read(8))
                whole = chunks * record_size <= size
        elif whole:
            whole = points * record_size <= size - start
    if not whole:
        raise InputError("is damaged or cut short, or no LAS file: copy or export it again.")


# The number types of a PLY header, as numpy's.
_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


def _read_ply(path: Path) -> _Scan:
    """Read the vertices of an ascii or binary PLY file; they have to come first, as they do."""
    head, end, body = path.read_bytes().partition(b"end_header")
    # The header ends with its line, whose break may be one or two bytes.
    _, _, body = body.partition(b"\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not end or not lines or lines[0] != ["ply"]:
        raise InputError("has no PLY header: export it again as PLY, LAS or .npz.")
    encoding = next((line[1] for line in lines if line[:1] == ["format"]), "")
    first = next((k for k, line in enumerate(lines) if line[:1] == ["element"]), len(lines))
    if lines[first : first + 1] == [] or lines[first][1] != "vertex":
        raise InputError("does not begin with its vertices: export it as a plain point cloud.")
    count, fields = int(lines[first][2]), []
    for line in lines[first + 1 :]:
        if line[:1] == ["element"]:
            break
        if line[:1] == ["property"]:
            if line[1] not in _PLY_TYPES:
                raise InputError(
                    f"has vertices of type {line[1]!r}: export plain x, y, z vertices."
                )
            fields.append((line[2], _PLY_TYPES[line[1]]))
    if not {"x", "y", "z"} <= {name for name, _ in fields}:
        raise InputError("has no x, y and z: export it with point coordinates.")
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(encoding)
    if order is not None:
        record = np.dtype([(name, order + kind) for name, kind in fields])
        points = np.frombuffer(body[: count * record.itemsize], record)
        columns = [points[axis].astype(np.float64) for axis in "xyz"]
    elif encoding == "ascii":
        words = np.array(body.split(None, count * len(fields))[: count * len(fields)], dtype=float)
        table = words.reshape(-1, len(fields))
        names = [name for name, _ in fields]
        columns = [table[:, names.index(axis)] for axis in "xyz"]
    else:
        raise InputError(f"is PLY of unknown format {encoding!r}: export it as ascii or binary.")
    if len(columns[0]) != count:
        raise InputError(f"is cut short: {len(columns[0])} of {count} points; copy it again.")
    return _grid(np.stack(columns, axis=-1))


def _grid(points: Float[np.ndarray, "n 3"]) -> _Scan:
    """Put a point cloud on a grid: the median height of each cell that has points."""
    points = points[np.isfinite(points).all(axis=-1)]
    if len(points) < 3:
        raise InputError("has fewer than three points: export the point cloud again.")
    low = points.min(axis=0)[:2]
    extent = np.maximum(points.max(axis=0)[:2] - low, 1e-3)
    cell = max(CELL_SIZE, _SPACINGS * math.sqrt(float(np.prod(extent)) / len(points)))
    # Points on a regular grid land amid the cells, not on their borders.
    shape = tuple(int(n) for n in np.rint(extent / cell) + 1)
    _check_size(shape, cell)
    index = np.ravel_multi_index(tuple(np.rint((points[:, :2] - low) / cell).astype(int).T), shape)
    order = np.lexsort((points[:, 2], index))
    cells, start, count = np.unique(index[order], return_index=True, return_counts=True)
    height = np.full(shape, np.nan)
    height.flat[cells] = points[order, 2][start + (count - 1) // 2]
    seen = np.isfinite(height)
    padded = ndimage.binary_closing(np.pad(seen, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    height = fill_unseen(height, seen)
    return _Scan(height, cell, low, seen | padded)


_READERS: dict[str, Callable[[Path], _Scan]] = {
    ".npz": _read_npz,
    ".tif": _read_geotiff,
    ".tiff": _read_geotiff,
    ".las": _read_las,
    ".laz": _read_las,
    ".ply": _read_ply,
}


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


def _optional(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"needs {name}, which is not installed: run `pip install wlplan[scan]`."
        ) from error


@contextlib.contextmanager
def _silent(*names: str) -> Iterator[None]:
    """Keep libraries from logging a second line about a file that we refuse in one."""
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.disabled for logger in loggers]
    try:
        for logger in loggers:
            logger.disabled = True
        yield
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


@contextlib.contextmanager
def _mute_stderr() -> Iterator[None]:
    """Send what other languages' libraries write to the process's stderr to nowhere."""
    keep = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(keep, 2)
        os.close(keep)
        os.close(nowhere)
