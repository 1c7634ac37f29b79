"""`.e57`: the scans of a laser scanner, ASTM E2807; x, y, z in metres, z up.

All scans of the file are joined, each moved by its pose. Points that the file calls invalid are
left out, and so are those at the place of a scanner.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library, mute_stderr
from wlplan.io.limits import check_points
from wlplan.io.reference import reference_of
from wlplan.io.scans import Box, PointCloud, nothing_inside, points_inside
from wlplan.io.sensor import at_sensor

ENDINGS = (".e57",)
OPTIONS = ("crop",)

# Points that are read at once, and that say where the middle is.
_AT_ONCE, _SOME = 1 << 20, 1 << 20
# The file is made of pages that end with a checksum: ASTM E2807-11, 6.3.
_CHECKSUM = 4
_CODING = re.compile(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)")
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def read(path: Path, *, crop: Box | None = None) -> PointCloud:
    """Read the points of all scans.

    Args:
        path: File to read.
        crop: Rectangle outside of which points are left out, in the coordinates of the file.

    Raises:
        InputError: If pye57 is missing, the description of the file refers to others, or there is
            no scan with coordinates.
    """
    with library("pye57", install="pye57") as pye57:
        definition = _definition(path)
        parts, notes = [np.empty((0, 3))], []
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        with mute_stderr(), pye57.E57(str(path)) as file:
            scans = file.scan_count
            # Values that are all the same take no room in a file.
            counts = [file.get_header(k).point_count for k in range(scans)]
            check_points(sum(counts), path.stat().st_size)
            for k in range(scans):
                header = file.get_header(k)
                own = [np.empty((0, 3)), *_points(pye57, file, header)]
                places = np.concatenate(own)
                left_out, note = at_sensor(places)
                places = places[~left_out]
                notes += [f"scan {k + 1} of {scans}: {words}" for words in note]
                if header.has_pose():
                    places = _moved(places, header.rotation, header.translation)
                if crop is not None and len(places):
                    low = np.minimum(low, np.nanmin(places[:, :2], axis=0))
                    high = np.maximum(high, np.nanmax(places[:, :2], axis=0))
                    places = places[points_inside(places, crop)]
                parts.append(places)
    points = np.concatenate(parts)
    if crop is not None and not len(points) and low[0] <= high[0]:
        raise nothing_inside(low, high)
    if not len(points):
        raise InputError("holds no valid point: export its scans with their points.")
    if scans > 1:
        notes.insert(0, f"{scans} scans joined")
    # Lengths are in metres, whatever the system: ASTM E2807-11, 8.1.
    middle = np.nanmedian(points[:: len(points) // _SOME + 1], axis=0)
    system, unknown = _system(definition, (float(middle[0]), float(middle[1])))
    notes += unknown
    return PointCloud(points, crs=system, notes=tuple(notes))


def _system(definition: str, middle: tuple[float, float]) -> tuple[str | None, list[str]]:
    """Name of a reference system, and a note of one that is not understood: it need not be one."""
    if not definition:
        return None, []
    try:
        return reference_of(definition, middle).name, []
    except InputError as error:
        if error.__cause__ is None:
            raise
        return None, ["the file names a reference system that is not understood"]


def _points(pye57: Any, file: Any, header: Any) -> Iterator[np.ndarray]:
    """Valid points of a scan, in the frame of its scanner [m], part by part."""
    names = set(header.point_fields)
    axes = next((axes for axes in (_CARTESIAN, _SPHERICAL) if set(axes) <= names), None)
    if axes is None:
        raise InputError("has a scan without coordinates: export its points as x, y and z.")
    state = "cartesianInvalidState" if axes is _CARTESIAN else "sphericalInvalidState"
    fields = [*axes, *({state} & names)]
    data, buffers = file.make_buffers(fields, min(header.point_count, _AT_ONCE))
    reader = header.points.reader(buffers)
    # It says how many it read: the file may hold fewer than it says.
    while header.point_count and (count := reader.read()):
        places = np.stack([data[axis][:count] for axis in axes], axis=-1)
        if axes is _SPHERICAL:
            distance, azimuth, elevation = places.T
            flat = distance * np.cos(elevation)
            places = np.stack(
                [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)],
                axis=-1,
            )
        yield places[data[state][:count] == 0] if state in data else places
    reader.close()


def _moved(places: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Points of a scan in the frame of the file; the rotation is a quaternion w, x, y, z."""
    w, x, y, z = np.asarray(rotation, float) / np.linalg.norm(rotation)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    moved: np.ndarray = places @ matrix.T + np.asarray(translation, float)
    return moved


def _definition(path: Path) -> str:
    """The reference system that the XML part of a file names; empty if it names none.

    Raises:
        InputError: If the file is cut short, or that part may refer to other files: the library
            would open them.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(48).ljust(48, b"\0")
        # ASTM E2807-11, table 1.
        sign, _, _, whole, start, length, page = struct.unpack("<8sIIQQQQ", head)
        fits = sign == b"ASTM-E57" and whole == size and start < size and length <= size
        if not fits or not _CHECKSUM < page <= size:
            raise InputError("is damaged or cut short, or no E57 file: copy or export it again.")
        file.seek(start - start % page)
        content = file.read((start % page + length) // (page - _CHECKSUM) * page + 2 * page)
    pages = (content[k : k + page - _CHECKSUM] for k in range(0, len(content), page))
    text = b"".join(pages)[start % page :][:length]
    coding = _CODING.match(text)
    foreign = coding is not None and coding[1].lower() != b"utf-8"
    if foreign or any(word in text.upper() for word in (b"<!DOCTYPE", b"<!ENTITY")):
        raise InputError("has a description with declarations of its own: export it again.")
    root = ElementTree.fromstring(text)
    found = next((e.text for e in root.iter() if e.tag.endswith("coordinateMetadata")), None)
    return (found or "").strip()
