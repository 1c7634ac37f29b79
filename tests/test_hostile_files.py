"""Files made to do harm: only the named file is opened, and no more is taken than warranted."""

import bz2
import json
import math
import shutil
import socket
import sqlite3
import struct
import threading
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
import scene
from flax import nnx
from scan_files import refused, write_las, write_tif

from wlplan import io
from wlplan.errors import InputError
from wlplan.io import limits, unpacking
from wlplan.io.documents import check_kinds, parse_json
from wlplan.io.readers import geotiff, grid_map
from wlplan.io.reference import reference_of
from wlplan.io.unpacking import Unpacker
from wlplan.models.ensemble import members_of
from wlplan.models.storage import _digests, load_model
from wlplan.terrain.toe import toe_contour
from wlplan.worlds.shipped import pretrained_path

HEIGHTS = scene.grid(0.4).astype(np.float32)
BAND = np.ascontiguousarray(HEIGHTS.T[::-1])


@pytest.fixture
def visitors() -> Iterator[tuple[str, list[str]]]:
    """An address in this machine, and who has connected to it."""
    found: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def listen() -> None:
            while True:
                try:
                    connection, address = server.accept()
                except OSError:
                    return
                found.append(address[0])
                connection.close()

        thread = threading.Thread(target=listen, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}/other.tif", found
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


def naming(path: Path, place: str) -> Path:
    """A GeoTIFF, too large to be read as a whole, that names another file."""
    rasterio = pytest.importorskip("rasterio")
    step = rasterio.Affine(0.1, 0.0, 0.0, 0.0, -0.1, 0.0)
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "transform": step}
    size = {"width": 5000, "height": 5000, "tiled": True, "sparse_ok": True}
    with rasterio.open(path, "w", **profile, **size) as file:
        file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=place)
    return path


def test_a_tiff_cannot_have_an_address_connected_to(
    tmp_path: Path, visitors: tuple[str, list[str]]
) -> None:
    address, found = visitors
    path = naming(tmp_path / "a.tif", f"/vsicurl/{address}")
    refused(path, "names other files")
    assert not found
    # Which GDAL does, left to itself.
    rasterio = pytest.importorskip("rasterio")
    with rasterio.Env(GDAL_HTTP_MAX_RETRY="0"), rasterio.open(path, driver="GTiff") as file:
        file.read(1, out_shape=(10, 10))
    assert found


VIRTUAL = """<VRTDataset rasterXSize="{1}" rasterYSize="{0}">
<Metadata><MDI key="INTERNAL_MASK_FLAGS_1">2</MDI></Metadata>
<VRTRasterBand dataType="Byte" band="1">
<SimpleSource><SourceFilename>{2}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>
</VRTRasterBand></VRTDataset>"""


def test_a_virtual_data_set_beside_a_tiff_is_not_looked_at(tmp_path: Path) -> None:
    path = write_tif(tmp_path / "a.tif", BAND, step=0.4)
    plain = geotiff.read(path)
    mask = write_tif(tmp_path / "mask.tif", (BAND > 1.0).astype(np.uint8), step=0.4)
    for ending in (".msk", ".ovr"):
        path.with_name(f"a.tif{ending}").write_text(VIRTUAL.format(*BAND.shape, mask))
    path.with_name("a.tif.aux.xml").write_text(
        "<PAMDataset><Metadata domain='OVERVIEWS'><MDI key='OVERVIEW_FILE'>/x</MDI></Metadata>"
        "<PAMRasterBand band='1'><Offset>5</Offset></PAMRasterBand></PAMDataset>"
    )
    again = geotiff.read(path)
    np.testing.assert_array_equal(again.height, plain.height)
    np.testing.assert_array_equal(again.valid, plain.valid)
    # Left to itself GDAL takes the mask.
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(path, driver="GTiff") as file:
        assert not file.read_masks(1).all()


