"""Broken files of every format: a pile, or one line that says why not; nothing else, ever."""

import functools
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scene
from examples import examples
from hypothesis import given, settings
from mutations import Edit, edited, edits
from scan_files import write_las, write_ply, write_tif

from wlplan.errors import InputError
from wlplan.io import read_pile
from wlplan.io.readers import known_endings

# The corner with the mound: a small map is soon read.
ROWS = scene.points(6.0)
ROWS = ROWS[(ROWS[:, 0] > 17.0) & (ROWS[:, 1] < 7.0)]
HEIGHTS = scene.grid(0.4)[42:, :18]
FACES = 2.0 * scene.triangles()[-72:]
# Where a file is kept that ends in something else, to be named and added to tests/corpus/scans.
FOUND = Path(__file__).parents[1] / "out" / "fuzz"
SMALL = {"elevation": HEIGHTS}


def _npz(path: Path) -> None:
    np.savez(path, height=HEIGHTS, cell_size=0.4)


def _e57(path: Path) -> None:
    place = np.array([3.0, 4.0, 2.0])
    scene.write_e57(path, [(ROWS[::2], 0.3, place), (ROWS[1::2], 0.0, 0.0 * place)])


WRITERS: dict[str, Callable[[Path], object]] = {
    ".npz": _npz,
    ".tif": lambda path: write_tif(path, HEIGHTS.T[::-1].copy(), step=0.4),
    ".tiff": lambda path: write_tif(path, HEIGHTS.T[::-1].copy(), step=0.4, compress="deflate"),
    ".las": lambda path: write_las(path, ROWS),
    ".laz": lambda path: write_las(path, ROWS),
    ".ply": lambda path: write_ply(path, ROWS),
    "text.ply": lambda path: write_ply(path, ROWS, "ascii"),
    ".pcd": lambda path: scene.write_pcd(path, ROWS),
    "text.pcd": lambda path: scene.write_pcd(path, ROWS, "ascii"),
    "packed.pcd": lambda path: scene.write_pcd(path, ROWS, "binary_compressed"),
    ".e57": _e57,
    ".obj": lambda path: scene.write_obj(path, FACES),
    ".stl": lambda path: scene.write_stl(path, FACES),
    "text.stl": lambda path: scene.write_stl(path, FACES, text=True),
    ".xyz": lambda path: scene.write_xyz(path, ROWS),
    ".txt": lambda path: scene.write_xyz(path, ROWS, header="x [m] y [m] z [m]"),
    ".csv": lambda path: scene.write_xyz(path, ROWS, delimiter=";", header="x;y;z"),
    ".asc": lambda path: scene.write_grid(path, HEIGHTS, 0.4),
    ".bag": lambda path: scene.write_bag(path, SMALL, cell=0.4),
    ".mcap": lambda path: scene.write_bag(path, SMALL, cell=0.4),
    ".db3": lambda path: scene.write_bag(path, SMALL, cell=0.4),
}


def checked(ending: str, content: bytes) -> bytes:
    """The same with checksums that fit: those of E57 would catch whatever was changed."""
    if ending != ".e57":
        return content
    pages = bytearray(content)
    for start in range(0, len(pages) - 1023, 1024):
        pages[start + 1020 : start + 1024] = _crc32c(pages[start : start + 1020]).to_bytes(4, "big")
    return bytes(pages)


_TABLE = []
for _byte in range(256):
    for _ in range(8):
        _byte = _byte >> 1 ^ (0x82F63B78 if _byte & 1 else 0)
    _TABLE.append(_byte)


def _crc32c(content: bytes | bytearray) -> int:
    value = 0xFFFFFFFF
    for byte in content:
        value = value >> 8 ^ _TABLE[(value ^ byte) & 255]
    return value ^ 0xFFFFFFFF


def outcome(path: Path) -> str:
    """What becomes of a file: "read", or the line that it was refused with."""
    try:
        read_pile(path)
    except InputError as error:
        said = str(error)
    else:
        said = "read"
    assert "\n" not in said
    return said


@functools.cache
def whole(name: str) -> bytes:
    """The content of a file that can be read."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{name}"
        WRITERS[name](path)
        assert outcome(path) == "read"
        content = path.read_bytes()
        assert checked(path.suffix, content) == content
        return content


def broken(name: str, changes: list[Edit]) -> bytes:
    """The content of that file after changes."""
    return checked(Path(f"a{name}").suffix, edited(whole(name), changes))


def read_or_refused(name: str, changes: list[Edit]) -> str:
    """What becomes of that file after changes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{name}"
        content = broken(name, changes)
        path.write_bytes(content)
        try:
            return outcome(path)
        except BaseException:
            # For `make fuzz`, which says where it lies: the last one written is the smallest.
            FOUND.mkdir(parents=True, exist_ok=True)
            (FOUND / f"found{'' if name[0] == '.' else '-'}{name}").write_bytes(content)
            raise


def test_every_ending_has_a_file_to_break() -> None:
    assert {Path(f"a{name}").suffix for name in WRITERS} == set(known_endings())


@pytest.mark.parametrize("name", WRITERS)
def test_broken_files_end_in_a_pile_or_in_one_line(
    name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert search(name, 12) >= 2
    assert capfd.readouterr() == ("", "")


def search(name: str, few: int) -> int:
    """Reads so many broken files; returns how many of them were refused."""
    refused = 0

    @settings(max_examples=examples(few))
    @given(changes=edits())
    def each(changes: list[Edit]) -> None:
        nonlocal refused
        refused += read_or_refused(name, changes) != "read"

    each()
    return refused


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_many_broken_files_end_so_in_little_memory(name: str) -> None:
    """In a process of its own, which may crash, hang or ask for too much by itself."""
    code = (
        f"import sys; sys.path[:0] = {sys.path!r}; import conftest, test_readers_fuzz as f; "
        f"f.limited(); print(f.search({name!r}, 150) > 20)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=1200
    )
    # libtiff has a line of its own for a seek that fails, which nothing turns off.
    said = [line for line in done.stderr.splitlines() if not line.startswith("_tiffSeekProc: ")]
    assert (done.returncode, done.stdout, said) == (0, "True\n", [])


def limited() -> None:
    """Give this process 2 GiB more than it has, as far as the system counts that."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**31,) * 2)
