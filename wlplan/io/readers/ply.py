"""`.ply`: the vertices of an ascii or binary PLY file; x, y, z in metres, z up.

The format has no place for a unit, so a note says what is assumed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wlplan.errors import InputError
from wlplan.io.reference import Reference
from wlplan.io.scans import PointCloud

ENDINGS = (".ply",)

# The number types of a PLY header, as numpy's.
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


def read(path: Path) -> PointCloud:
    """Read the vertices; they have to come first, as they do.

    Raises:
        InputError: If the header does not begin with vertices that have x, y and z, or there are
            fewer of them than it says.
    """
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
            if line[1] not in _TYPES:
                raise InputError(
                    f"has vertices of type {line[1]!r}: export plain x, y, z vertices."
                )
            fields.append((line[2], _TYPES[line[1]]))
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
    return PointCloud(np.stack(columns, axis=-1), notes=Reference().factors()[2])
