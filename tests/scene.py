"""One yard in every format: a cone, and a low mound in a corner that shows which way is which."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from laws import volume

from wlplan.io import ScannedPile, read_scan

SIDES = (24.0, 20.0)
SLOPE = math.tan(math.radians(32.0))
# Of both [m].
CONE, MOUND = ((9.0, 11.0), 3.5), ((20.0, 4.0), 0.7)


def yard(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights [m] at places between zero and `SIDES`."""
    height = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
    for (a, b), top in (CONE, MOUND):
        height = np.maximum(height, top - np.hypot(x - a, y - b) * SLOPE)
    return height


def points(
    per_square_metre: float = 40.0, seed: int = 1, at: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Random places with a centimetre of noise, shape [n, 3], moved by `at`."""
    random = np.random.default_rng(seed)
    count = int(SIDES[0] * SIDES[1] * per_square_metre)
    x, y = (random.uniform(0.0, side, count) for side in SIDES)
    return np.stack([x, y, yard(x, y) + random.normal(0.0, 0.01, count)], axis=-1) + at


def grid(cell: float = 0.2) -> np.ndarray:
    """Heights at the centres of cells, shape [nx, ny]."""
    x, y = (np.arange(0.5 * cell, side, cell) for side in SIDES)
    return yard(x[:, np.newaxis], y)


def triangles() -> np.ndarray:
    """The yard in large faces and small ones; the floor goes on below the cones."""
    (w, h), rim = SIDES, np.linspace(0.0, 2.0 * math.pi, 73)
    faces = [
        [(0.0, 0.0, 0.0), (w, 0.0, 0.0), (w, h, 0.0)],
        [(0.0, 0.0, 0.0), (w, h, 0.0), (0.0, h, 0.0)],
    ]
    for (a, b), top in (CONE, MOUND):
        ring = [(a + top / SLOPE * math.cos(t), b + top / SLOPE * math.sin(t), 0.0) for t in rim]
        faces += [[(a, b, top), one, two] for one, two in itertools.pairwise(ring)]
    return np.array(faces)


def check(pile: Any, at: tuple[float, float] = (0.0, 0.0), *, cone: float = 0.3) -> None:
    """Check that a pile is the yard, with its lower left corner at some place."""
    assert 105.0 < float(volume(pile)) < 120.0
    height = np.asarray(pile.height - pile.floor)
    i, j = np.unravel_index(height.argmax(), height.shape)
    top = np.asarray(pile.origin) + 0.1 * np.array([i, j]) - at
    np.testing.assert_allclose(top, CONE[0], atol=cone)
    assert height.max() == pytest.approx(CONE[1], abs=0.2)
    # The mound is where it is, and nowhere that a turn or a mirror would put it.
    x, y = MOUND[0]
    w, h = SIDES
    for place, there in (((x, y), True), ((w - x, y), False), ((x, h - y), False)):
        k = np.rint((np.array(place) + at - np.asarray(pile.origin)) / 0.1).astype(int)
        assert (height[tuple(k)] > 0.5) == there, place


def check_file(
    path: Path, at: tuple[float, float] = (0.0, 0.0), *, cone: float = 0.3, **options: Any
) -> ScannedPile:
    """`check` of a file."""
    scan = read_scan(path, **options)
    check(scan.pile, at, cone=cone)
    return scan


# --- files of the yard, or of other points


def write_xyz(path: Path, rows: np.ndarray, **options: Any) -> Path:
    np.savetxt(path, rows, **{"fmt": "%.4f", **options})
    return path


def write_grid(path: Path, height: np.ndarray, cell: float, head: str = "") -> Path:
    """An ESRI ASCII grid; `head` replaces the lines of the corner and the nodata value."""
    corner = head or "xllcorner 1000\nyllcorner 2000\nNODATA_value -9999\n"
    with path.open("w") as file:
        file.write(f"ncols {height.shape[0]}\nnrows {height.shape[1]}\n{corner}cellsize {cell}\n")
        np.savetxt(file, np.where(np.isnan(height), -9999.0, height).T[::-1], "%.3f")
    return path


def write_pcd(path: Path, rows: np.ndarray, encoding: str = "binary") -> Path:
    record = np.dtype([("intensity", "<f4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f8")])
    table = np.zeros(len(rows), record)
    for k, axis in enumerate("xyz"):
        table[axis] = rows[:, k]
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS intensity x y z\nSIZE 4 4 4 8\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(rows)}\nDATA {encoding}\n"
    )
    if encoding == "ascii":
        body = "".join(f"0 {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in rows).encode()
    elif encoding == "binary":
        body = table.tobytes()
    else:
        lzf = pytest.importorskip("lzf")
        whole = b"".join(table[name].tobytes() for name in record.names or ())
        packed = lzf.compress(whole, len(whole) + 1000)
        body = np.array([len(packed), len(whole)], "<u4").tobytes() + packed
    path.write_bytes(head.encode() + body)
    return path


def write_e57(path: Path, scans: list[tuple[np.ndarray, float, np.ndarray]]) -> Path:
    """Scans: points in the file's frame, the heading of the scanner [rad], and its place."""
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as file:
        for rows, heading, place in scans:
            turn = np.array([math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)])
            c, s = math.cos(heading), math.sin(heading)
            own = (rows - place) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            data = {f"cartesian{axis}": own[:, k].copy() for k, axis in enumerate("XYZ")}
            data["cartesianInvalidState"] = np.isnan(rows[:, 0]).astype("b")
            for axis in "XYZ":
                data[f"cartesian{axis}"][np.isnan(rows[:, 0])] = 0.0
            file.write_scan_raw(data, rotation=turn, translation=np.asarray(place, float))
    return path