def test_a_virtual_data_set_is_no_tiff(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_text(VIRTUAL.format(*BAND.shape, "/etc/hostname"))
    refused(path, "is no TIFF")


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.filterwarnings("ignore:The given matrix is equal to Affine.identity")
@pytest.mark.parametrize("ending", [".tfw", ".tifw", ".wld"])
def test_a_world_file_beside_a_tiff_counts(tmp_path: Path, ending: str) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = write_tif(tmp_path / "a.tif", BAND, transform=rasterio.Affine.identity())
    refused(path, "no georeference")
    path.with_suffix(ending).write_text("0.4\n0\n0\n-0.4\n100.2\n199.8\n")
    by_file = geotiff.read(path)
    within = geotiff.read(write_tif(tmp_path / "b.tif", BAND, step=0.4))
    assert by_file.cell_size == within.cell_size
    np.testing.assert_allclose(by_file.origin, within.origin, atol=1e-9)
    path.with_suffix(ending).write_text("0.4\n0\nwidth\n")
    refused(path, "no georeference")


def test_a_tiff_in_blocks_that_no_memory_holds_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_tif(tmp_path / "a.tif", BAND, step=0.4)
    io.read_pile(path)
    monkeypatch.setattr(limits, "MOST_UNPACKED", BAND[0].nbytes - 1)
    refused(path, "unpacks to")


UTM = (
    'PROJCS["a",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",'
    '0.9996],PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1]{}]'
)


@pytest.mark.parametrize("parameter", ["init", "nadgrids", "geoidgrids"])
def test_a_reference_system_cannot_name_files(parameter: str) -> None:
    pytest.importorskip("pyproj")
    place = (500_000.0, 5e6)
    assert reference_of(UTM.format(""), place).horizontal == 1.0
    other = f',EXTENSION["PROJ4","+proj=tmerc +k=0.9996 +{parameter}=/tmp/x +units=m"]'
    with pytest.raises(InputError, match="names other files"):
        reference_of(UTM.format(other), place)
    for text in (f"+proj=utm +zone=32 +{parameter}=/tmp/x", "/tmp/x", "http://127.0.0.1/x"):
        with pytest.raises(InputError, match="not understood"):
            reference_of(text, place)


@pytest.mark.parametrize("definition", [25832, "EPSG:25832", "epsg:25832"])
def test_a_reference_system_may_be_a_number(definition: object) -> None:
    pytest.importorskip("pyproj")
    assert reference_of(definition, (500_000.0, 5e6)).name == "EPSG:25832"


# --- what unpacks to more than there is


def test_an_archive_that_unpacks_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, height=HEIGHTS, cell_size=0.4)
    io.read_pile(path)
    monkeypatch.setattr(limits, "MOST_UNPACKED", HEIGHTS.nbytes)
    refused(path, "unpacks to")


def test_a_member_that_is_no_array_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    for name in ("valid.npy", "ground", "origin.npy", "notes.txt"):
        np.savez(path, height=HEIGHTS, cell_size=0.4)
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(name, b"no array")
        refused(path, "that is no array")


def test_an_array_that_says_it_is_larger_than_it_is_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    head = "{'descr': '<f8', 'fortran_order': False, 'shape': (4000000, 4000000), }"
    text = head.ljust(117) + "\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("height.npy", b"\x93NUMPY\1\0" + struct.pack("<H", 118) + text.encode())
    refused(path, "cannot be read")


