"""Every format of pile files: read as it was written, refused in one line where it is broken."""

import importlib
import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from laws import volume
from scan_files import points_of, refused, save, write_las, write_ply, write_tif

from wlplan import io
from wlplan.errors import InputError
from wlplan.io import readers
from wlplan.io.readers import find_reader, known_endings, register_reader
from wlplan.terrain.seed_piles import seed_pile
from wlplan.types import Pile


@pytest.fixture
def pile() -> Pile:
    return seed_pile("conical", slope=math.radians(30.0), height=2.0, seed=1)


@pytest.fixture
def fields(pile: Pile) -> dict[str, Any]:
    """What a valid .npz holds."""
    return {"height": np.asarray(pile.height), "cell_size": 0.1, "origin": np.asarray(pile.origin)}


# --- all formats


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"not a zip at all", bytes(1000)])
@pytest.mark.parametrize("ending", known_endings())
def test_files_of_something_else_are_refused(
    tmp_path: Path, content: bytes, ending: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"pile{ending}"
    path.write_bytes(content)
    refused(path, "pile")
    assert capfd.readouterr() == ("", "")


def damaged(content: bytes, random: np.random.Generator) -> Iterator[bytes]:
    """Copies of a file that are cut short or have some bytes changed."""
    for share in (0.1, 0.5, 0.9, 0.99):
        yield content[: int(share * len(content))]
    for _ in range(30):
        changed = bytearray(content)
        for place in random.integers(0, len(content), 4):
            changed[place] = random.integers(0, 256)
        yield bytes(changed)
    for _ in range(20):  # the headers are where it hurts
        changed = bytearray(content)
        for place in random.integers(0, min(len(content), 400), 3):
            changed[place] = random.integers(0, 256)
        yield bytes(changed)


def outcome(path: Path) -> str:
    """Return "read", or the message that a pile was refused with; anything else fails the test."""
    try:
        io.read_pile(path)
    except InputError as error:
        return str(error)
    return "read"


def check_damage(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    content = path.read_bytes()
    outcomes = []
    for broken in damaged(content, np.random.default_rng(0)):
        path.write_bytes(broken)
        outcomes.append(outcome(path))
    assert all("\n" not in message for message in outcomes)
    assert sum(message != "read" for message in outcomes) >= 4
    assert capfd.readouterr() == ("", "")


# --- npz


def test_a_single_array_is_refused(tmp_path: Path, fields: dict[str, Any]) -> None:
    with (tmp_path / "pile.npz").open("wb") as file:
        np.save(file, fields["height"])
    refused(tmp_path / "pile.npz", "single array")


def test_damaged_npz_files_are_refused_or_read_but_never_crash(
    tmp_path: Path, fields: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    fields["height"] = fields["height"][20:80, 20:80]
    np.savez_compressed(tmp_path / "pile.npz", **fields)
    check_damage(tmp_path / "pile.npz", capfd)


# --- GeoTIFF


def test_geotiff_rows_run_from_north_to_south(tmp_path: Path, pile: Pile) -> None:
    height = np.asarray(pile.height)
    height = height + 0.001 * np.arange(height.shape[1])  # not the same in x and y
    west, south = 100.0, 200.0
    north = south + 0.1 * height.shape[1]
    path = write_tif(tmp_path / "pile.tif", height.T[::-1], west=west, north=north)
    again = io.read_pile(path)
    np.testing.assert_allclose(again.height, height, atol=1e-6)
    np.testing.assert_allclose(again.origin, [west + 0.05, south + 0.05], atol=1e-4)
    assert again.valid is None


def test_geotiff_that_runs_from_south_to_north(tmp_path: Path, pile: Pile) -> None:
    rasterio = pytest.importorskip("rasterio")
    band = np.asarray(pile.height)
    upward = rasterio.Affine(0.1, 0.0, 100.0, 0.0, 0.1, 200.0)
    again = io.read_pile(write_tif(tmp_path / "pile.tiff", band.T.copy(), transform=upward))
    np.testing.assert_allclose(again.height, band, atol=1e-6)
    np.testing.assert_allclose(again.origin, [100.05, 200.05], atol=1e-4)


def test_geotiff_nodata_and_nan_are_unseen(tmp_path: Path, pile: Pile) -> None:
    band = np.asarray(pile.height).T.copy()
    band[10, 20:30], band[12, 5] = -9999.0, np.nan
    again = io.read_pile(write_tif(tmp_path / "pile.tif", band, nodata=-9999.0))
    assert int(np.sum(~np.asarray(again.valid))) == 11
    assert float(again.height.min()) == 0.0


def test_geotiff_in_survey_coordinates(tmp_path: Path, pile: Pile) -> None:
    band = np.asarray(pile.height).T + np.float32(64.0)
    path = write_tif(tmp_path / "p.tif", band, west=431_000.0, north=6_512_900.0, crs="EPSG:32633")
    again = io.read_pile(path)
    np.testing.assert_allclose(again.origin, [0.05, 900.0 - 0.1 * len(band) + 0.05], atol=1e-3)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"crs": "EPSG:4326"}, "metres"),
        ({"crs": "EPSG:3857", "north": 6.0e6, "west": 1.0e6}, "1.48 times"),  # Web Mercator
        ({"crs": "EPSG:4978"}, "earth-centred"),
        ({"transform": (0.1, 0.0, 0.0, 0.0, -0.2, 0.0)}, "square"),
        ({"transform": (0.1, 0.02, 0.0, 0.02, -0.1, 0.0)}, "square"),
        ({"transform": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)}, "no georeference"),
        ({"step": 50.0}, "4000 cells"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_geotiffs_without_square_metric_cells_are_refused(
    tmp_path: Path, pile: Pile, options: dict[str, Any], match: str
) -> None:
    rasterio = pytest.importorskip("rasterio")
    if "transform" in options:
        options = {**options, "transform": rasterio.Affine(*options["transform"])}
    refused(write_tif(tmp_path / "pile.tif", np.asarray(pile.height), **options), match)


def test_damaged_geotiffs_are_refused_or_read_but_never_crash(
    tmp_path: Path, pile: Pile, capfd: pytest.CaptureFixture[str]
) -> None:
    write_tif(tmp_path / "pile.tif", np.asarray(pile.height)[20:80, 20:80], compress="deflate")
    check_damage(tmp_path / "pile.tif", capfd)


# --- point clouds


@pytest.mark.parametrize("ending", [".las", ".laz", ".ply"])
def test_point_clouds_are_gridded(tmp_path: Path, pile: Pile, ending: str) -> None:
    points = points_of(pile, np.random.default_rng(0))
    write = write_ply if ending == ".ply" else write_las
    again = io.read_pile(write(tmp_path / f"pile{ending}", points))
    assert again.height.shape == pile.height.shape
    np.testing.assert_allclose(again.origin, pile.origin, atol=2e-3)
    valid = np.ones(pile.height.shape, bool) if again.valid is None else np.asarray(again.valid)
    assert valid.mean() > 0.99
    error = np.abs(np.asarray(again.height - pile.height))
    assert np.median(error) < 1e-3
    assert np.quantile(error, 0.99) < 0.1  # cells filled from their neighbours
    assert volume(again) == pytest.approx(float(volume(pile)), rel=0.01)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_encodings_read_alike(tmp_path: Path, pile: Pile, encoding: str) -> None:
    points = points_of(pile, np.random.default_rng(0), 20_000)
    want = io.read_pile(write_ply(tmp_path / "a.ply", points))
    again = io.read_pile(write_ply(tmp_path / "b.ply", points, encoding))
    np.testing.assert_allclose(again.height, want.height, atol=2e-3)


def test_cells_without_points_are_unseen_and_filled(tmp_path: Path, pile: Pile) -> None:
    points = points_of(pile, np.random.default_rng(0), 200_000)
    hole = np.hypot(points[:, 0] - 1.0, points[:, 1]) < 0.8
    again = io.read_pile(write_ply(tmp_path / "pile.ply", points[~hole]))
    assert np.sum(~np.asarray(again.valid)) * 0.01 == pytest.approx(math.pi * 0.8**2, rel=0.2)
    assert np.isfinite(again.height).all()


def test_the_median_of_a_cell_ignores_a_bird(tmp_path: Path, pile: Pile) -> None:
    points = points_of(pile, np.random.default_rng(0), 100_000)
    points[7, 2] += 30.0
    again = io.read_pile(write_ply(tmp_path / "pile.ply", points))
    assert float(again.height.max()) < 3.0


def test_a_sparse_cloud_is_gridded_by_its_spacing(tmp_path: Path, pile: Pile) -> None:
    points = points_of(pile, np.random.default_rng(0), 1500)
    again = io.read_pile(write_ply(tmp_path / "pile.ply", points))
    assert again.cell_size == 0.1
    assert np.mean(np.ones(1) if again.valid is None else np.asarray(again.valid)) > 0.7
    assert volume(again) == pytest.approx(float(volume(pile)), rel=0.1)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (b"property double z\n", b"property double q\n", "no x, y and z"),
        (b"element vertex", b"element face", "vertices"),
        (b"binary_little_endian", b"binary_middle_endian", "unknown format"),
        (b"property float y", b"property list uchar int y", "vertices of type"),
        (b"vertex 9000", b"vertex 9999999", "cut short"),
        (b"vertex 9000", b"vertex many", "cannot be read"),
        (b"vertex 9000", b"vertex 0", "three points"),
    ],
)
def test_bad_ply_headers_are_refused(
    tmp_path: Path, pile: Pile, old: bytes, new: bytes, match: str
) -> None:
    path = write_ply(tmp_path / "pile.ply", points_of(pile, np.random.default_rng(0), 9000))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    refused(path, match)


