"""The same yard in every format: the same pile, at the same place, the same way round."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scene
from scan_files import refused, write_las, write_ply

from wlplan.cli import main
from wlplan.errors import InputError
from wlplan.io import read_scan
from wlplan.io.readers import known_endings
from wlplan.io.upright import TURNS, turned, up_axis

NO_UNIT = "the file names no unit: lengths are taken as metres"
FOOT = 0.3048

# --- text


@pytest.mark.parametrize(
    ("ending", "options"),
    [
        (".xyz", {}),
        (".txt", {"delimiter": "\t", "header": "x\ty\tz", "comments": ""}),
        (".csv", {"delimiter": ",", "header": "X,Y,Z", "comments": ""}),
        (".csv", {"delimiter": ";", "header": '"Easting";"Northing";"Height"', "comments": "# "}),
        (".asc", {"header": "X Y Z R G B", "comments": "//"}),
        (".asc", {"delimiter": ", "}),
        (".txt", {"header": "19200", "comments": ""}),
    ],
)
def test_points_in_text_have_any_usual_separator(
    tmp_path: Path, ending: str, options: dict[str, Any]
) -> None:
    rows = scene.points(at=(1000.0, 2000.0, 0.0))
    path = scene.write_xyz(tmp_path / f"a{ending}", rows, **options)
    assert scene.check_file(path, (1000.0, 2000.0)).notes == (NO_UNIT,)


def test_columns_are_found_by_their_names(tmp_path: Path) -> None:
    rows = scene.points()
    mixed = np.concatenate([rows[:, [2, 0]], np.full((len(rows), 1), 7.0), rows[:, [1]]], axis=1)
    for names in ("z x intensity y", "elev,E,class,N"):
        path = scene.write_xyz(tmp_path / "a.csv", mixed, header=names, comments="")
        scene.check_file(path)
    path = scene.write_xyz(tmp_path / "b.csv", mixed, header="a b c d", comments="")
    refused(path, "names its columns a, b, c, d: name exactly one of them x")
    path = scene.write_xyz(tmp_path / "c.csv", mixed, header="lat lon h t", comments="")
    refused(path, "in degrees")


def test_units_in_brackets_are_converted(tmp_path: Path) -> None:
    rows = scene.points() / FOOT
    path = scene.write_xyz(tmp_path / "a.txt", rows, header="x [ft] y [ft] z [ft]")
    notes = scene.check_file(path).notes
    assert notes == ("x and y converted from feet to metres", "z converted from feet to metres")
    path = scene.write_xyz(tmp_path / "b.txt", scene.points(), header="x(m) y(m) z(m)")
    assert scene.check_file(path).notes == ()
    path = scene.write_xyz(tmp_path / "c.txt", rows, header="x[ft] y[m] z[m]")
    refused(path, "different units")


def test_decimal_commas_are_read_where_they_are_clear(tmp_path: Path) -> None:
    lines = [" ".join(f"{value:.4f}" for value in row) for row in scene.points()]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines).replace(".", ","))
    scene.check_file(path)
    path.write_text("\n".join(lines).replace(" ", ";").replace(".", ","))
    scene.check_file(path)
    path.write_text("\n".join(lines).replace(" ", ", ").replace(".", ","))
    refused(path, "commas between its numbers and in them")
    path.write_text("x,y,z\n" + "\n".join(lines).replace(" ", ",").replace(".", ","))
    refused(path, "decimal commas need another separator")
    path.write_text("1.000,5;2,5;3,5\n")
    refused(path, "commas and points")


def test_text_that_holds_no_points_is_refused_in_its_own_words(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    for content, match in (
        ("", "no points in text"),
        ("1 2\n3 4\n", "no points in text"),
        ("Dear all,\nthe scan will follow.\n", "no points in text"),
        ("1 2 3\n4 5\n6 7 8\n" * 5, "a line that is no point"),
        ("1 2 3\n4 5 six\n" * 5, "a line that is no point"),
        ("1 2 3\0\n", "no text"),
    ):
        path.write_text(content)
        assert "damaged" not in refused(path, match)
    path.write_bytes("x\ty\tz\n".encode("utf-16") + b"\0")
    refused(path, "no points in text")


def test_an_ascii_grid_has_its_first_row_in_the_north(tmp_path: Path) -> None:
    height = scene.grid()
    height[:5] = np.nan
    path = scene.write_grid(tmp_path / "a.asc", height, 0.2)
    scan = scene.check_file(path, (1000.0, 2000.0))
    assert scan.pile.valid is not None
    assert not np.asarray(scan.pile.valid)[:8].any()
    assert np.asarray(scan.pile.valid)[12:].all()
    np.testing.assert_allclose(scan.pile.origin, [1000.05, 2000.05], atol=1e-3)
    centre = "XLLCENTER 1000.1\nYLLCENTER 2000.1\n"
    path = scene.write_grid(tmp_path / "b.txt", scene.grid(), 0.2, centre)
    np.testing.assert_allclose(read_scan(path).pile.origin, [1000.05, 2000.05], atol=1e-3)
    part = read_scan(path, crop=(1000.0, 2000.0, 1012.0, 2010.0)).pile
    np.testing.assert_allclose(np.array(part.height.shape) * 0.1, [12.0, 10.0], atol=0.3)
    text = path.read_text()
    path.write_text(text.replace("ncols 120", "ncols 121"))
    refused(path, "damaged or cut short")
    path.write_text(text.replace("ncols 120", "ncols 120000000"))
    refused(path, "no room for its cells")
    path.write_text(text.replace("cellsize", "size"))
    refused(path, "without ncols, nrows and cellsize")


# --- PCD


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_encodings_read_alike(tmp_path: Path, encoding: str) -> None:
    rows = scene.points(at=(100.0, 200.0, 0.0))
    rows = np.concatenate([rows, np.full((50, 3), np.nan)])
    path = scene.write_pcd(tmp_path / "a.pcd", rows, encoding)
    assert scene.check_file(path, (100.0, 200.0)).notes == (NO_UNIT,)


def test_the_head_of_a_pcd_is_checked(tmp_path: Path) -> None:
    path = scene.write_pcd(tmp_path / "a.pcd", scene.points())
    content = path.read_bytes()
    for old, new, match in (
        (b"x y z", b"x y q", "no x, y and z"),
        (b"POINTS 19200", b"POINTS 19201", "19200 of 19201 points"),
        (b"DATA binary", b"DATA braille", "'braille'"),
        (b"SIZE 4 4 4 8", b"SIZE 4 4 4", "do not fit together"),
        (b"COUNT 1 1 1 1", b"COUNT 1 2 1 1", "several values"),
        (b"DATA", b"DATUM", "no PCD header"),
    ):
        path.write_bytes(content.replace(old, new))
        refused(path, match)
    path.write_bytes(content.replace(b"POINT 0 0 0 1", b"POINT 0 0 2 1"))
    assert "the viewpoint of the file (0 0 2 1 0 0 0) is not applied" in read_scan(path).notes[1]


# --- E57


def test_the_scans_of_an_e57_are_moved_by_their_poses(tmp_path: Path) -> None:
    rows = scene.points(at=(500.0, 700.0, 3.0))
    west = rows[:, 0] < 512.0
    invalid = np.full((40, 3), np.nan)
    places = np.array([[505.0, 702.0, 5.0], [520.0, 718.0, 5.0]])
    path = scene.write_e57(
        tmp_path / "a.e57",
        [(np.concatenate([rows[west], invalid]), 0.7, places[0]), (rows[~west], -2.0, places[1])],
    )
    scan = scene.check_file(path, (500.0, 700.0))
    assert scan.notes == ("2 scans joined",)
    assert float(scan.pile.floor.mean()) == pytest.approx(3.0, abs=0.05)
    part = read_scan(path, crop=(500.0, 700.0, 512.0, 710.0)).pile
    np.testing.assert_allclose(np.array(part.height.shape) * 0.1, [12.0, 10.0], atol=0.3)
    refused(path, "nothing inside the crop", crop=(0.0, 0.0, 5.0, 5.0))


def test_what_an_e57_scanner_sees_of_itself_is_left_out(tmp_path: Path) -> None:
    rows, place = scene.points(), np.array([4.0, 5.0, 1.8])
    shadow = np.hypot(*(rows[:, :2] - place[:2]).T) > 1.5
    itself = place + np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
    empty = np.tile(place, (300, 1))
    everything = np.concatenate([rows[shadow], itself, empty])
    path = scene.write_e57(tmp_path / "a.e57", [(everything, 0.4, place)])
    notes = scene.check_file(path).notes
    assert notes[0].startswith("scan 1 of 1: left out 300 points at 0,0,0")
    assert notes[1].startswith("scan 1 of 1: left out 200 points within 1 m of 0,0,0")


def test_an_e57_that_may_refer_to_other_files_is_refused(tmp_path: Path) -> None:
    path = scene.write_e57(tmp_path / "a.e57", [(scene.points(5.0), 0.0, np.zeros(3))])
    content = path.read_bytes()
    path.write_bytes(content.replace(b"<data3D t", b"<!DOCTYPE", 1))
    refused(path, "declarations of its own")
    path.write_bytes(content[:-100])
    refused(path, "damaged or cut short")


# --- meshes


def test_large_faces_leave_no_holes(tmp_path: Path) -> None:
    faces = scene.triangles()
    for path in (
        scene.write_stl(tmp_path / "a.stl", faces),
        scene.write_stl(tmp_path / "b.stl", faces, text=True),
        scene.write_obj(tmp_path / "c.obj", faces),
    ):
        scan = scene.check_file(path, cone=0.11)
        assert scan.notes == (NO_UNIT,)
        assert scan.pile.valid is None
        assert scan.pile.height.shape == (240, 200)


def test_the_upper_surface_of_a_solid_counts(tmp_path: Path) -> None:
    """The same faces, seen from below, two metres deeper."""
    faces = scene.triangles()
    solid = np.concatenate([faces, faces[:, ::-1] * [1.0, 1.0, 0.0] - [0.0, 0.0, 2.0]])
    top, whole = (
        read_scan(scene.write_stl(tmp_path / f"{k}.stl", f)).pile
        for k, f in enumerate((faces, solid))
    )
    np.testing.assert_array_equal(whole.height, top.height)


def test_where_no_face_is_nothing_was_seen(tmp_path: Path) -> None:
    faces = scene.triangles()
    corner = np.array([[[26.0, 0.0, 0.0], [30.0, 0.0, 0.0], [30.0, 4.0, 0.0]]])
    pile = read_scan(scene.write_stl(tmp_path / "a.stl", np.concatenate([faces, corner]))).pile
    assert pile.valid is not None
    assert not np.asarray(pile.valid)[242:258].any()
    assert np.asarray(pile.valid).sum() == pytest.approx(48_000 + 800, rel=0.01)
    part = read_scan(tmp_path / "a.stl", crop=(0.0, 0.0, 24.0, 20.0)).pile
    assert part.height.shape == (240, 200)
    assert part.valid is None
    refused(tmp_path / "a.stl", "nothing inside the crop", crop=(50.0, 50.0, 60.0, 60.0))


def test_a_mesh_does_not_fetch_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    secret = tmp_path / "secret.mtl"
    secret.write_text("newmtl a\nmap_Kd secret.png\n")
    head = "mtllib secret.mtl\nusemtl a\n"
    path = scene.write_obj(tmp_path / "a.obj", scene.triangles(), head)
    opened: list[str] = []
    plain = Path.open

    def spying(self: Path, *args: Any, **options: Any) -> Any:
        opened.append(self.name)
        return plain(self, *args, **options)

    monkeypatch.setattr(Path, "open", spying)
    before = secret.stat().st_atime_ns
    scene.check_file(path, cone=0.11)
    assert "secret.mtl" not in opened
    assert secret.stat().st_atime_ns == before


def test_the_many_ways_to_write_a_face(tmp_path: Path) -> None:
    """Squares, indices from the end, textures and normals, groups; names in another encoding."""
    x, y = (np.arange(0.0, side + 0.1, 0.5) for side in scene.SIDES)
    height = scene.yard(x[:, np.newaxis], y)
    lines = [f"v {a} {b} {height[i, j]:.4f}" for i, a in enumerate(x) for j, b in enumerate(y)]
    n, total = len(y), height.size
    lines += ["vt 0 0", "vn 0 0 1", "o Stra\xdfe"]
    for i in range(len(x) - 1):
        lines += [f"g row{i}"] if i % 10 == 0 else []
        for j in range(n - 1):
            corners = [i * n + j, i * n + n + j, i * n + n + j + 1, i * n + j + 1]
            named = [
                f"{k - total}//-1" if i % 3 == 0 else f"{k + 1}/1/1" if i % 3 == 1 else f"{k + 1}"
                for k in corners
            ]
            lines.append(f"f {' '.join(named)}")
    path = tmp_path / "a.obj"
    path.write_bytes("\n".join(lines).encode("latin-1"))
    scan = scene.check_file(path, cone=0.11)
    assert scan.pile.valid is None
    path = scene.write_stl(tmp_path / "a.stl", scene.triangles())
    path.write_bytes(path.read_bytes() + b"\0")
    refused(path, "or no STL file")


def test_an_obj_without_faces_is_a_point_cloud(tmp_path: Path) -> None:
    rows = scene.points()
    scene.check_file(
        scene.write_obj(
            tmp_path / "a.obj",
            rows[:0].reshape(0, 3, 3)[:0],
            "".join(f"v {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in rows),
        )
    )
    (tmp_path / "b.obj").write_text("# nothing\n")
    refused(tmp_path / "b.obj", "no faces and no points")


# --- the axis that is up


def tilted(rows: np.ndarray, up: str) -> np.ndarray:
    """Points as a file has them whose axis that is up is another one."""
    order, signs = TURNS[up]
    turned_back = np.empty_like(rows)
    turned_back[:, order] = rows * signs
    np.testing.assert_allclose(turned(turned_back, up), rows)
    return turned_back


@pytest.mark.parametrize("up", TURNS)
def test_turns_are_rotations_and_their_axis_is_z(up: str) -> None:
    matrix = turned(np.eye(3), up).T
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    np.testing.assert_array_equal(matrix @ axis, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("up", ["x", "y", "-x", "-y"])
def test_a_cloud_with_another_axis_up_is_refused_and_can_be_turned(tmp_path: Path, up: str) -> None:
    path = write_ply(tmp_path / "a.ply", tilted(scene.points(), up))
    refused(path, rf"has {up} up, as its shape says, not z: say so with --up {up}, or")
    scan = scene.check_file(path, up=up)
    assert scan.notes[1].startswith(f"{up} is up in the file: x, y and z of the pile are ")
    part = read_scan(path, up=up, crop=(0.0, 0.0, 12.0, 10.0)).pile
    np.testing.assert_allclose(np.array(part.height.shape) * 0.1, [12.0, 10.0], atol=0.5)


def test_an_obj_with_y_up_is_turned(tmp_path: Path) -> None:
    faces = tilted(scene.triangles().reshape(-1, 3), "y").reshape(-1, 3, 3)
    path = scene.write_obj(tmp_path / "a.obj", faces)
    assert scene.check_file(path, cone=0.11).notes == (
        NO_UNIT,
        "y is up in the file: x, y and z of the pile are x, -z and y of it",
    )
    refused(scene.write_stl(tmp_path / "a.stl", faces), "has y up")
    scene.check_file(tmp_path / "a.stl", cone=0.11, up="y")
    refused(path, "24 x 3.5 m, too small", up="z")


@pytest.mark.parametrize("seed", range(4))
def test_what_stands_on_a_yard_does_not_turn_it(seed: int) -> None:
    """Walls, trees and a narrow silo are higher than the pile, and z is up all the same."""
    random = np.random.default_rng(seed)
    rows = scene.points(60.0, seed)
    wall = np.stack([*random.uniform([0, 0], [24, 8], (9000, 2)).T, np.full(9000, 20.0)], -1)
    trees = random.uniform([0, 0, 0], [24, 20, 15], (4000, 3))
    assert up_axis(np.concatenate([rows, wall[:, [0, 2, 1]], trees])) == "z"
    silo = rows[np.abs(rows[:, 1] - 11.0) < 3.0]
    sides = np.concatenate([wall[:, [0, 2, 1]] * [1, 0, 1] + [0, y, 0] for y in (8.0, 14.0)])
    assert up_axis(np.concatenate([silo, sides[::4] * [1, 1, 0.6]])) == "z"
    # A slope as steep as any, seen alone, is a slope.
    steep = rows * [1.0, 1.0, 0.0] + rows[:, :1] * [0.0, 0.0, 0.9]
    assert up_axis(steep) == "z"


def test_height_maps_have_z_up(tmp_path: Path) -> None:
    path = scene.write_grid(tmp_path / "a.asc", scene.grid(), 0.2)
    scene.check_file(path, (1000.0, 2000.0), up="z")
    refused(path, "is a height map, which has z up", up="y")


# --- returns at the sensor


def test_returns_at_the_sensor_are_left_out(tmp_path: Path) -> None:
    """A scanner stands at zero, 1.8 m above the floor, in its own shadow."""
    rows = scene.points() - [4.0, 5.0, 1.8]
    rows = rows[np.hypot(rows[:, 0], rows[:, 1]) > 1.5]
    itself = np.random.default_rng(0).uniform(-0.15, 0.15, (300, 3))
    plain = read_scan(write_ply(tmp_path / "a.ply", rows))
    path = write_ply(tmp_path / "b.ply", np.concatenate([itself, rows, np.zeros((500, 3))]))
    scan = scene.check_file(path, (-4.0, -5.0))
    np.testing.assert_array_equal(scan.pile.height, plain.pile.height)
    assert scan.notes[1:3] == (
        "left out 500 points at 0,0,0: returns without a range",
        "left out 300 points within 1 m of 0,0,0, apart from all others: the scanner itself",
    )


def test_a_surface_through_zero_is_no_sensor(tmp_path: Path) -> None:
    for rows in (scene.points() - [9.0, 11.0, 3.5], scene.points(2.0) - [20.0, 15.0, 0.0]):
        notes = read_scan(write_ply(tmp_path / "a.ply", rows)).notes
        assert not any("0,0,0" in note for note in notes)


# --- grid_map


@pytest.mark.parametrize("ending", [".bag", ".mcap", ".db3"])
@pytest.mark.parametrize("by_column", [True, False])
def test_a_grid_map_is_read_the_right_way_round(
    tmp_path: Path, ending: str, by_column: bool
) -> None:
    height = scene.grid()
    height[7, 11] = np.nan
    path = scene.write_bag(
        tmp_path / f"a{ending}",
        {"variance": np.ones_like(height), "elevation": height},
        centre=(112.0, 210.0),
        start=(17, 5),
        by_column=by_column,
        messages=3,
    )
    scan = scene.check_file(path, (100.0, 200.0))
    assert scan.notes == ("the last of 3 maps counts, on the topic /elevation_map",)
    np.testing.assert_allclose(scan.pile.origin, [100.05, 200.05], atol=1e-4)
    unseen = np.argwhere(~np.asarray(scan.pile.valid))
    np.testing.assert_allclose(unseen.mean(axis=0), [14.5, 22.5])


def test_the_layer_of_a_grid_map_can_be_chosen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layers = {"upper": scene.grid(), "lower": np.zeros((120, 100))}
    path = scene.write_bag(tmp_path / "a.mcap", layers)
    refused(path, "layers upper, lower, none called elevation: choose one with --layer")
    scene.check_file(path, layer="upper")
    assert main(["diggability", str(path), "--layer", "side", "--locations", "2"]) == 2
    assert "none called side" in capsys.readouterr().err
    only = scene.write_bag(tmp_path / "b.mcap", {"surface": scene.grid()})
    assert scene.check_file(only).notes == ()


def test_grid_maps_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    path = scene.write_bag(tmp_path / "a.bag", {"elevation": scene.grid()}, turn=0.5)
    refused(path, "turned against its frame")
    path = scene.write_bag(tmp_path / "a.db3", {"elevation": scene.grid()})
    refused(path.rename(tmp_path / "what?.db3"), "in its path: rename it")


def test_a_recording_that_is_sound_is_not_called_damaged(tmp_path: Path) -> None:
    bag = scene.write_bag(tmp_path / "a.bag", {"elevation": scene.grid()})
    content = bag.read_bytes()
    start = content.index(b"index_pos=") + len(b"index_pos=")
    bag.write_bytes(content[:start] + bytes(8) + content[start + 8 :])
    assert "damaged" not in refused(bag, "no index: run `rosbag reindex`")
    mcap = scene.write_bag(tmp_path / "a.mcap", {"elevation": scene.grid()})
    mcap.write_bytes(mcap.read_bytes().replace(b"ros2", b"ros1", 1))
    assert "damaged" not in refused(mcap, "no MCAP of ROS 2")


# --- files that are sound, but of another kind


@pytest.mark.parametrize("ending", known_endings())
def test_files_with_the_wrong_ending_are_not_called_damaged(tmp_path: Path, ending: str) -> None:
    """A picture, and a page of text; but a .las and a .e57 may be either."""
    for content in (b"\x89PNG\r\n\x1a\n" + bytes(500), b"Dear all,\nthe scan will follow.\n"):
        (tmp_path / f"a{ending}").write_bytes(content)
        said = refused(tmp_path / f"a{ending}", "a")
        assert "damaged" not in said or ", or no " in said


def test_a_file_of_objects_is_not_called_damaged(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", height=np.array([[1, "b"]], object), cell_size=0.1)
    assert "damaged" not in refused(tmp_path / "a.npz", "Python objects: save plain arrays")


def test_a_system_that_is_not_understood_is_no_reason_to_refuse() -> None:
    from wlplan.io.readers import e57

    assert e57._system("", (0.0, 0.0)) == (None, [])
    assert e57._system("EPSG:25832", (5e5, 5e6)) == ("EPSG:25832", [])
    assert e57._system("Site grid of Smith & Sons", (0.0, 0.0))[0] is None
    with pytest.raises(InputError, match="degrees"):
        e57._system("EPSG:4326", (9.0, 48.0))


# --- a known floor


def test_a_scan_of_the_floor_is_the_ground(tmp_path: Path) -> None:
    """The pile fills its map; without the floor nobody could tell where it is."""
    rows = scene.points()
    rows[:, 2] += 0.05 * rows[:, 0]
    pile = write_ply(tmp_path / "pile.ply", rows)
    steps = np.arange(-2.0, 30.0, 0.5)
    floor = np.broadcast_to(0.05 * steps[:, np.newaxis], (len(steps), len(steps)))
    np.savez(tmp_path / "floor.npz", height=floor, cell_size=0.5, origin=(-2.0, -2.0))
    inner = (5.0, 7.0, 13.0, 15.0)
    scan = read_scan(pile, ground=tmp_path / "floor.npz", crop=inner)
    east = np.asarray(scan.pile.origin)[0] + 0.1 * np.arange(scan.pile.height.shape[0])
    want = np.broadcast_to(0.05 * east[:, np.newaxis], scan.pile.height.shape)
    covered = np.asarray(scan.pile.height) > want + 0.2
    assert covered.mean() > 0.5
    np.testing.assert_allclose(np.asarray(scan.pile.floor)[covered], want[covered], atol=1e-3)
    assert not any("floor" in note for note in scan.notes)
    estimated = read_scan(pile, crop=inner).pile
    assert float(np.abs(estimated.floor - want).max()) > 0.3


def test_where_the_floor_was_not_scanned_it_is_estimated(tmp_path: Path) -> None:
    pile = scene.write_grid(tmp_path / "pile.asc", scene.grid(), 0.2)
    sunk = scene.write_grid(tmp_path / "floor.asc", np.full((60, 100), -0.5), 0.2)
    scan = read_scan(pile, ground=str(sunk))
    floor = np.asarray(scan.pile.floor)
    np.testing.assert_allclose(floor[:118], -0.5, atol=1e-6)
    np.testing.assert_allclose(floor[122:], 0.0, atol=0.05)
    assert "known under 50 % of the scan" in scan.notes[1]
    assert scan.notes[2] == f"of the floor: {NO_UNIT}"


def test_a_floor_of_another_place_or_height_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pile = scene.write_grid(tmp_path / "pile.asc", scene.grid(), 0.2)
    head = "xllcorner 0\nyllcorner 0\n"
    away = scene.write_grid(tmp_path / "away.asc", np.zeros((50, 50)), 0.2, head)
    with pytest.raises(InputError, match=r"away\.asc: has nothing under the pile: its x runs from"):
        read_scan(pile, ground=away)
    above = scene.write_grid(tmp_path / "above.asc", np.full((120, 100), 40.0), 0.2)
    with pytest.raises(InputError, match=r"above\.asc: lies above the pile, by 40 m"):
        read_scan(pile, ground=above)
    below = scene.write_grid(tmp_path / "below.asc", np.full((120, 100), -30.0), 0.2)
    assert "30 m or more below the scan everywhere" in read_scan(pile, ground=below).notes[1]
    assert main(["diggability", str(pile), "--ground", str(tmp_path / "no.tif")]) == 2
    assert "neither a level in metres nor a file" in capsys.readouterr().err
    (tmp_path / "floor.doc").write_text("")
    assert main(["diggability", str(pile), "--ground", str(tmp_path / "floor.doc")]) == 2
    assert "unknown kind of pile file '.doc'" in capsys.readouterr().err
    assert main(["diggability", str(pile), "--ground", str(away), "--locations", "2"]) == 2
    assert "nothing under the pile" in capsys.readouterr().err


def test_a_floor_in_another_reference_system_is_refused(tmp_path: Path) -> None:
    from scan_files import write_tif

    band = scene.grid().T[::-1].copy()
    at: dict[str, Any] = {"step": 0.2, "west": 5e5}
    pile = write_tif(tmp_path / "pile.tif", band, crs="EPSG:25832", **at)
    floor = write_tif(tmp_path / "floor.tif", 0.0 * band, crs="EPSG:25833", **at)
    with pytest.raises(
        Exception, match=r"floor\.tif: is in EPSG:25833, but .*pile\.tif in EPSG:25832"
    ):
        read_scan(pile, ground=floor)
    write_tif(tmp_path / "floor.tif", 0.0 * band, crs="EPSG:25832", **at)
    scene.check(read_scan(pile, ground=floor).pile, (0.0, 180.0))


# --- scans that are too large


def wide(cell: float) -> np.ndarray:
    """Two piles on a site of 640 m by 450 m."""
    x, y = (np.arange(0.5 * cell, side, cell) for side in (640.0, 450.0))
    big = 6.0 - np.hypot(x[:, np.newaxis] - 500.0, y - 120.0) * scene.SLOPE
    small = 3.5 - np.hypot(x[:, np.newaxis] - 100.0, y - 300.0) * scene.SLOPE
    return np.maximum(0.0, np.maximum(big, small))


PILES = r"; there is a pile around {},{} \(--crop={}\), one around {},{} \(--crop={}\)\.$"


def test_a_site_that_is_too_large_names_its_piles(tmp_path: Path) -> None:
    from scan_files import write_tif

    heights = wide(0.5)
    at = (5e5, 1450.0)
    path = write_tif(tmp_path / "a.tif", heights.T[::-1].copy(), step=0.5, west=at[0], north=at[1])
    message = refused(path, r"there is a pile around 500500,1120 \(--crop=")
    crops = [part.split(")")[0] for part in message.split("--crop=")[1:]]
    assert len(crops) == 2
    tops = []
    for text in crops:
        pile = read_scan(path, crop=tuple(map(float, text.split(",")))).pile
        tops.append(float(pile.height.max() - pile.floor.max()))
        assert float(pile.floor.max()) < 0.1
    np.testing.assert_allclose(tops, [6.0, 3.5], atol=0.35)
    np.savez(tmp_path / "a.npz", height=heights, cell_size=0.5, origin=(5e5 + 0.25, 1000.25))
    assert refused(tmp_path / "a.npz", "pile around").split("units")[1] == message.split("units")[1]
    random = np.random.default_rng(0)
    rows = random.uniform([0.0, 0.0, 0.0], [640.0, 450.0, 0.01], (1_500_000, 3))
    index = tuple((rows[:, :2] / 0.5).astype(int).T)
    rows[:, 2] += heights[index]
    cloud = refused(write_las(tmp_path / "a.las", rows), "one around 100,300")
    assert "around 500,120" in cloud or "around 500,121" in cloud


def test_a_flat_site_that_is_too_large_names_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", height=np.zeros((900, 900)), cell_size=0.5)
    assert refused(tmp_path / "a.npz", "4000 cells").endswith("or check the units.")


@pytest.mark.parametrize("ending", [".ply", ".las", ".laz"])
def test_many_points_are_read_in_parts_as_in_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    """With strays, a roof and a hole, so that every step has something to do."""
    from wlplan.io import scans
    from wlplan.io.readers import las

    random = np.random.default_rng(3)
    rows = scene.points(120.0)
    rows = rows[np.hypot(rows[:, 0] - 3.0, rows[:, 1] - 3.0) > 1.0]
    roof = scene.points(30.0, seed=2) * [0.2, 1.0, 0.0] + [14.0, 0.0, 7.0]
    strays = random.uniform(100.0, 200.0, (9, 3))
    rows = random.permutation(np.concatenate([rows, roof, strays]))
    path = tmp_path / f"a{ending}"
    write = write_ply if ending == ".ply" else write_las
    write(path, rows)
    crop = (-1.0, -1.0, 23.0, 250.0)
    whole, part = read_scan(path), read_scan(path, crop=crop)
    assert sum("left out 9 of" in note or "hang over" in note for note in whole.notes) == 2
    monkeypatch.setattr(scans, "_AT_ONCE", 997)
    monkeypatch.setattr(las, "_AT_ONCE", 1009)
    for one, again in ((whole, read_scan(path)), (part, read_scan(path, crop=crop))):
        np.testing.assert_array_equal(again.pile.height, one.pile.height)
        np.testing.assert_array_equal(again.pile.valid, one.pile.valid)
        assert again.notes == one.notes


# --- the command line


def test_the_help_names_every_ending(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert [ending for ending in known_endings() if ending not in text] == []
    assert main(["plan", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(option in text for option in ("--layer NAME", "--up [x|y|z|", "--ground LEVEL|FILE"))


def test_a_negative_axis_is_no_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_ply(tmp_path / "a.ply", tilted(scene.points(20.0), "-y"))
    assert main(["diggability", str(path), "--locations", "2", "--up", "-y", "--json"]) == 0
    assert "-y is up in the file" in capsys.readouterr().err
