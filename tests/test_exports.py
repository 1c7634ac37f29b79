"""A plan in files of other tools: read again by other libraries, at the same places."""

import io
import json
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from cones import cone
from ezdxf import filemanagement
from PIL import Image

from wlplan.errors import InputError
from wlplan.io import read_pile
from wlplan.io.files import is_ours
from wlplan.report import exports
from wlplan.report.exports import Played, check, exported
from wlplan.types import Pile

OFFSET = [412000.0, 5310000.0, 200.0]
LOADS: list[dict[str, Any]] = [
    {
        **{"x": -4.0, "y": 0.5, "heading": math.radians(heading)},
        "simulated": {"mass": 4.25, "time": 9.5, "work": 400.0},
        "path": {"points": [[-9.0 - s, 0.5, 0.0, -1 if s < 3 else 1] for s in range(6)]},
    }
    for heading in (0.0, 90.0)
]
DOCUMENT: dict[str, Any] = {
    "loads": LOADS,
    "receiver": {"x": -12.0, "y": -3.0, "heading": 0.0},
    "frame": {"offset": OFFSET, "crs": "EPSG:25832"},
}


def played(document: dict[str, Any], pile: Pile) -> Played:
    heights = np.stack([np.asarray(pile.height) - 0.1, np.asarray(pile.height)])
    return Played(document, pile, heights)


@pytest.mark.parametrize("kind", exports.KINDS)
def test_a_file_says_who_has_written_it(tmp_path: Path, kind: str) -> None:
    ((name, content),) = exported([kind], played(DOCUMENT, cone())).items()
    assert exports.names([kind]) == [name]
    (tmp_path / name).write_bytes(content)
    assert is_ours(tmp_path / name)


def test_a_film_has_a_picture_before_each_load_and_one_of_the_end() -> None:
    film = Image.open(io.BytesIO(exported(["gif"], played(DOCUMENT, cone()))["plan.gif"]))
    assert film.n_frames == 3  # type: ignore[attr-defined]
    assert film.info["loop"] == 0
    frames = []
    for n in range(3):
        film.seek(n)
        frames.append(np.asarray(film.convert("RGB"), int))
    assert min(frames[0].shape[:2]) > 300
    # The second has another heading, and the pile is 10 cm lower.
    assert np.abs(frames[0] - frames[1]).max() > 100


def test_geojson_has_digs_ways_and_the_truck_where_they_are() -> None:
    content = exported(["geojson"], played(DOCUMENT, cone()))["plan.geojson"]
    found = json.loads(content)
    assert found["crs"]["properties"]["name"] == "EPSG:25832"
    kinds = [one["properties"]["kind"] for one in found["features"]]
    ways = ["way, reverse", "way, forward"]
    assert kinds == 2 * ["dig", "approach"] + 2 * ways + ["truck"]
    dig = found["features"][2]
    assert dig["geometry"]["coordinates"] == [411996.0, 5310000.5]
    assert dig["properties"] == {
        **{"kind": "dig", "load": 2, "heading_deg": 90.0},
        **{"mass": 4.25, "time": 9.5, "work": 400.0},
    }
    # From 5 m south of it, since it looks north.
    np.testing.assert_allclose(
        found["features"][3]["geometry"]["coordinates"][0], [411996.0, 5309995.5], atol=1e-3
    )
    (ring,) = found["features"][-1]["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    assert len(ring) == 5


def test_geojson_of_a_scan_without_a_reference_system_names_none() -> None:
    document = {**DOCUMENT, "frame": {"offset": OFFSET, "crs": None}}
    assert "crs" not in json.loads(exported(["geojson"], played(document, cone()))["plan.geojson"])


def test_dxf_has_a_layer_for_each_kind_of_thing() -> None:
    content = exported(["dxf"], played(DOCUMENT, cone()))["plan.dxf"]
    drawing = filemanagement.read(io.StringIO(content.decode()))
    assert not drawing.audit().has_errors
    assert drawing.header["$INSUNITS"] == 6
    by_layer: dict[str, list[Any]] = {}
    for one in drawing.modelspace():
        by_layer.setdefault(one.dxf.layer, []).append(one)
    counts = {name: len(some) for name, some in by_layer.items()}
    ways = {"WAY_REVERSE": 2, "WAY_FORWARD": 2}
    assert counts == {"DIGS": 4, "APPROACH": 2, **ways, "TRUCKS": 1}
    points = [one.dxf.location for one in by_layer["DIGS"] if one.dxftype() == "POINT"]
    assert tuple(points[0])[:2] == (411996.0, 5310000.5)
    assert by_layer["TRUCKS"][0].closed


def test_geotiff_is_the_pile_that_is_left(tmp_path: Path) -> None:
    pile = cone()
    seen = np.ones(pile.height.shape, bool)
    seen[:5, :40] = False
    pile = pile.replace(valid=jnp.asarray(seen), height=pile.height.at[100:110, 90:100].add(0.3))
    path = tmp_path / "pile_after.tif"
    path.write_bytes(exported(["geotiff"], played(DOCUMENT, pile))[path.name])
    again = read_pile(path)
    assert again.height.shape == pile.height.shape
    np.testing.assert_array_equal(np.asarray(again.valid), seen)
    # What is read is as high over its floor.
    low = np.asarray(again.height)[seen].min() - np.asarray(pile.height)[seen].min()
    np.testing.assert_allclose(
        np.asarray(again.height)[seen] - low, np.asarray(pile.height)[seen], atol=2e-4
    )
    import rasterio

    with rasterio.open(path) as file:
        assert file.crs.to_string() == "EPSG:25832"
        # The middle of the cell in the south-west.
        corner = file.transform
        middle = corner.c + 0.5 * corner.a, corner.f + (file.height - 0.5) * corner.e
        assert middle == pytest.approx((411992.0, 5309992.0), abs=1e-6)
        assert file.read(1).max() == pytest.approx(200.0 + float(pile.height.max()), abs=1e-3)


def test_a_library_that_is_missing_is_found_out_first(monkeypatch: pytest.MonkeyPatch) -> None:
    check(["geojson", "dxf", "geotiff"])
    monkeypatch.setattr(exports._module("dxf"), "LIBRARY", "no_such_library")
    with pytest.raises(InputError, match=r"dxf: needs no_such_library.*pip install"):
        check(["dxf"])
