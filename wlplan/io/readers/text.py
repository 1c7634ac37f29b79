"""`.xyz`, `.asc`, `.csv`, `.txt`: points in text, a line each, or an ESRI ASCII grid; z up.

What it is shows in the content. A grid begins with `ncols`. Points have x, y and z at the head of
the line, or in the columns that a line of names above them calls so, with blanks, tabs, commas or
semicolons between them; further columns are passed over. Numbers may have decimal commas where the
separator is another one. A unit in brackets behind a name, as in `z [ft]`, is converted to metres.
Nothing but the file is read, so a reference system beside it plays no role.
"""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wlplan.errors import InputError, one_line
from wlplan.io.reference import METRE, Reference, length_unit
from wlplan.io.scans import Heightmap, PointCloud, check_size

ENDINGS = (".xyz", ".asc", ".csv", ".txt")

# How much of a file says what it is, in characters, and lines that are read at once.
_HEAD, _AT_ONCE = 1 << 16, 1 << 20
_COMMENTS = ("#", "//", "%", "!")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
# What columns are called, in lower case, without what stands in brackets.
_NAMES = (
    {"x", "east", "easting", "e", "rechtswert", "coord_x", "x_coordinate", "points:0"},
    {"y", "north", "northing", "n", "hochwert", "coord_y", "y_coordinate", "points:1"},
    {"z", "height", "elevation", "elev", "h", "altitude", "coord_z", "z_coordinate", "points:2"}
    | {"hoehe", "höhe"},
)
_DEGREES = {"lat", "latitude", "lon", "lng", "long", "longitude"}
_METRES = {"m", "meter", "metre", "meters", "metres"}
_GRID = re.compile(
    r"\s*(ncols|nrows|xllcorner|yllcorner|xllcenter|yllcenter|cellsize|dx|dy|nodata_value)\s+(\S+)",
    re.IGNORECASE,
)


def read(path: Path) -> Heightmap | PointCloud:
    """Read the points, or the grid.

    Raises:
        InputError: If it is no text, a line is no point, it is not clear which columns are x, y and
            z or where a number ends, or the grid is incomplete.
    """
    with path.open("rb") as raw:
        start = raw.read(_HEAD)
        raw.seek(0)
        wide = start.startswith((b"\xff\xfe", b"\xfe\xff"))
        if b"\0" in start and not wide:
            raise InputError("is no text: give it the ending of its format.")
        encoding = "utf-16" if wide else "utf-8-sig"
        text = io.TextIOWrapper(raw, encoding, errors="replace", newline=None)
        head = text.read(_HEAD)
        text.seek(0)
        if re.match(r"\s*ncols\s", head, re.IGNORECASE):
            return _grid(text, path.stat().st_size)
        return _points(text, head)


def _points(text: io.TextIOWrapper, head: str) -> PointCloud:
    """Read points."""
    lines = head.splitlines()
    # The last line may be cut.
    lines = lines[:-1] if len(head) == _HEAD and len(lines) > 1 else lines
    first, names = _first_point(lines)
    samples = [line for line in lines[first:] if not _is_comment(line)][:200]
    separator, commas = _separator(samples)
    width = len(_split(samples[0], separator))
    columns, reference = [0, 1, 2], Reference()
    if names is not None:
        fields = _split(names, separator)
        if separator is None:
            # What stands in brackets belongs to the name before.
            fields = [field for field in re.split(r"[;,]\s*|\s+(?![\[(])", names) if field]
        if len(fields) * 2 == width and separator == ",":
            raise InputError(
                f"has {len(fields)} names of columns and {width} numbers in a line: decimal commas "
                f"need another separator, such as a semicolon."
            )
        columns, reference = _columns(fields)
    if width < 3 or max(columns) >= width:
        raise InputError(f"has {width} columns, not x, y and z: export three numbers in a line.")
    rows: Iterator[str] = itertools.islice(text, first, None)
    rows = (line.replace(",", ".") for line in rows) if commas else rows
    rows = (line for line in rows if line.strip() and not _is_comment(line))
    parts = []
    while part := list(itertools.islice(rows, _AT_ONCE)):
        try:
            parts.append(np.loadtxt(part, float, None, separator, usecols=columns, ndmin=2))
        except ValueError as error:
            raise InputError(
                f"has a line that is no point ({one_line(error)}): every line needs x, y and z."
            ) from error
    horizontal, vertical, notes = reference.factors()
    points = np.concatenate(parts)
    points *= (horizontal, horizontal, vertical)
    return PointCloud(points, notes=notes)


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _first_point(lines: list[str]) -> tuple[int, str | None]:
    """Number of the first line with a point, and the line of names before it, if there is one.

    Raises:
        InputError: If there is no point in sight.
    """
    names = None
    for k, line in enumerate(lines):
        words = re.split(r"[\s;,]+", line.strip(" \t;,"))
        if not line.strip():
            continue
        if len(words) >= 3 and not _is_comment(line) and all(map(_NUMBER.fullmatch, words[:3])):
            return k, names
        # How many points follow may stand before them. A comment may hold the names too.
        found = line.strip().lstrip("#/%! ").strip()
        wanted = {_plain(word) for word in re.split(r"[\s;,]+", found)}
        named = all(wanted & options for options in _NAMES) or wanted & _DEGREES
        if named or not (_is_comment(line) or _NUMBER.fullmatch(words[0])):
            names = found
        elif not _is_comment(line) and len(words) == 2:
            break
    raise InputError("holds no points in text: every line needs three numbers, x, y and z.")


