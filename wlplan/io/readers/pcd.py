"""`.pcd`: point clouds of the Point Cloud Library; x, y, z in metres, z up.

Text, binary and compressed ones. Points that are NaN, as those without a return are, are left out.
The format has no place for a unit, so a note says what is assumed. A viewpoint is not applied: a
note says so. Source: the description of the format of PCL, version 0.7.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library
from wlplan.io.limits import check_unpacked
from wlplan.io.reference import Reference
from wlplan.io.scans import PointCloud

ENDINGS = (".pcd",)

_KINDS = {"F": "f", "I": "i", "U": "u"}
# Longest head, and what LZF, the compression, saves at most: 264 bytes for every 3.
_LONGEST_HEAD, _MOST_SAVED = 1 << 16, 100
_AT_HOME = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def read(path: Path) -> PointCloud:
    """Read the points.

    Raises:
        InputError: If the head has no x, y and z, or there are fewer points than it says; or a
            compressed file is read without an LZF library.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = _head(file)
        record, count = _record(head)
        room = size - file.tell()
        encoding = head["DATA"][0]
        if encoding == "ascii":
            points = _from_text(file, record, count)
        elif encoding == "binary":
            if count * record.itemsize > room:
                raise _cut_short(room // record.itemsize, count)
            table = np.frombuffer(file.read(count * record.itemsize), record)
            points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)
        elif encoding == "binary_compressed":
            points = _from_compressed(file, record, count)
        else:
            raise InputError(f"is PCD of unknown kind {encoding!r}: export it as binary.")
    _, _, notes = Reference().factors()
    viewpoint = tuple(map(float, head.get("VIEWPOINT", [])))
    if viewpoint not in ((), _AT_HOME):
        words = " ".join(f"{value:g}" for value in viewpoint)
        notes += (f"the viewpoint of the file ({words}) is not applied to its points",)
    return PointCloud(points, notes=notes)


def _head(file: BinaryIO) -> dict[str, list[str]]:
    """The lines of the head, by their first words; the file then stands at its data."""
    head: dict[str, list[str]] = {}
    while file.tell() < _LONGEST_HEAD:
        line = file.readline(_LONGEST_HEAD)
        words = line.decode("ascii", "replace").split()
        if not line or "\0" in words:
            break
        if words and not words[0].startswith("#"):
            head[words[0].upper()] = words[1:]
        if words and words[0].upper() == "DATA" and len(words) == 2:
            return head
    raise InputError("has no PCD header: export it again as PCD, LAS or .npz.")


def _record(head: dict[str, list[str]]) -> tuple[np.dtype, int]:
    """The type of a point and the number of points."""
    names = head.get("FIELDS", head.get("COLUMNS", []))
    if not {"x", "y", "z"} <= set(names):
        raise InputError("has no x, y and z: export it with point coordinates.")
    sizes, kinds = head.get("SIZE", []), head.get("TYPE", [])
    counts = head.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise InputError("has a head whose lines do not fit together: export it again.")
    fields: list[Any] = []
    for k, (name, size, kind, times) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        # Other fields may have any name, the same one too.
        known = name if name in ("x", "y", "z") else f"other {k}"
        form = f"<{_KINDS.get(kind, '?')}{size}"
        fields.append((known, form) if int(times) == 1 else (known, form, (int(times),)))
    record: np.dtype[Any] = np.dtype(fields)
    if any(record[axis].shape for axis in "xyz"):
        raise InputError("has several values of x, y or z in a point: export plain points.")
    points = head.get("POINTS")
    if points is None:
        points = [str(int(head["WIDTH"][0]) * int(head["HEIGHT"][0]))]
    count = int(points[0])
    if count < 0:
        raise InputError("counts less than no points: it is damaged; copy it again.")
    return record, count


def _from_text(file: BinaryIO, record: np.dtype, count: int) -> np.ndarray:
    places, place = {}, 0
    for name in record.names or ():
        places[name] = place
        place += int(np.prod(record[name].shape, dtype=int))
    lines = file.read().decode("ascii", "replace").splitlines()
    lines = [line for line in lines if line.strip()][:count]
    if len(lines) < count:
        raise _cut_short(len(lines), count)
    if not lines:
        return np.empty((0, 3))
    table: np.ndarray = np.loadtxt(lines, usecols=[places[axis] for axis in "xyz"], ndmin=2)
    return table


def _from_compressed(file: BinaryIO, record: np.dtype, count: int) -> np.ndarray:
    packed, unpacked = struct.unpack("<II", file.read(8))
    content = file.read(packed)
    if len(content) < packed or unpacked > _MOST_SAVED * packed:
        raise InputError("is damaged or cut short: copy it again.")
    check_unpacked(unpacked)
    if unpacked < count * record.itemsize:
        raise _cut_short(unpacked // record.itemsize, count)
    with library("lzf", install="wlplan[scan]") as lzf:
        whole = lzf.decompress(content, unpacked)
    if whole is None or len(whole) != unpacked:
        raise InputError("is damaged: its data does not unpack to the size it says; copy it again.")
    columns, start = {}, 0
    # All values of a field stand together.
    for name in record.names or ():
        columns[name] = np.frombuffer(whole, record[name].base, count, start)
        start += count * record[name].itemsize
    return np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def _cut_short(found: int, count: int) -> InputError:
    return InputError(f"is cut short: {found} of {count} points; copy it again.")