def test_a_cloud_of_two_places_far_apart_is_refused(tmp_path: Path, pile: Pile) -> None:
    points = points_of(pile, np.random.default_rng(0), 9000)
    points[::2, 0] += 5000.0
    refused(write_ply(tmp_path / "pile.ply", points), "crop it")


@pytest.mark.parametrize("ending", [".las", ".laz", ".ply"])
def test_damaged_point_clouds_are_refused_or_read_but_never_crash(
    tmp_path: Path, pile: Pile, ending: str, capfd: pytest.CaptureFixture[str]
) -> None:
    points = points_of(pile, np.random.default_rng(0), 3000)
    write = write_ply if ending == ".ply" else write_las
    check_damage(write(tmp_path / f"pile{ending}", points), capfd)


@pytest.mark.parametrize(
    ("ending", "content", "module"),
    [
        (".tif", b"II*\0", "rasterio"),
        (".laz", b"x", "laspy"),
        (".e57", b"x", "pye57"),
        (".stl", b"solid", "trimesh"),
        (".mcap", b"\x89MCAP0\r\n", "rosbags"),
    ],
)
def test_a_missing_reader_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str, content: bytes, module: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    path = tmp_path / f"pile{ending}"
    path.write_bytes(content)
    refused(path, rf"needs {module}, .*pip install (wlplan\[scan\]|pye57)`")


