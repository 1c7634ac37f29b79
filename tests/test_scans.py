"""Scans as people have them: units, classes, strays, layers. The pile comes out the same."""

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from laws import volume
from scan_files import refused, write_ply, write_tif

from wlplan.cli import main
from wlplan.io import ScannedPile, read_scan
from wlplan.io.reference import Reference, length_unit, unit_name

FOOT = 1200.0 / 3937.0  # US survey foot [m]
SIDES = (24.0, 20.0)
# Of a cone 3 m high at 32 degrees [m^3].
VOLUME = math.pi * 3.0**3 / (3.0 * math.tan(math.radians(32.0)) ** 2)


def cone(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    fall = math.tan(math.radians(32.0))
    height: np.ndarray = np.maximum(3.0 - np.hypot(x - 12.0, y - 10.0) * fall, 0.0)
    return height


def points(per_square_metre: float = 30.0, seed: int = 1) -> np.ndarray:
    random = np.random.default_rng(seed)
    count = int(SIDES[0] * SIDES[1] * per_square_metre)
    x, y = (random.uniform(0.0, side, count) for side in SIDES)
    return np.stack([x, y, cone(x, y) + random.normal(0.0, 0.01, count)], axis=-1)


def band(cell: float = 0.2) -> np.ndarray:
    """Rows from north to south, as a GeoTIFF has them."""
    axes = (np.arange(0.5 * cell, side, cell) for side in SIDES)
    x, y = np.meshgrid(*axes, indexing="ij")
    return cone(x, y).T[::-1].copy()


def write_cloud(
    path: Path,
    rows: np.ndarray,
    *,
    keys: dict[int, int] | None = None,
    wkt: str | None = None,
    classes: Any = 2,
    withheld: Any = 0,
) -> Path:
    laspy = pytest.importorskip("laspy")
    record = laspy.vlrs.vlr.VLR
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(rows.min(axis=0))
    if keys is not None:
        shorts = [(1, 1, 0, len(keys)), *((key, 0, 1, value) for key, value in keys.items())]
        body = b"".join(struct.pack("<4H", *entry) for entry in shorts)
        header.vlrs.append(record("LASF_Projection", 34735, "", body))
    if wkt is not None:
        header.vlrs.append(record("LASF_Projection", 2112, "", wkt.encode() + b"\0"))
        header.global_encoding.wkt = True
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = rows.T
    cloud.classification = np.broadcast_to(np.asarray(classes, np.uint8), len(rows))
    cloud.withheld = np.broadcast_to(np.asarray(withheld, np.uint8), len(rows))
    cloud.write(path)
    return path


def read(path: Path, **options: Any) -> ScannedPile:
    """The pile, which is the cone whatever the file."""
    scan = read_scan(path, **options)
    assert float(volume(scan.pile)) == pytest.approx(VOLUME, rel=0.03)
    assert float((scan.pile.height - scan.pile.floor).max()) == pytest.approx(3.0, abs=0.15)
    return scan


# --- units and reference systems


def test_the_cone_in_metres(tmp_path: Path) -> None:
    scan = read(write_tif(tmp_path / "a.tif", band(), step=0.2, crs="EPSG:25832", west=5e5))
    assert (scan.frame.crs, scan.notes) == ("EPSG:25832", ())


@pytest.mark.parametrize(
    ("unit", "length"), [("US survey foot", FOOT), ("ft", 0.3048), ("metre", 1.0), ("cm", 0.01)]
)
def test_heights_have_the_unit_of_their_band(tmp_path: Path, unit: str, length: float) -> None:
    import rasterio

    path = write_tif(tmp_path / "a.tif", band() / length, step=0.2, crs="EPSG:25832", west=5e5)
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    notes = read(path).notes
    assert notes == (() if length == 1.0 else (f"z converted from {unit_name(length)} to metres",))
    with rasterio.open(path, "r+") as file:
        file.units = ("fathoms of beer",)
    refused(path, "'fathoms of beer'")


def test_feet_of_the_reference_system_are_converted(tmp_path: Path) -> None:
    flat: dict[str, Any] = {"crs": "EPSG:2263", "west": 1e6, "north": 2e5}
    scan = read(write_tif(tmp_path / "a.tif", band() / FOOT, step=0.2 / FOOT, **flat))
    assert scan.frame.crs == "EPSG:2263"
    assert scan.notes == (
        "the file names no unit of its heights: they are taken as US survey feet, as x and y are",
        "x and y converted from US survey feet to metres",
        "z converted from US survey feet to metres",
    )


def test_a_local_grid_is_a_reference_system(tmp_path: Path) -> None:
    crs = 'LOCAL_CS["site grid",UNIT["metre",1]]'
    assert read(write_tif(tmp_path / "a.tif", band(), step=0.2, crs=crs)).frame.crs == "site grid"


FEET = {1024: 1, 3072: 2263, 3076: 9003, 4099: 9003}


@pytest.mark.parametrize(
    ("keys", "wkt"),
    [
        (FEET, None),
        # The unit that a file names goes before that of the system.
        ({**FEET, 3072: 32104}, None),
        ({1024: 1, 3072: 32767, 3076: 9003, 4099: 9003}, None),
        ({1024: 1, 3072: 2263, 4096: 6360}, None),
        (None, "EPSG:2263+6360"),
    ],
)
def test_point_clouds_in_feet_are_converted(
    tmp_path: Path, keys: dict[int, int] | None, wkt: str | None
) -> None:
    pyproj = pytest.importorskip("pyproj")
    rows = points() / FOOT + [1.0e6, 2.0e5, 1300.0]
    text = None if wkt is None else pyproj.CRS(wkt).to_wkt("WKT1_GDAL")
    scan = read(write_cloud(tmp_path / "a.las", rows, keys=keys, wkt=text))
    assert "z converted from US survey feet to metres" in scan.notes


@pytest.mark.parametrize(
    ("keys", "match"),
    [
        ({1024: 2, 2048: 4326}, "degrees"),
        ({1024: 3}, "earth-centred"),
        ({1024: 1, 3072: 3857}, "Pseudo-Mercator"),
        ({1024: 1, 3076: 9102}, "unit 9102"),
    ],
)
def test_coordinates_that_are_no_lengths_are_refused(
    tmp_path: Path, keys: dict[int, int], match: str
) -> None:
    rows = points() + ([9.0, 48.0, 0.0] if keys[1024] == 2 else [1.0e6, 6.0e6, 0.0])
    refused(write_cloud(tmp_path / "a.las", rows, keys=keys), match)


def test_what_is_not_said_is_noted(tmp_path: Path) -> None:
    (note,) = read(write_cloud(tmp_path / "a.las", points())).notes
    assert note == "the file names no unit: lengths are taken as metres"
    assert Reference("x", 1.0, 1.0).factors() == (1.0, 1.0, ())
    assert length_unit("US survey feet") == pytest.approx(FOOT, rel=1e-12)


# --- rasters


def test_scale_and_offset_of_a_band_are_applied(tmp_path: Path) -> None:
    import rasterio

    raw = np.round((band() + 100.0) / 0.02).astype(np.uint16)
    path = write_tif(tmp_path / "a.tif", raw, step=0.2, crs="EPSG:25832", west=5e5)
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.02,), (-100.0,)
    assert read(path).notes == ()