def _separator(samples: list[str]) -> tuple[str | None, bool]:
    """What stands between numbers, None for blanks, and whether they have decimal commas.

    Raises:
        InputError: If that is not clear.
    """
    joined = "\n".join(samples)
    if ";" in joined:
        commas = "," in joined
        if commas and "." in joined:
            raise InputError("has commas and points in its numbers: leave one of them out.")
        return ";", commas
    if "," not in joined:
        return None, False
    words = [word for line in samples for word in line.split()]
    plain = all(_DECIMAL_COMMA.fullmatch(word) or _NUMBER.fullmatch(word) for word in words)
    if plain and all(len(line.split()) >= 3 for line in samples):
        return None, True
    if any(re.search(r"\d,\d+,\s", f"{line} ") and ", " in line for line in samples):
        raise InputError(
            "has commas between its numbers and in them: use decimal points, or a semicolon."
        )
    return ",", False


def _split(line: str, separator: str | None) -> list[str]:
    """The fields of a line."""
    fields = line.strip().split(separator)
    return [field.strip(" \t\"'") for field in fields]


def _plain(name: str) -> str:
    return re.sub(r"[\[(].*", "", name).strip(" \"'_").lower()


def _columns(fields: list[str]) -> tuple[list[int], Reference]:
    """Which columns are x, y and z, and in which units they say they are."""
    plain = [_plain(field) for field in fields]
    if _DEGREES & set(plain) and not all(set(plain) & names for names in _NAMES):
        raise InputError("is in degrees, not in metres: project it to a system such as UTM.")
    columns = []
    for axis, names in zip("xyz", _NAMES, strict=True):
        found = [k for k, name in enumerate(plain) if name == axis] or [
            k for k, name in enumerate(plain) if name in names
        ]
        if len(found) != 1:
            raise InputError(
                f"names its columns {', '.join(fields[:8])}: name exactly one of them {axis}."
            )
        columns += found
    units = []
    for k in columns:
        unit = re.search(r"[\[(]\s*(.+?)\s*[\])]", fields[k])
        # Metres need no library that knows units.
        units.append(
            None if unit is None else METRE if unit[1] in _METRES else length_unit(unit[1])
        )
    if units[0] != units[1]:
        raise InputError("has x and y in different units: export both in metres.")
    return columns, Reference(horizontal=units[0], vertical=units[2])


def _grid(text: io.TextIOWrapper, size: int) -> Heightmap:
    """Read an ESRI ASCII grid: rows from north to south."""
    values: dict[str, float] = {}
    rest = ""
    for line in text:
        found = _GRID.match(line)
        if not found:
            rest = line
            break
        values[found[1].lower()] = _number(found[2])
    if not {"ncols", "nrows"} <= values.keys() or not {"cellsize", "dx"} & values.keys():
        raise InputError("is an ASCII grid without ncols, nrows and cellsize: export it again.")
    columns, rows = int(values["ncols"]), int(values["nrows"])
    cell = values.get("cellsize", values.get("dx", 0.0))
    if values.get("dx", cell) != values.get("dy", cell):
        raise InputError("has oblong cells: resample it to square ones.")
    if min(columns, rows) < 1 or columns * rows > size:
        raise InputError("is damaged or cut short: it has no room for its cells; copy it again.")
    check_size((columns, rows), cell)
    body = rest + text.read()
    if "," in body:
        body = body.replace(",", ".")
    try:
        numbers = np.array(body.split(), float)
    except ValueError as error:
        raise InputError(
            f"has a cell that is no number ({one_line(error)}): export it again."
        ) from error
    if len(numbers) != columns * rows:
        raise InputError(
            f"holds {len(numbers)} cells, not {columns} x {rows}: it is damaged or cut short; copy "
            f"it again."
        )
    height = numbers.reshape(rows, columns)[::-1].T
    valid = np.isfinite(height)
    if "nodata_value" in values:
        valid &= height != values["nodata_value"]
    # A corner is that of the cell in the south-west.
    origin = [
        values.get(f"{axis}llcenter", values.get(f"{axis}llcorner", 0.0) + 0.5 * cell)
        for axis in "xy"
    ]
    _, _, notes = Reference().factors()
    return Heightmap(height, cell, np.array(origin), valid, notes=notes)


def _number(word: str) -> float:
    """A number of the head of a grid."""
    try:
        return float(word.replace(",", "."))
    except ValueError as error:
        raise InputError(
            f"has {word!r} in its head, which is no number: export it again."
        ) from error