# --- the readers themselves

ROOT = Path(__file__).parents[1]
MODULES = sorted(path.stem for path in (ROOT / "wlplan/io/readers").glob("[!_]*.py"))


def in_a_process(code: str, path: Path) -> str:
    """What a fresh interpreter prints that finds modules and packages in a folder, too."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {[str(ROOT), str(path)]}; {code}"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stdout.strip()


def test_every_reader_declares_its_endings_and_no_two_the_same() -> None:
    modules = [importlib.import_module(f"wlplan.io.readers.{name}") for name in MODULES]
    endings = [ending for module in modules for ending in module.ENDINGS]
    assert len(modules) >= 9
    assert all(module.__doc__ and all(module.ENDINGS) for module in modules)
    assert all(re.fullmatch(r"\.[a-z0-9]+", ending) for ending in endings)
    assert len(endings) == len(set(endings))
    assert set(endings) <= set(known_endings())
    for module in modules:
        for ending in module.ENDINGS:
            assert find_reader(Path(f"PILE{ending.upper()}")) is module


def test_endings_are_told_without_the_libraries_of_the_formats_or_jax(tmp_path: Path) -> None:
    """Of what is no part of Python, only numpy may be imported."""
    code = (
        "before = set(sys.modules); from wlplan.io import readers; readers.known_endings(); "
        "names = {name.split('.')[0] for name in set(sys.modules) - before}; "
        "print(sorted(names - set(sys.stdlib_module_names) - {'wlplan', 'numpy', 'lazy_loader'}))"
    )
    assert in_a_process(code, tmp_path) == "[]"


(EXAMPLE,) = re.findall(
    r"## Your own reader\n.*?```python\n(.*?)```", (ROOT / "docs/extending.md").read_text(), re.S
)


@pytest.fixture
def pts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The example of the documentation as a module that can be imported, its name on the path."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "their_pts.py").write_text(EXAMPLE)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(readers, "_registered", {})
    monkeypatch.delitem(sys.modules, "their_pts", raising=False)
    return folder


def offer(folder: Path, package: str, *lines: str) -> None:
    """Let a folder look like one that a package with entry points was installed into."""
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    text = "\n".join(["[wlplan.readers]", *lines])
    (info / "entry_points.txt").write_text(text)


def write_pts(path: Path, points: np.ndarray) -> Path:
    np.savetxt(path, points, "%.4f", header=f"{len(points)}", comments="")
    return path


def test_the_documented_reader_reads_a_cloud_once_it_is_registered(
    tmp_path: Path, pile: Pile, pts: Path
) -> None:
    points = points_of(pile, np.random.default_rng(0), 20_000)
    path = write_pts(tmp_path / "pile.pts", points)
    refused(path, r"unknown kind of pile file '\.pts'")
    module = importlib.import_module("their_pts")
    register_reader(module)
    register_reader(module)  # nothing new
    assert ".pts" in known_endings()
    want = io.read_pile(write_ply(tmp_path / "pile.ply", np.round(points, 4)))
    np.testing.assert_allclose(io.read_pile(path).height, want.height, atol=1e-3)
    path.write_text("2\n1 2\n3 4\n")
    refused(path, "not the points that it counts")
    path.write_text("one two three\n")
    refused(path, r"cannot be read as \.pts")


def test_the_documented_reader_comes_with_a_package(tmp_path: Path, pile: Pile, pts: Path) -> None:
    offer(pts, "theirs", "pts = their_pts")
    path = write_pts(tmp_path / "pile.pts", points_of(pile, np.random.default_rng(0), 2000))
    assert ".pts" in known_endings()
    assert "their_pts" not in sys.modules  # only loaded for a file of its own
    assert np.isfinite(io.read_pile(path).height).all()
    check = f"from wlplan.cli import inputs; inputs.check_pile_name({str(path)!r})"
    assert in_a_process(f"{check}; print('jax' in sys.modules)", pts) == "False"


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        (["pts = no_such_module"], "no_such_module, which reads .pts, cannot be used .*No module"),
        (["pts = math"], "math is no reader"),
        (["pts = their_pts:ENDINGS"], "tuple is no reader"),
    ],
)
def test_a_package_with_a_broken_reader_is_named(
    tmp_path: Path, fields: dict[str, Any], pts: Path, lines: list[str], match: str
) -> None:
    offer(pts, "theirs", *lines)
    (tmp_path / "pile.pts").write_text("1 2 3")
    refused(tmp_path / "pile.pts", match)
    io.read_pile(save(tmp_path / "pile.npz", fields))  # all others are read as ever


def test_two_packages_for_one_ending_are_refused(tmp_path: Path, pts: Path) -> None:
    offer(pts, "theirs", "pts = their_pts")
    offer(pts, "others", "PTS = others_pts")
    (tmp_path / "pile.pts").write_text("1 2 3")
    refused(tmp_path / "pile.pts", "others_pts and their_pts both read .pts")


def reader(*endings: object, read: object = lambda path: None, **names: Any) -> SimpleNamespace:
    return SimpleNamespace(__name__="mine", ENDINGS=endings, read=read, **names)


@pytest.mark.parametrize(
    ("candidate", "match"),
    [
        (reader(".pts", read=3), "mine is no reader"),
        (reader(), "`ENDINGS`"),
        (reader("pts"), "`ENDINGS`"),
        (reader(".PTS"), "`ENDINGS`"),
        (reader(".pts", ".a.b"), "`ENDINGS`"),
        (reader(".pts", 3), "`ENDINGS`"),
        (SimpleNamespace(ENDINGS=".pts", read=len), "`ENDINGS`"),
        (reader(".pts", ".ply"), r"mine reads \.ply, as wlplan\.io\.readers\.ply does already"),
    ],
)
def test_what_is_no_reader_is_not_registered(
    monkeypatch: pytest.MonkeyPatch, candidate: Any, match: str
) -> None:
    monkeypatch.setattr(readers, "_registered", {})
    with pytest.raises(InputError, match=match):
        register_reader(candidate)
    assert ".pts" not in known_endings()


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.zeros(3), np.full((5, 3), "a")])
def test_points_that_are_no_points_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, points: np.ndarray
) -> None:
    monkeypatch.setattr(readers, "_registered", {})
    register_reader(reader(".pts", read=lambda path: io.PointCloud(points)))
    (tmp_path / "pile.pts").write_text("")
    refused(tmp_path / "pile.pts", "`points`")


def test_a_reader_that_returns_something_else_is_a_fault_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readers, "_registered", {})
    register_reader(reader(".pts"))
    (tmp_path / "pile.pts").write_text("")
    with pytest.raises(TypeError, match="returned None"):
        io.read_pile(tmp_path / "pile.pts")
