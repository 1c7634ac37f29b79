"""Makes the corpus of files with something wrong, each named after what that is.

    python tests/make_corpus.py     writes tests/corpus anew

`tests/test_corpus.py` reads all of them. What `make fuzz` finds is added as it is, by hand; this
script leaves it alone. Folders (models, data sets) are kept as archives.
"""

from __future__ import annotations

import io
import json
import struct
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import test_readers_fuzz as scans
from flax import nnx
from scan_files import write_tif

from wlplan.dataset import store
from wlplan.dataset.layout import Layout
from wlplan.dataset.variables import VARIABLES
from wlplan.engines.simulator import Simulator
from wlplan.models.normaliser import Normaliser
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.models.storage import save_model

CORPUS = Path(__file__).parent / "corpus"
Named = Iterator[tuple[str, bytes]]


def put(content: bytes, at: int, form: str, *values: float) -> bytes:
    """A content with numbers written over it."""
    new = struct.pack(form, *values)
    return content[:at] + new + content[at + len(new) :]


def replaced(content: bytes, old: bytes, new: bytes) -> bytes:
    """A content with one part replaced, which has to be there."""
    assert old in content, old
    return content.replace(old, new, 1)


# --- scans


def cut_scans() -> Named:
    """Every format, without its end and without most of its head."""
    for name in scans.WRITERS:
        content, ending = scans.whole(name), name if name[0] == "." else f"-{name}"
        yield f"cut-in-its-head{ending}", content[:60]
        part = content[: min(len(content) * 2 // 3, 4000)]
        yield f"cut-in-its-data{ending}", scans.checked(Path(f"a{name}").suffix, part)
    yield "empty.xyz", b""
    yield "empty.tif", b""


def npz(**fields: Any) -> bytes:
    """A height map of numpy with other fields."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        good: dict[str, Any] = {"height": scans.HEIGHTS, "cell_size": 0.4}
        np.savez_compressed(path, **(good | fields))
        return path.read_bytes()


def heightmaps() -> Named:
    """Maps whose numbers make no sense."""
    high = scans.HEIGHTS
    yield "all-cells-nan.npz", npz(height=np.full_like(high, np.nan))
    yield "one-cell-infinite.npz", npz(height=np.where(high == high.max(), np.inf, high))
    yield "heights-of-1e30.npz", npz(height=1e30 * high)
    yield "heights-are-text.npz", npz(height=high.astype(str))
    yield "heights-are-complex.npz", npz(height=high.astype(complex))
    yield "heights-are-pickled.npz", npz(height=high.astype(object))
    yield "heights-are-dates.npz", npz(height=high.astype("datetime64[s]"))
    yield "heights-in-3-d.npz", npz(height=high[None])
    yield "no-heights.npz", npz(height=high[:0])
    yield "cell-of-nothing.npz", npz(cell_size=0.0)
    yield "cell-is-nan.npz", npz(cell_size=np.nan)
    yield "cell-is-a-list.npz", npz(cell_size=[0.4, 0.4])
    yield "cell-of-a-nanometre.npz", npz(cell_size=1e-9)
    yield "cell-of-a-kilometre.npz", npz(cell_size=1000.0)
    yield "origin-is-infinite.npz", npz(origin=[np.inf, 0.0])
    yield "origin-has-one-number.npz", npz(origin=[1.0])
    yield "nothing-seen.npz", npz(valid=np.zeros_like(high, bool))
    yield "seen-is-two.npz", npz(valid=np.full_like(high, 2.0))
    yield "floor-of-another-shape.npz", npz(ground=high[1:])
    yield "floor-all-nan.npz", npz(ground=np.full_like(high, np.nan))
    text = scans.whole(".asc")
    yield "a-million-columns.asc", replaced(text, b"ncols", b"ncols 1000000\nold")
    yield "rows-missing.asc", text[: len(text) // 2]
    yield "words-for-heights.asc", text[:-80] + b"deep deeper deepest"
    yield "heights-nan.asc", replaced(text, text.split()[-1], b"nan")
    yield "cells-negative.asc", replaced(text, b"cellsize ", b"cellsize -")


def tiff(name: str, step: float, **profile: Any) -> bytes:
    """A GeoTIFF of many cells of which none is written."""
    import rasterio

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        if "width" not in profile:
            write_tif(path, scans.HEIGHTS.T[::-1].copy(), step=step, **profile)
            return path.read_bytes()
        transform = rasterio.Affine(step, 0.0, 0.0, 0.0, -step, 0.0)
        of = {"driver": "GTiff", "dtype": "float32", "count": 1, "transform": transform}
        tiles = {"tiled": True, "sparse_ok": True, "blockxsize": 1024, "blockysize": 1024}
        with rasterio.open(path, "w", **of, **tiles, **profile):
            pass
        return path.read_bytes()


def rasters() -> Named:
    """GeoTIFFs."""
    yield "20000-cells-a-side.tif", tiff("a.tif", 0.1, width=20_000, height=20_000)
    yield "a-million-cells-wide.tif", tiff("a.tif", 0.1, width=1_000_000, height=4)
    yield "cells-of-a-micrometre.tif", tiff("a.tif", 1e-6)
    whole = scans.whole(".tif")
    yield "directory-beyond-its-end.tif", put(whole, 4, "<I", 2**31)
    yield "directory-is-its-head.tif", put(whole, 4, "<I", 0)
    yield "entries-65535.tif", put(whole, int.from_bytes(whole[4:8], "little"), "<H", 65_535)
    yield "packed-data-all-ones.tiff", scans.whole(".tiff")[:-40] + b"\xff" * 40


def clouds() -> Named:
    """Points and meshes."""
    las, laz = scans.whole(".las"), scans.whole(".laz")
    for name, whole in (("las", las), ("laz", laz)):
        yield f"points-4-billion.{name}", put(whole, 107, "<I", 2**32 - 1)
        yield f"points-begin-beyond-its-end.{name}", put(whole, 96, "<I", 2**31 - 1)
        yield f"scale-nan.{name}", put(whole, 131, "<d", float("nan"))
        yield f"scale-zero.{name}", put(whole, 131, "<ddd", 0.0, 0.0, 0.0)
        yield f"offset-infinite.{name}", put(whole, 155, "<d", float("inf"))
        yield f"point-of-no-bytes.{name}", put(whole, 105, "<H", 0)
        yield f"records-4-billion.{name}", put(whole, 100, "<I", 2**32 - 1)
    ply, text = scans.whole(".ply"), scans.whole("text.ply")
    start = ply.index(b"end_header\n") + 11
    yield "vertices-nan.ply", put(ply, start, "<fff", *[float("nan")] * 3)
    for name, count in (("4-billion", b"4000000000"), ("minus-one", b"-1"), ("1e99", b"1e99")):
        line = next(one for one in ply.split(b"\n") if one.startswith(b"element vertex"))
        yield f"vertices-{name}.ply", replaced(ply, line, b"element vertex " + count)
    yield "vertex-is-a-list.ply", replaced(text, b"property ", b"property list uchar ")
    yield "type-of-nothing.ply", replaced(text, b"property ", b"property quaternion w\nproperty ")
    pcd = scans.whole("text.pcd")
    yield "sizes-negative.pcd", replaced(pcd, b"SIZE ", b"SIZE -")
    yield "width-of-a-billion.pcd", replaced(pcd, b"WIDTH ", b"WIDTH 1000000")
    yield "fields-missing.pcd", replaced(pcd, b"FIELDS ", b"FIELDS a b c ")
    packed = scans.whole("packed.pcd")
    at = packed.index(b"DATA binary_compressed\n") + 23
    yield "packed-4-gib-in-4-kb.pcd", put(packed, at + 4, "<I", 2**32 - 1)
    obj = scans.whole(".obj")
    yield "face-of-no-vertex.obj", obj + b"f 1 2 999999999\n"
    yield "face-counted-from-below.obj", obj + b"f -1 -2 -999999999\n"
    yield "vertex-of-words.obj", replaced(obj, b"v ", b"v one two three\nv ")
    yield "names-a-material.obj", b"mtllib /etc/passwd\nusemtl x\n" + obj
    stl = scans.whole(".stl")
    yield "triangles-4-billion.stl", put(stl, 80, "<I", 2**32 - 1)
    yield "corner-nan.stl", put(stl, 96, "<f", float("nan"))
    yield "corner-infinite.stl", put(stl, 96, "<f", float("inf"))
    yield "without-triangles.stl", put(stl, 80, "<I", 0)[:84]
    rows = scans.whole(".xyz")
    yield "one-column.xyz", b"\n".join(line.split()[0] for line in rows.split(b"\n") if line)
    yield "columns-come-and-go.xyz", rows + b"1 2\n1 2 3 4\n"
    yield "far-away.xyz", rows + b"1e30 1e30 1e30\n"
    yield "utf-16.csv", b"\xff\xfe" + scans.whole(".csv").decode().encode("utf-16-le")
    yield "without-numbers.csv", b"x;y;z\n"
    yield "a-line-of-20-kb.csv", b"x;y;z\n" + b"1" * 20_000 + b"\n"
    yield "nul-bytes.txt", rows[:200] + bytes(100) + rows[200:]
    e57 = scans.whole(".e57")
    yield "checksums-wrong.e57", e57[:600] + b"x" + e57[601:]
    yield "xml-beyond-its-end.e57", scans.checked(".e57", put(e57, 24, "<Q", 10**12))
    yield "pages-of-no-bytes.e57", scans.checked(".e57", put(e57, 40, "<Q", 0))
    xml = e57.index(b"<?xml") + 5
    yield "xml-broken.e57", scans.checked(".e57", e57[:xml] + b"<" * 9 + e57[xml + 9 :])


def recordings() -> Named:
    """Recordings of robots."""
    bag, mcap = scans.whole(".bag"), scans.whole(".mcap")
    yield "index-beyond-its-end.bag", put(bag, bag.index(b"index_pos=") + 10, "<Q", 2**40)
    yield "connections-4-billion.bag", put(bag, bag.index(b"conn_count=") + 11, "<I", 2**32 - 1)
    yield "record-of-2-gib.bag", put(bag, 13, "<I", 2**31 - 1)
    yield "chunk-of-a-terabyte.mcap", put(mcap, 9, "<Q", 2**40)
    yield "another-magic.mcap", b"\x89MCAP9\r\n" + mcap[8:]
    text = scans.whole(".db3")
    yield "schema-renamed.db3", replaced(text, b"CREATE TABLE", b"CREATE BLAME")[:4500]
    yield "page-size-one.db3", put(text, 16, ">H", 1)[:4500]


# --- documents

LOAD: dict[str, Any] = {
    **dict.fromkeys(("x", "y", "heading"), 0.0),
    "action": dict.fromkeys(("delta_bm", "k_bm", "delta_bk", "k_bk"), 0.5),
}
PLAN: dict[str, Any] = {"format": "wlplan.plan/1", "loads": [LOAD, LOAD]}


def plans() -> Named:
    """Files that are to be a plan.json."""

    def plan(**fields: Any) -> bytes:
        return json.dumps(PLAN | fields).encode()

    action = LOAD["action"]
    for name, content in {
        "no-json": b"load 1: dig",
        "cut": plan()[:80],
        "latin-1": b'{"format": "wlplan.plan/1", "note": "\xe4"}',
        "a-list": b"[1, 2]",
        "a-number": b"12",
        "deep": b"[" * 5000 + b"]" * 5000,
        "number-of-5000-digits": plan(seed=0)[:-1] + b', "n": ' + b"9" * 5000 + b"}",
        "nan": plan().replace(b"0.0", b"NaN", 1),
        "twice-the-same-key": plan()[:-1] + b', "loads": []}',
        "another-version": plan(format="wlplan.plan/9"),
        "no-loads": plan(loads=[]),
        "loads-are-numbers": plan(loads=[1, 2]),
        "a-load-is-null": plan(loads=[LOAD, None]),
        "x-is-text": plan(loads=[{**LOAD, "x": "0"}]),
        "x-is-true": plan(loads=[{**LOAD, "x": True}]),
        "x-is-1e300": plan(loads=[{**LOAD, "x": 1e300}]),
        "heading-in-degrees": plan(loads=[{**LOAD, "heading": 180.0}]),
        "action-outside-its-box": plan(loads=[{**LOAD, "action": {**action, "k_bm": 6.0}}]),
        "action-is-a-list": plan(loads=[{**LOAD, "action": [0.5] * 4}]),
        "trucks-share-a-load": plan(trucks=[{"loads": [0]}, {"loads": [0, 1]}]),
        "truck-is-null": plan(trucks=[None]),
        "frame-of-two-numbers": plan(frame={"offset": [1.0, 2.0], "crs": None}),
        "frame-is-true": plan(frame={"offset": [True, True, True], "crs": None}),
        "soil-without-parameters": plan(soil={"name": "gravel"}),
        "soil-of-antimatter": plan(soil={"name": "a", "parameters": {"density": -1727.0}}),
        "machine-is-text": plan(machine="wa320"),
        "amount-negative": plan(job={"amount": "tonnes", "mass": -5.0}),
        "receiver-without-heading": plan(receiver={"x": 1.0, "y": 2.0}),
        "objective-names-a-module": plan(objective="os:system"),
        "pile-names-a-file": plan(pile={"keep_out": "/etc/passwd", "sha256": "0"}),
        "predicted-is-text": plan(loads=[{**LOAD, "predicted": "much"}]),
        "stall-of-two": plan(loads=[{**LOAD, "stall_probability": 2.0}]),
    }.items():
        yield f"{name}.json", content


def parameters(preset: str, number: str) -> Named:
    """Files that are to be a soil or a machine."""
    for name, text in {
        "no-toml": "density is 1700",
        "cut": f"{number} = ",
        "nan": f"{number} = nan",
        "infinite": f"{number} = inf",
        "negative": f"{number} = -1.0",
        "text": f'{number} = "1"',
        "a-list": f"{number} = [1.0]",
        "a-table": f"[{number}]\nx = 1",
        "true": f"{number} = true",
        "a-date": f"{number} = 2026-01-01",
        "twice": f"{number} = 1.0\n{number} = 2.0",
        "number-of-5000-digits": f"{number} = {'9' * 5000}",
        "deep": f"{number} = {'[' * 2000}{']' * 2000}",
        "unknown-field": "colour = 1.0",
        "preset-of-nothing": 'preset = "cheese"',
        "preset-is-a-number": "preset = 1",
        "field-with-an-escape": '"\\u001b[31m" = 1.0',
        "empty": "",
        "only-a-preset": f'preset = "{preset}"',
    }.items():
        yield f"{name}.toml", text.encode()
    yield "latin-1.toml", b"# \xe4\n"
    yield "byte-order-mark.toml", b"\xef\xbb\xbf" + f"{number} = 1.0".encode()


def areas() -> Named:
    """Files that are to hold polygons."""
    ring = [[0.0, 0.0], [5.0, 0.0], [5.0, 5.0], [0.0, 0.0]]

    def of(coordinates: Any, shape: str = "Polygon", **properties: Any) -> bytes:
        geometry = {"type": shape, "coordinates": coordinates}
        return json.dumps({"geometry": geometry, "properties": properties}).encode()

    for name, content in {
        "no-json": b"<kml/>",
        "null": b"null",
        "features-are-text": b'{"features": "all"}',
        "no-polygon": of([0.0, 0.0], "Point"),
        "two-corners": of([ring[:2]]),
        "corners-are-text": of([["a", "b", "c"]]),
        "corner-of-one-number": of([[[0.0], [1.0], [2.0]]]),
        "corner-far-away": of([[*ring, [1e308, 1e308]]]),
        "coordinates-null": of(None),
        "coordinates-empty": of([]),
        "multi-is-flat": of(ring, "MultiPolygon"),
        "all-corners-alike": of([[[1.0, 1.0]] * 4]),
        "crosses-itself": of([[[0.0, 0.0], [5.0, 5.0], [5.0, 0.0], [0.0, 5.0]]]),
        "kind-unknown": of([ring], kind="swamp"),
        "kind-is-a-list": of([ring], kind=["no-go"]),
        "height-negative": of([ring], height=-1.0),
        "height-is-text": of([ring], height="high"),
    }.items():
        yield f"{name}.geojson", content


# --- folders


def archive(files: dict[str, bytes]) -> bytes:
    """Files of a folder as one, with the same bytes every time."""
    whole = io.BytesIO()
    with tarfile.open(fileobj=whole, mode="w:xz", format=tarfile.USTAR_FORMAT) as found:
        for name in sorted(files):
            entry = tarfile.TarInfo(name)
            entry.size = len(files[name])
            found.addfile(entry, io.BytesIO(files[name]))
    return whole.getvalue()


def files_of(folder: Path) -> dict[str, bytes]:
    """Content of each file below a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def changed(files: dict[str, bytes], name: str, fields: dict[str, Any]) -> dict[str, bytes]:
    """Files with other fields in one that is JSON; "a__b" is field b of field a."""
    document = json.loads(files[name])
    for place, value in fields.items():
        record, *inner = document, *place.split("__")
        for key in inner[:-1]:
            record = record[key]
        record[inner[-1]] = value
    return files | {name: json.dumps(document).encode()}


def small_model(folder: Path) -> None:
    """A model that knows nothing."""
    graph, params = nnx.split(PsiLow((4,), rngs=nnx.Rngs(0)))
    inputs, outputs = (Normaliser.of(np.eye(n, dtype=np.float32)) for n in (8, 3))
    save_model(folder, LowPerformanceModel(params, inputs, outputs, graph), {})


def models() -> Named:
    """Folders that are to be a model."""
    with tempfile.TemporaryDirectory() as folder:
        small_model(Path(folder) / "m")
        files = files_of(Path(folder) / "m")
    card = "model.json"
    weights = [name for name in files if name != card]
    data = max(weights, key=lambda name: len(files[name]))
    yield "without-weights", archive({card: files[card]})
    yield "without-its-card", archive({name: files[name] for name in weights})
    yield "card-no-json", archive(files | {card: b"model"})
    yield "card-a-list", archive(files | {card: b"[]"})
    yield "weights-cut", archive(files | {data: files[data][:-5]})
    yield "weights-changed", archive(files | {data: b"\0" + files[data][1:]})
    yield "weights-empty", archive(files | {data: b""})
    yield "one-file-more", archive(files | {"weights/more": b"x"})
    damages: dict[str, dict[str, Any]] = {
        "format-of-tomorrow": {"format": "wlplan.model/99"},
        "kind-of-nothing": {"kind": "psi_none"},
        "kind-a-list": {"kind": []},
        "hidden-a-billion": {"architecture__hidden": [10**9, 10**9]},
        "hidden-negative": {"architecture__hidden": [-4]},
        "hidden-text": {"architecture__hidden": ["4"]},
        "hidden-10000-layers": {"architecture__hidden": [4] * 10_000},
        "architecture-null": {"architecture": None},
        "members-a-billion": {"ensemble": {"members": 10**9, "factor": [1.0, 1.0, 1.0]}},
        "members-text": {"ensemble": {"members": "5", "factor": [1.0, 1.0, 1.0]}},
        "span-zero": {"normaliser__inputs__span": [0.0] * 8},
        "low-1e300": {"normaliser__inputs__low": [1e300] * 8},
        "normaliser-of-two": {"normaliser__outputs__low": [0.0, 0.0]},
        "files-name-others": {"files": {"../../x": "0"}},
    }
    for name, fields in damages.items():
        yield name, archive(changed(files, card, fields))


def small_store(folder: Path) -> None:
    """A data set of two cycles in which nothing happens."""
    layout = Layout(2)
    store.create(folder, layout, store.identity(layout, 0, "paper", Simulator()))
    store.write(folder, {n: np.zeros((2, *v.shape), v.dtype) for n, v in VARIABLES.items()}, 0)
    store.update_attributes(folder, {"cycles_done": 2, "command": "wlplan collect"})


def stores() -> Named:
    """Folders that are to be a data set."""
    with tempfile.TemporaryDirectory() as folder:
        small_store(Path(folder) / "d.zarr")
        files = files_of(Path(folder) / "d.zarr")
    group, mass = "zarr.json", "mass/zarr.json"
    chunk = "mass/c/0"
    assert chunk in files
    yield "chunk-missing", archive({n: c for n, c in files.items() if n != chunk})
    yield "chunk-cut", archive(files | {chunk: files[chunk][:5]})
    yield "chunk-empty", archive(files | {chunk: b""})
    yield "chunk-all-ones", archive(files | {chunk: b"\xff" * len(files[chunk])})
    yield "chunk-says-4-gib", archive(files | {chunk: put(files[chunk], 4, "<I", 2**32 - 1)})
    yield "array-missing", archive({n: c for n, c in files.items() if not n.startswith("mass/")})
    yield "group-no-json", archive(files | {group: b"group"})
    yield "array-no-json", archive(files | {mass: b"array"})
    damages: dict[str, dict[str, Any]] = {
        "cycles-a-trillion": {"attributes__cycles": 10**12, "attributes__cycles_done": 10**12},
        "cycles-negative": {"attributes__cycles": -1, "attributes__cycles_done": -1},
        "cycles-text": {"attributes__cycles": "2"},
        "more-done-than-there-are": {"attributes__cycles_done": 3},
        "half-done": {"attributes__cycles_done": 1},
        "format-of-tomorrow": {"attributes__format": "wlplan.dataset/99"},
        "soil-a-list": {"attributes__soil": []},
        "attributes-null": {"attributes": None},
        "zarr-of-version-9": {"zarr_format": 9},
        "a-shard": {"attributes__shard": 1, "attributes__shards": 2},
    }
    for name, fields in damages.items():
        yield name, archive(changed(files, group, fields))
    of_array: dict[str, dict[str, Any]] = {
        "array-of-text": {"data_type": "string"},
        "array-of-a-trillion": {"shape": [10**12]},
        "array-negative": {"shape": [-2]},
        "array-in-3-d": {"shape": [2, 2, 2]},
        "chunks-of-nothing": {"chunk_grid__configuration__chunk_shape": [0]},
        "chunks-of-a-trillion": {"chunk_grid__configuration__chunk_shape": [10**12]},
        "codec-unknown": {"codecs": [{"name": "rot13"}]},
        "no-codec": {"codecs": []},
        "kind-of-group": {"node_type": "group"},
    }
    for name, fields in of_array.items():
        # Readers look at the copy of it in the group first.
        copy = {f"consolidated_metadata__metadata__mass__{k}": v for k, v in fields.items()}
        yield name, archive(changed(changed(files, mass, fields), group, copy))


PARTS: dict[str, tuple[Callable[[], Named], ...]] = {
    "scans": (cut_scans, heightmaps, rasters, clouds, recordings),
    "plans": (plans,),
    "soils": (lambda: parameters("sand", "density"),),
    "machines": (lambda: parameters("wa320", "mass"),),
    "areas": (areas,),
    "models": (models,),
    "stores": (stores,),
}


def main() -> None:
    """Writes all of it."""
    for part, makers in PARTS.items():
        folder = CORPUS / part
        folder.mkdir(parents=True, exist_ok=True)
        ending = ".tar.xz" if part in ("models", "stores") else ""
        for make in makers:
            for name, content in make():
                (folder / f"{name}{ending}").write_bytes(content)


if __name__ == "__main__":
    main()
