"""`.las`, `.laz`: LAS point clouds, plain or compressed; x, y, z, z up.

Lengths are converted to metres from the units of the reference system, WKT or GeoTIFF keys. Points
that their classes call noise or no soil, and those that are withheld, are left out. They are read
part by part, and kept as the integers that the file has.
"""

from __future__ import annotations

import collections
import dataclasses
import struct
from pathlib import Path
from typing import Any

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library, mute_stderr
from wlplan.io.limits import check_points
from wlplan.io.reference import Reference, length_unit_of_code, reference_of
from wlplan.io.scans import Box, PointCloud, nothing_inside, points_inside

ENDINGS = (".las", ".laz")
OPTIONS = ("crop",)

# Classes of points that lie on no soil: LAS 1.4 R15, table 17.
_NOT_SOIL = {
    **{3: "low vegetation", 4: "medium vegetation", 5: "high vegetation", 6: "building"},
    **{7: "noise", 9: "water", 13: "wire guard", 14: "wire", 15: "transmission tower"},
    **{16: "wire connector", 17: "bridge deck", 18: "high noise", 19: "overhead structure"},
}
# Keys of a GeoTIFF directory and values of the first: OGC GeoTIFF 1.1, annex A. A code of a system
# or a unit is a number of the EPSG registry; beyond the last one the file defines its own.
_MODEL, _GEOGRAPHIC, _PROJECTED, _PLAN_UNIT, _VERTICAL, _HEIGHT_UNIT = (
    *(1024, 2048, 3072, 3076, 4096, 4099),
)
_DEGREES, _EARTH_CENTRED = 2, 3
_LAST_CODE = 32766
# Bytes and points that are read at once, and points that say where the middle of all is.
_BYTES_AT_ONCE, _AT_ONCE, _SOME = 1 << 28, 1 << 20, 1 << 20