@pytest.mark.parametrize("way", ["bz2", "lz4", "zstd"])
def test_parts_are_unpacked_up_to_a_limit(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    content = bytes(5_000_000)
    if way == "bz2":
        packed = bz2.compress(content)
    elif way == "lz4":
        packed = pytest.importorskip("lz4.frame").compress(content)
    else:
        packed = pytest.importorskip("backports.zstd").compress(content)
    assert getattr(Unpacker(len(packed)), way)(packed) == content
    for module in (limits, unpacking):
        monkeypatch.setattr(module, "MOST_UNPACKED", 3_000_000)
    with pytest.raises(InputError, match="unpacks to"):
        getattr(Unpacker(len(packed)), way)(packed)
    # Parts of one file share what it may unpack to.
    part = {"bz2": bz2.compress}.get(way, lambda _: packed)(content[:2_000_000])
    if way == "bz2":
        unpacker = Unpacker(len(part))
        unpacker.bz2(part)
        with pytest.raises(InputError, match="unpacks to"):
            unpacker.bz2(part)


@pytest.mark.parametrize("ending", [".bag", ".mcap"])
def test_a_recording_that_unpacks_to_too_much_is_refused(
    tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = scene.write_bag(tmp_path / f"a{ending}", {"elevation": HEIGHTS}, cell=0.4)
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import storage_mcap as mcap

    tables = (rosbag1.decompressors, mcap.DECOMPRESSORS)
    before = [dict(table) for table in tables]
    packed = tmp_path / f"packed{ending}"
    rewritten(path, packed)
    io.read_pile(packed)
    for module in (limits, unpacking):
        monkeypatch.setattr(module, "MOST_UNPACKED", 1000)
    monkeypatch.setattr(unpacking, "_MOST_BY_LZ4", 0)
    refused(packed, "unpacks to")
    assert [dict(table) for table in tables] == before


def rewritten(source: Path, target: Path) -> None:
    """The same recording, compressed."""
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros1 = source.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    info = (grid_map._HEADER if ros1 else "") + grid_map._INFO
    whole = ("" if ros1 else grid_map._HEADER) + grid_map._MAP
    types = get_types_from_msg(info, "grid_map_msgs/msg/GridMapInfo")
    store.register({**types, **get_types_from_msg(whole, "grid_map_msgs/msg/GridMap")})
    reader: Any = (rosbag1 if ros1 else rosbag2).Reader(source)
    if ros1:
        writer: Any = rosbag1.Writer(target)
        writer.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
    else:
        folder = target.with_suffix("")
        writer = rosbag2.Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        mode = rosbag2.CompressionMode.STORAGE
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with reader, writer:
        for connection, time, content in reader.messages():
            ours = writer.add_connection(connection.topic, connection.msgtype, typestore=store)
            writer.write(ours, time, content)
    if not ros1:
        shutil.move(next(target.with_suffix("").glob("*.mcap")), target)


@pytest.mark.parametrize(
    "trick",
    [
        "CREATE VIEW more AS SELECT 1",
        "CREATE TRIGGER t AFTER INSERT ON messages BEGIN SELECT 1; END",
        "CREATE TABLE more (a, b GENERATED ALWAYS AS (zeroblob(1000000000)))",
        "CREATE VIRTUAL TABLE more USING fts5(a)",
    ],
)
def test_a_database_that_computes_what_it_holds_is_refused(tmp_path: Path, trick: str) -> None:
    path = scene.write_bag(tmp_path / "a.db3", {"elevation": HEIGHTS}, cell=0.4)
    base = sqlite3.connect(path)
    base.execute(trick)
    base.commit()
    base.close()
    refused(path, "more than tables")


def test_counts_that_a_file_has_no_room_for_are_refused(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.laz", scene.points(6.0))
    content = bytearray(path.read_bytes())
    io.read_pile(path)
    for count in (30_000_000, 2**32 - 1):
        content[107:111] = struct.pack("<I", count)
        if content[25] >= 4:
            content[247:255] = struct.pack("<Q", count)
        path.write_bytes(content)
        refused(path, f"{count} points")


@pytest.mark.parametrize(("count", "size"), [(-1, 10**9), (20_000_001, 1000), (5 * 10**9, 10**9)])
def test_points_are_limited_by_the_size_of_a_file(count: int, size: int) -> None:
    with pytest.raises(InputError, match="points"):
        limits.check_points(count, size)
    limits.check_points(10**9, 10**9)


def test_a_device_is_no_file() -> None:
    with pytest.raises(InputError, match="is a device"):
        io.read_plan("/dev/zero")


# --- JSON


@pytest.mark.parametrize("text", ["NaN", "-Infinity", "1e999", "9" * 400, "9" * 6000, "[" * 10**5])
def test_json_holds_numbers_that_a_float_holds(text: str) -> None:
    with pytest.raises(InputError, match=r"finite|not valid JSON"):
        parse_json(text)
    with pytest.raises(InputError, match=r"finite|not valid JSON"):
        parse_json(f'{{"a": [1, {text}]}}'.encode())


def test_json_is_read_as_it_is() -> None:
    record = {"a": [1, -2.5, None, True, "x"], "b": {"c": 10**300}}
    assert parse_json(json.dumps(record)) == record
    assert isinstance(parse_json("12"), int)


@pytest.mark.parametrize("value", ["x", None, True, 1.5, [3]])
def test_fields_of_another_kind_are_refused(value: object) -> None:
    with pytest.raises(InputError, match="`a`"):
        check_kinds({"a": value}, {"a": int})
    check_kinds({"b": value}, {"a": int})


# --- models


@pytest.fixture
def model(tmp_path: Path) -> Path:
    folder = tmp_path / "model"
    shutil.copytree(pretrained_path("psi_low"), folder)
    return folder


def test_weights_that_are_no_numbers_are_refused(model: Path) -> None:
    """They have checksums that fit: whoever writes them can write those too."""
    description = json.loads((model / "model.json").read_text())
    weights = members_of(load_model(model)).params
    for value in (math.nan, math.inf):
        plain = jax.tree.map(np.array, nnx.to_pure_dict(weights))
        jax.tree.leaves(plain)[0].flat[0] = value
        shutil.rmtree(model / "weights")
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as checkpointer:
            checkpointer.save(model / "weights", args=ocp.args.PyTreeSave(plain))
        description["files"] = _digests(model / "weights")
        (model / "model.json").write_text(json.dumps(description))
        with pytest.raises(InputError, match="no finite numbers"):
            load_model(model)


def _with(name: str, value: object) -> Callable[[dict[str, Any]], None]:
    return lambda description: description.update({name: value})


@pytest.mark.parametrize("value", ["x", 3, None, [1], True])
@pytest.mark.parametrize("name", ["architecture", "normaliser", "dataset", "training", "files"])
def test_a_description_of_other_kinds_is_refused(model: Path, name: str, value: object) -> None:
    description = json.loads((model / "model.json").read_text())
    _with(name, value)(description)
    (model / "model.json").write_text(json.dumps(description))
    with pytest.raises(InputError, match=f"`{name}`"):
        load_model(model)


# --- piles


@pytest.mark.parametrize("height", [3.0, 0.2])
def test_a_pile_that_covers_the_whole_map_has_no_toe(tmp_path: Path, height: float) -> None:
    x, y = np.meshgrid(np.arange(60) * 0.2, np.arange(60) * 0.2, indexing="ij")
    surface = height + 0.3 * np.abs(np.sin(x + y))
    path = tmp_path / "a.npz"
    np.savez(path, height=surface, cell_size=0.2, ground=np.zeros_like(surface))
    with pytest.raises(InputError, match="covers the whole map"):
        toe_contour(io.read_pile(path))