@pytest.mark.parametrize("value", [-9999.0, -3.4e38, 1e20])
def test_a_value_far_from_all_others_is_unseen(tmp_path: Path, value: float) -> None:
    heights = band().astype(np.float32)
    heights[:5] = value
    scan = read(write_tif(tmp_path / "a.tif", heights, step=0.2, crs="EPSG:25832", west=5e5))
    assert scan.pile.valid is not None
    assert f"600 cells hold {value:g}" in scan.notes[0]


def write_bands(path: Path, bands: list[np.ndarray], **options: Any) -> Path:
    import rasterio

    step = rasterio.Affine(0.2, 0.0, 5e5, 0.0, -0.2, 5e6)
    rows, columns = bands[0].shape
    size: dict[str, Any] = {"width": columns, "height": rows, "count": len(bands)}
    size |= {"dtype": bands[0].dtype, "transform": step, "crs": "EPSG:25832", "driver": "GTiff"}
    names, colours = options.pop("names", None), options.pop("colours", None)
    with rasterio.open(path, "w", **size, **options) as file:
        for k, values in enumerate(bands, 1):
            file.write(values, k)
        for k, name in enumerate(names or [], 1):
            file.set_band_description(k, name)
        if colours:
            file.colorinterp = [getattr(rasterio.enums.ColorInterp, name) for name in colours]
    return path


def test_pictures_are_refused_and_bands_are_chosen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grey, rgb = [np.full((100, 120), 110, np.uint8)] * 3, ["red", "green", "blue"]
    refused(write_bands(tmp_path / "photo.tif", grey, colours=rgb), r"picture \(red, green, blue\)")
    four = [*(values.astype(np.float64) for values in grey), band()]
    path = write_bands(tmp_path / "four.tif", four)
    refused(path, "--band, from 1 to 4")
    assert read(path, band=4).notes == ()
    refused(path, "no band 5", band=5)
    assert main(["diggability", str(path), "--band", "5", "--locations", "2"]) == 2
    assert "no band 5" in capsys.readouterr().err
    path = write_bands(tmp_path / "named.tif", four, names=["r", "g", "b", "Elevation [m]"])
    assert read(path).notes == ("band 4 of 4 is taken for the heights",)
    refused(write_ply(tmp_path / "a.ply", points()), "no band to choose", band=1)


def test_an_alpha_band_of_any_type_is_a_mask(tmp_path: Path) -> None:
    alpha = np.ones((100, 120))
    alpha[:, :20] = 0.0
    path = write_bands(tmp_path / "a.tif", [band(), alpha], colours=["gray", "alpha"])
    valid = read(path).pile.valid
    assert valid is not None
    assert not valid[:38].any()
    assert valid[42:].all()


# --- a part of a scan


