"""Nothing is connected to as the package is used, and what it keeps for a moment is private."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scene
from scan_files import write_tif

from wlplan.io.files import atomic_folder, write_text_atomic

# A process that refuses to connect, to look names up, and to send.
REFUSING = """
import sys
def refuse(event, arguments):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.sendto", "socket.bind"):
        sys.stderr.write(f"REFUSED {event} {arguments}\\n")
        raise RuntimeError(f"{event} {arguments}")
sys.addaudithook(refuse)
"""
RUN = "from wlplan.cli import main\nraise SystemExit(main(sys.argv[1:]))\n"


def run(folder: Path, code: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Words of the command line in such a process, whose libraries are asked to use the network."""
    asked = {"PROJ_NETWORK": "ON", "CPL_CURL_VERBOSE": "YES"}
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", REFUSING + code, *words],
        cwd=folder,
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def scan(tmp_path: Path) -> str:
    band = np.ascontiguousarray(scene.grid(0.4).astype(np.float32).T[::-1])
    place = {"west": 500_000.0, "north": 5_000_000.0, "crs": "EPSG:25832"}
    return write_tif(tmp_path / "a.tif", band, step=0.4, **place).name  # type: ignore[arg-type]


def test_reading_a_scan_connects_to_nothing(tmp_path: Path, scan: str) -> None:
    done = run(tmp_path, RUN, "info", scan)
    assert "REFUSED" not in done.stderr
    assert done.returncode == 0


@pytest.mark.slow
def test_planning_connects_to_nothing(tmp_path: Path, scan: str) -> None:
    words = ("--loads", "1", "--planner", "nominal", "--world", "low", "--out", "plan")
    done = run(tmp_path, RUN, "plan", scan, *words)
    assert "REFUSED" not in done.stderr
    assert done.returncode == 0
    assert (tmp_path / "plan" / "report.html").exists()


def test_the_check_sees_who_connects(tmp_path: Path) -> None:
    code = "import socket\nsocket.create_connection(('127.0.0.1', 9))\n"
    assert "REFUSED" in run(tmp_path, code).stderr


def test_what_is_being_written_is_private(tmp_path: Path) -> None:
    """Until it is whole; then it is what the user's mask says."""
    before = os.umask(0)
    try:
        with atomic_folder(tmp_path / "out") as folder:
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        os.umask(0o022)
        with atomic_folder(tmp_path / "other"):
            pass
        write_text_atomic(tmp_path / "file", "text")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o777
    assert stat.S_IMODE((tmp_path / "other").stat().st_mode) == 0o755
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o644