def write_obj(path: Path, faces: np.ndarray, head: str = "") -> Path:
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in faces.reshape(-1, 3)]
    lines += [f"f {k + 1} {k + 2} {k + 3}" for k in range(0, 3 * len(faces), 3)]
    path.write_text(head + "\n".join(lines) + "\n")
    return path


def write_stl(path: Path, faces: np.ndarray, *, text: bool = False) -> Path:
    if text:
        lines = ["solid yard"]
        for face in faces:
            lines += ["facet normal 0 0 0", "outer loop"]
            lines += [f"vertex {x:.5f} {y:.5f} {z:.5f}" for x, y, z in face]
            lines += ["endloop", "endfacet"]
        path.write_text("\n".join([*lines, "endsolid yard", ""]))
        return path
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    table = np.zeros(len(faces), kind)
    table["corners"] = faces
    path.write_bytes(bytes(80) + np.uint32(len(faces)).tobytes() + table.tobytes())
    return path


def write_bag(
    path: Path,
    layers: dict[str, np.ndarray],
    *,
    cell: float = 0.2,
    centre: tuple[float, float] = (0.5 * SIDES[0], 0.5 * SIDES[1]),
    start: tuple[int, int] = (0, 0),
    by_column: bool = True,
    turn: float = 0.0,
    messages: int = 1,
) -> Path:
    """Maps [nx, ny] as grid_map stores them; of several messages all but the last one are flat."""
    pytest.importorskip("rosbags")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from wlplan.io.readers import grid_map

    ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    info = (grid_map._HEADER if ros1 else "") + grid_map._INFO
    whole = ("" if ros1 else grid_map._HEADER) + grid_map._MAP
    types = get_types_from_msg(info, "grid_map_msgs/msg/GridMapInfo")
    store.register({**types, **get_types_from_msg(whole, "grid_map_msgs/msg/GridMap")})
    make = store.types
    stamp = make["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    fields: dict[str, Any] = {"stamp": stamp, "frame_id": "map"}
    header = make["std_msgs/msg/Header"](**({"seq": 1} if ros1 else {}), **fields)
    pose = make["geometry_msgs/msg/Pose"](
        position=make["geometry_msgs/msg/Point"](x=centre[0], y=centre[1], z=0.0),
        orientation=make["geometry_msgs/msg/Quaternion"](
            x=0.0, y=0.0, z=math.sin(0.5 * turn), w=math.cos(0.5 * turn)
        ),
    )

    def matrix(values: np.ndarray) -> Any:
        # Index 0 is where x and y are largest, but for the start of the buffer.
        stored = np.roll(values[::-1, ::-1], start, (0, 1)).astype(np.float32)
        dim = make["std_msgs/msg/MultiArrayDimension"]
        (rows, columns), both = stored.shape, stored.size
        dims = [
            dim(label="column_index", size=columns, stride=both),
            dim(label="row_index", size=rows, stride=rows),
        ]
        if not by_column:
            dims = [
                dim(label="row_index", size=rows, stride=both),
                dim(label="column_index", size=columns, stride=columns),
            ]
        return make["std_msgs/msg/Float32MultiArray"](
            layout=make["std_msgs/msg/MultiArrayLayout"](dim=dims, data_offset=0),
            data=stored.ravel(order="F" if by_column else "C"),
        )

    def message(maps: dict[str, np.ndarray]) -> Any:
        nx, ny = next(iter(maps.values())).shape
        size = {"resolution": cell, "length_x": nx * cell, "length_y": ny * cell, "pose": pose}
        head = {"header": header}
        about = make["grid_map_msgs/msg/GridMapInfo"](**(head if ros1 else {}), **size)
        return make["grid_map_msgs/msg/GridMap"](
            **({} if ros1 else head),
            info=about,
            layers=list(maps),
            basic_layers=[],
            data=[matrix(values) for values in maps.values()],
            outer_start_index=start[0],
            inner_start_index=start[1],
        )

    flat = {name: np.zeros_like(values) for name, values in layers.items()}
    contents = [message(flat)] * (messages - 1) + [message(layers)]
    kind = "grid_map_msgs/msg/GridMap"
    dump: Callable[..., Any] = store.serialize_ros1 if ros1 else store.serialize_cdr
    folder = path.parent / f"{path.name}.folder"
    if ros1:
        writer: Any = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else None
        options = {"storage_plugin": plugin} if plugin else {}
        writer = rosbag2.Writer(folder, version=9, **options)
    with writer:
        connection = writer.add_connection("/elevation_map", kind, typestore=store)
        for k, content in enumerate(contents):
            writer.write(connection, 1_000 + k, dump(content, kind))
    if not ros1:
        (found,) = folder.glob(f"*{path.suffix}")
        found.rename(path)
    return path