@pytest.mark.parametrize("ending", [".tif", ".npz", ".las", ".ply"])
def test_the_part_inside_a_rectangle_is_read(tmp_path: Path, ending: str) -> None:
    """Beside the cone, in the same file, lies much else."""
    path, low = tmp_path / f"a{ending}", (1000.0, 2000.0)
    heights = np.full((200, 220), 7.0)  # rows from the north
    heights[40:140, 60:180] = band()
    rows, shift = points(seed=4), np.array([40.0, 0.0, 9.0])
    rows = np.concatenate([rows, rows[::3] + shift]) + np.array([*low, 0.0])
    if ending == ".tif":
        write_tif(path, heights, step=0.2, west=low[0] - 12.0, north=low[1] + 28.0)
    elif ending == ".npz":
        origin = (low[0] - 11.9, low[1] - 11.9)
        np.savez(path, height=heights[::-1].T, cell_size=0.2, origin=origin)
    elif ending == ".las":
        write_cloud(path, rows)
    else:
        write_ply(path, rows)
    # Any two opposite corners.
    part = read(path, crop=(low[0] + 24.0, low[1], low[0], low[1] + 20.0)).pile
    np.testing.assert_allclose(np.array(part.height.shape) * 0.1, SIDES, atol=0.7)
    refused(path, "nothing inside the crop: x runs from", crop=(0.0, 0.0, 5.0, 5.0))


# --- point clouds


def test_noise_structures_and_withheld_points_are_left_out(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    soil = points()
    others = random.uniform([0, 0, -15], [24, 20, 30], (900, 3))
    classes = np.repeat([2, 7, 18, 6, 1], [len(soil), 200, 200, 300, 200])
    withheld = np.repeat([0, 1], [len(soil) + 700, 200])
    rows = np.concatenate([soil, others])
    path = write_cloud(tmp_path / "a.laz", rows, classes=classes, withheld=withheld)
    assert read(path).notes[1] == (
        f"left out, of {len(rows)} points: 300 of building (class 6), 200 of noise (class 7), "
        f"200 of high noise (class 18), 200 of withheld"
    )
    refused(write_cloud(tmp_path / "b.las", soil, classes=6), "nothing of a pile")


@pytest.mark.parametrize("count", [1, 5])
def test_points_apart_from_the_others_are_left_out(tmp_path: Path, count: int) -> None:
    far = np.random.default_rng(0).uniform(100.0, 300.0, (count, 3))
    plain = read(write_ply(tmp_path / "a.ply", points()))
    strays = read(write_ply(tmp_path / "b.ply", np.concatenate([points(), far])))
    np.testing.assert_array_equal(strays.pile.height, plain.pile.height)
    assert f"left out {count} of {len(points()) + count} points" in strays.notes[1]


def test_of_two_layers_the_lower_one_counts(tmp_path: Path) -> None:
    roof = points(20.0, seed=3)
    roof = roof[np.abs(roof[:, 0] - 12.0) < 2.0]
    roof[:, 2] = 6.0
    scan = read(write_ply(tmp_path / "a.ply", np.concatenate([points(150.0), roof])))
    count, _, words = scan.notes[1].partition(" ")
    assert words == "points hang over others: the lower ones count"
    # In a patch at the border there may be too few below.
    assert 0.99 * len(roof) <= int(count) <= len(roof)


def test_rounded_coordinates_are_noticed(tmp_path: Path) -> None:
    rows = points(150.0)
    rows[:, 1] = np.round(rows[:, 1] / 0.5) * 0.5
    refused(write_ply(tmp_path / "a.ply", rows), "rounded to 0.5 m")
    # A regular grid of points as far apart is one.
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.0, 24.0, 0.5), np.arange(0.0, 20.0, 0.5)))
    assert len(read(write_ply(tmp_path / "b.ply", np.stack([x, y, cone(x, y)], -1))).notes) == 1


# --- height maps, yards


def test_nan_is_unseen_where_a_map_says_no_more(tmp_path: Path) -> None:
    height = band().T[:, ::-1].copy()
    height[:10] = np.nan
    np.savez(tmp_path / "a.npz", height=height, cell_size=0.2)
    valid = read(tmp_path / "a.npz").pile.valid
    assert valid is not None
    assert not valid[:18].any()
    np.savez(tmp_path / "b.npz", height=height, cell_size=0.2, valid=np.ones_like(height, bool))
    refused(tmp_path / "b.npz", "1000 cells that count as seen")


@pytest.mark.parametrize("degrees", [4.0, 7.0, 9.0, 13.0])
def test_a_yard_may_slope(tmp_path: Path, degrees: float) -> None:
    rise = math.tan(math.radians(degrees)) * 0.2 * np.arange(120)
    heights = (band() + rise[None, :]).astype(np.float32)
    scan = read_scan(write_tif(tmp_path / "a.tif", heights, step=0.2, crs="EPSG:25832", west=5e5))
    assert float(volume(scan.pile)) == pytest.approx(VOLUME, rel=0.03)
    said = [note for note in scan.notes if "slopes" in note]
    assert said == (
        []
        if degrees < 5.0
        else [f"the ground slopes by {degrees:g} degrees: level the scan if the site does not"]
    )
