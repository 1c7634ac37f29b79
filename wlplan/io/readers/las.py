"""`.las`, `.laz`: LAS point clouds, plain or compressed; x, y, z in metres, z up."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library, mute_stderr
from wlplan.io.scans import PointCloud

ENDINGS = (".las", ".laz")


def read(path: Path) -> PointCloud:
    """Read all points.

    Raises:
        InputError: If there is no laspy, or the file has no room for what its header counts.
    """
    with library("laspy", install="wlplan[scan]") as laspy:
        _check_header(path)
        try:
            with mute_stderr():
                # The parallel decompressor would set aside memory for as many points as a damaged
                # chunk size asks for.
                cloud = laspy.read(path, laz_backend=laspy.LazBackend.Lazrs)
        except BaseException as error:
            # A panic of the decompressor, which is written in Rust, is no `Exception`.
            if type(error).__name__ != "PanicException":
                raise
            raise RuntimeError(str(error)) from error
        axes = [np.asarray(cloud[axis], np.float64) for axis in "xyz"]
    return PointCloud(np.stack(axes, axis=-1))


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