def read(path: Path, *, crop: Box | None = None) -> PointCloud:
    """Read the points that lie on soil, as far as their classes say.

    Args:
        path: File to read.
        crop: Rectangle outside of which points are left out, in the coordinates of the file.

    Raises:
        InputError: If laspy or pyproj is missing, the file has no room for what its header counts,
            its coordinates are no lengths on the ground, or no point is left.
    """
    with library("laspy", install="wlplan[scan]") as laspy:
        _check_header(path)
        try:
            # The parallel decompressor would set aside memory for as many points as a damaged chunk
            # size asks for.
            backend = laspy.LazBackend.Lazrs
            with mute_stderr(), laspy.open(path, laz_backend=backend) as file:
                header = file.header
                points, left_out = _on_soil(file, crop)
        except BaseException as error:
            # A panic of the decompressor, which is written in Rust, is no `Exception`.
            if type(error).__name__ != "PanicException":
                raise
            raise RuntimeError(str(error)) from error
        scale, offset = np.asarray(header.scales), np.asarray(header.offsets)
        middle = (0.0, 0.0)
        if len(points):
            some = points[:: len(points) // _SOME + 1, :2] * scale[:2] + offset[:2]
            middle = (float(np.median(some[:, 0])), float(np.median(some[:, 1])))
        reference = _reference(header, middle)
    horizontal, vertical, assumed = reference.factors()
    factors = np.array([horizontal, horizontal, vertical])
    return PointCloud(
        points,
        crs=reference.name,
        notes=(*assumed, *left_out),
        scale=scale * factors,
        offset=offset * factors,
        unit=horizontal,
    )


def _on_soil(file: Any, crop: Box | None) -> tuple[np.ndarray, tuple[str, ...]]:
    """The points that lie on soil, as the integers of the file, and what was left out, in words."""
    parts = [np.empty((0, 3), np.int32)]
    counts: collections.Counter[str] = collections.Counter()
    total, low, high = 0, np.full(2, np.inf), np.full(2, -np.inf)
    # A point may bring as much of its own as 64 KiB.
    at_once = max(1, min(_AT_ONCE, _BYTES_AT_ONCE // file.header.point_format.size))
    for record in file.chunk_iterator(at_once):
        points = np.stack([np.asarray(record[axis]) for axis in "XYZ"], axis=-1)
        if crop is not None:
            places = np.stack([np.asarray(record[axis], np.float64) for axis in "xy"], axis=-1)
            low, high = (
                np.minimum(low, places.min(axis=0)),
                np.maximum(high, places.max(axis=0)),
            )
            inside = points_inside(places, crop)
            points, record = points[inside], record[inside]
        total += len(points)
        classes, withheld = np.asarray(record.classification), np.asarray(record.withheld, bool)
        numbers = np.bincount(classes[~withheld], minlength=256)
        counts += collections.Counter(
            {f"{name} (class {k})": int(numbers[k]) for k, name in _NOT_SOIL.items()}
        )
        counts += collections.Counter({"withheld": int(withheld.sum())})
        parts.append(points[~(withheld | np.isin(classes, list(_NOT_SOIL)))])
    if crop is not None and not total and low[0] <= high[0]:
        raise nothing_inside(low, high)
    points = _joined(parts)
    names = [*(f"{name} (class {k})" for k, name in _NOT_SOIL.items()), "withheld"]
    words = [f"{counts[name]} of {name}" for name in names if counts[name]]
    if not words:
        return points, ()
    left = f"of {total} points: {', '.join(words)}"
    if not len(points):
        raise InputError(f"holds nothing of a pile, {left}; classify its soil as ground.")
    return points, (f"left out, {left}",)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """All parts in one array; the list is emptied on the way, so that they are in memory once."""
    whole = np.empty((sum(map(len, parts)), 3), parts[0].dtype)
    start = len(whole)
    while parts:
        part = parts.pop()
        start -= len(part)
        whole[start : start + len(part)] = part
    return whole


def _reference(header: Any, middle: tuple[float, float]) -> Reference:
    """What the records of a file say about its coordinates; WKT goes before GeoTIFF keys."""
    records = [*header.vlrs, *(header.evlrs or [])]
    ours = [record for record in records if record.user_id.strip("\0 ") == "LASF_Projection"]
    for record in ours:
        if record.record_id == 2112 and (text := _text(record)):
            return reference_of(text, middle)
    for record in ours:
        if record.record_id == 34735:
            return _reference_of_keys(record.record_data_bytes(), middle)
    return Reference()


def _text(record: Any) -> str:
    content: bytes = record.record_data_bytes()
    return content.partition(b"\0")[0].decode("utf-8", "replace").strip()


def _reference_of_keys(content: bytes, middle: tuple[float, float]) -> Reference:
    """What a directory of GeoTIFF keys says about coordinates."""
    shorts = np.frombuffer(content[: len(content) // 8 * 8], "<u2").reshape(-1, 4)
    # The first entry is the head; of the others those are short values whose place is 0.
    keys = {int(key): int(value) for key, place, _, value in shorts[1:] if place == 0}
    plan, up = (
        length_unit_of_code(keys[key]) if 0 < keys.get(key, 0) <= _LAST_CODE else None
        for key in (_PLAN_UNIT, _HEIGHT_UNIT)
    )
    if keys.get(_MODEL) == _EARTH_CENTRED:
        raise InputError("has earth-centred coordinates: project it to a metric system.")
    if keys.get(_MODEL) == _DEGREES:
        return reference_of(keys.get(_GEOGRAPHIC, 4326), middle)
    reference = Reference(horizontal=plan)
    if 0 < keys.get(_PROJECTED, 0) <= _LAST_CODE:
        reference = reference_of(keys[_PROJECTED], middle, horizontal=plan)
    if up is None and 0 < keys.get(_VERTICAL, 0) <= _LAST_CODE:
        up = reference_of(keys[_VERTICAL], middle).vertical
    return reference if up is None else dataclasses.replace(reference, vertical=up)


def _check_header(path: Path) -> None:
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
            # and their number; each chunk opens with a point as it is.
            file.seek(start)
            (table,) = struct.unpack("<q", file.read(8))
            whole = start < table <= size - 8
            if whole:
                file.seek(table)
                _, chunks = struct.unpack("<II", file.read(8))
                whole = chunks * record_size <= size
        elif whole:
            whole = points * record_size <= size - start
    if whole:
        check_points(points, size)
    else:
        raise InputError("is damaged or cut short, or no LAS file: copy or export it again.")
