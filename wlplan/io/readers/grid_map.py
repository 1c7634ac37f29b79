"""`.bag`, `.mcap`, `.db3`: the last map of grid_map in a recording of ROS 1 or 2; z up, metres.

That is the last message of type `grid_map_msgs/GridMap`, on whatever topic. Its layer `elevation`
counts, or the only one; NaN is unseen. Of a ROS 2 recording in several files, name the last one.
Messages are taken apart by the definitions of grid_map_msgs below, never by those in the file.
"""

from __future__ import annotations

import contextlib
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wlplan.errors import InputError
from wlplan.io.libraries import library
from wlplan.io.limits import MOST_UNPACKED
from wlplan.io.scans import Heightmap, check_size
from wlplan.io.unpacking import Unpacker

ENDINGS = (".bag", ".mcap", ".db3")
OPTIONS = ("layer",)

_BEGINS = {".bag": b"#ROSBAG V", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_TYPE = "grid_map_msgs/msg/GridMap"
_ELEVATION = "elevation"
# Source: grid_map, grid_map_msgs/msg, its branches for ROS 1 and 2, which differ in where the
# header is.
_INFO = "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose\n"
_MAP = (
    "grid_map_msgs/GridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
    "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index\n"
)
_HEADER = "std_msgs/Header header\n"
# Words by which a database says to compute what it does not hold.
_COMPUTED = re.compile(r"\b(AS|VIRTUAL)\b", re.IGNORECASE)
# Largest turn of a map against its frame that is none.
_TURNED = 1e-3


def read(path: Path, *, layer: str | None = None) -> Heightmap:
    """Read a layer of the last map.

    Args:
        path: File to read.
        layer: Name of the layer that holds the heights; by default `elevation`, or the only one.

    Raises:
        InputError: If rosbags is missing, there is no such map or layer, or the map is turned
            against its frame.
    """
    with path.open("rb") as file:
        if not file.read(16).startswith(_BEGINS[path.suffix.lower()]):
            raise InputError("is no recording of ROS: give it the ending of its format.")
    with library("rosbags", install="wlplan[scan]"):
        message, notes = _last_map(path)
    names = list(message.layers)
    wanted = layer or (names[0] if len(names) == 1 else _ELEVATION)
    if wanted not in names:
        raise InputError(
            f"has a map with the layers {', '.join(names) or 'none'}, none called {wanted}: choose "
            f"one with --layer."
        )
    info = message.info
    turn = info.pose.orientation
    # A pose that nobody filled in is all zero.
    if max(abs(turn.x), abs(turn.y), abs(turn.z)) > _TURNED:
        raise InputError("has a map that is turned against its frame: export it along the axes.")
    matrix = _matrix(message.data[names.index(wanted)])
    rows, columns = matrix.shape
    cell = float(info.resolution)
    check_size((rows, columns), cell)
    # The buffer is circular. Its first row and column then lie at the largest x and y.
    matrix = np.roll(matrix, (-message.outer_start_index, -message.inner_start_index), (0, 1))
    height = matrix[::-1, ::-1].astype(np.float64)
    centre = np.array([info.pose.position.x, info.pose.position.y])
    origin = centre - 0.5 * cell * (np.array([rows, columns]) - 1)
    return Heightmap(height, cell, origin, np.isfinite(height), notes=notes)


def _last_map(path: Path) -> tuple[Any, tuple[str, ...]]:
    """The last message of the type, whatever its topic, and a note if there is more than one."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros1 = path.suffix.lower() == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    info, whole = (_HEADER + _INFO, _MAP) if ros1 else (_INFO, _HEADER + _MAP)
    types = get_types_from_msg(info, "grid_map_msgs/msg/GridMapInfo")
    store.register({**types, **get_types_from_msg(whole, _TYPE)})
    last, topics, count = None, set(), 0
    for topic, time, content in _messages(path, ros1):
        topics.add(topic)
        count += 1
        if last is None or time >= last[0]:
            last = (time, topic, content)
    if last is None:
        raise InputError("holds no grid_map_msgs/GridMap: record the topic of the elevation map.")
    _, topic, content = last
    read_message = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    message = read_message(content, _TYPE)
    if count == 1:
        return message, ()
    return message, (f"the last of {count} maps counts, on the topic {topic}",)


def _messages(path: Path, ros1: bool) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time and content of the messages of the type."""
    from rosbags import rosbag1, rosbag2

    if not ros1 and any(sign in str(path.absolute()) for sign in "?#%"):
        # SQLite is given its place as a URI, in which these mean something.
        raise InputError("has one of ?, # and % in its path: rename it.")
    if path.suffix.lower() == ".db3":
        _check_tables(path)
    reader: Any = rosbag1.Reader(path) if ros1 else rosbag2.Reader(path)
    with _bounded(path.stat().st_size):
        yield from _messages_of(reader)


def _messages_of(reader: Any) -> Iterator[tuple[str, int, bytes]]:
    from rosbags import rosbag1, rosbag2

    try:
        reader.open()
    except (rosbag1.ReaderError, rosbag2.ReaderError) as error:
        if "Profile is not" in str(error):
            raise InputError("is no MCAP of ROS 2: record it there.") from error
        if "not indexed" in str(error):
            raise InputError("has no index: run `rosbag reindex` with it.") from error
        raise
    with contextlib.closing(reader):
        ours = [c for c in reader.connections if c.msgtype == _TYPE]
        # None at all would mean every one.
        if ours:
            for connection, time, content in reader.messages(connections=ours):
                yield connection.topic, time, bytes(content)


def _check_tables(path: Path) -> None:
    """Refuse a database that holds more than plain tables: it may compute without end."""
    place = f"file:{path.absolute()}?immutable=1"
    with contextlib.closing(sqlite3.connect(place, uri=True)) as base:
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(MOST_UNPACKED, path.stat().st_size + 1000))
        found = base.execute("SELECT type, sql FROM sqlite_master").fetchall()
    if any(kind not in ("table", "index") or _COMPUTED.search(sql or "") for kind, sql in found):
        raise InputError("holds more than tables of messages: record it again.")


@contextlib.contextmanager
def _bounded(size: int) -> Iterator[None]:
    """Have the library unpack a file of some size as far as that warrants."""
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import storage_mcap as mcap

    unpacker = Unpacker(size)
    ours: list[tuple[dict[str, Any], dict[str, Any]]] = [
        (rosbag1.decompressors, {"bz2": unpacker.bz2, "lz4": unpacker.lz4}),
        (
            mcap.DECOMPRESSORS,
            {"lz4": lambda x, _: unpacker.lz4(x), "zstd": lambda x, _: unpacker.zstd(x)},
        ),
    ]
    before = [dict(table) for table, _ in ours]
    try:
        for table, limited in ours:
            table.update(limited)
        yield
    finally:
        for (table, _), was in zip(ours, before, strict=True):
            table.update(was)


def _matrix(layer: Any) -> np.ndarray:
    """The matrix of a layer, rows by columns, as it is stored: grid_map_ros, GridMapMsgHelpers."""
    sizes = {dim.label: int(dim.size) for dim in layer.layout.dim}
    data = np.asarray(layer.data)[int(layer.layout.data_offset) :]
    if sizes.keys() != {"column_index", "row_index"}:
        raise InputError("has a layer that is no matrix of rows and columns: record it again.")
    rows, columns = sizes["row_index"], sizes["column_index"]
    if rows * columns != len(data) or not len(data):
        raise InputError("has a layer whose size is not that of its data: it is damaged.")
    by_column = layer.layout.dim[0].label == "column_index"
    return data.reshape(columns, rows).T if by_column else data.reshape(rows, columns)
