"""Compiled programs that are kept: loaded again, apart by what made them, dropped in doubt."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from wlplan.cli import programs, wlplan

# Compiles or loads one program, and says how many it loaded; "die" as the last word: then dies.
SCRIPT = """
import os, signal, sys
from wlplan.cli import programs
found = programs.use_cache()
import jax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: (x @ x).sum())(jax.numpy.ones((3, 3))).block_until_ready()
print(found.folder is not None, hits.count("/jax/compilation_cache/cache_hits"), flush=True)
if sys.argv[-1] == "die":
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for programs, used by this process and those it starts."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    # What is set here would else be set for the tests after this one.
    monkeypatch.setenv("WLPLAN_TRACES", "")
    for name in ("MIN_COMPILE_TIME_SECS", "MIN_ENTRY_SIZE_BYTES"):
        monkeypatch.setenv(f"JAX_PERSISTENT_CACHE_{name}", "0")
    monkeypatch.setenv(programs.VARIABLE, str(tmp_path / "kept"))
    return tmp_path / "kept"


def run(*words: str) -> tuple[bool, int, int]:
    """Whether programs are kept, how many were loaded, and the exit code."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *words], capture_output=True, text=True, check=False
    )
    kept, hits = done.stdout.split()
    return kept == "True", int(hits), done.returncode


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a process is killed")
def test_programs_are_loaded_again_until_a_run_is_cut_short(place: Path) -> None:
    assert run() == (True, 0, 0)
    kept, loaded, _ = run("die")
    assert kept
    assert loaded > 0
    # That one died: what it had loaded is in doubt, and compiled anew.
    assert run() == (True, 0, 0)
    assert run()[1] == loaded
    (folder,) = place.iterdir()
    assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a process is killed")
def test_after_three_in_a_row_nothing_is_loaded_until_it_is_cleared(place: Path) -> None:
    for _ in range(3):
        assert run("die")[::2] == (True, -signal.SIGKILL)
    assert run()[0] is False
    assert "cut short" in programs.cache().reason
    assert programs.clear() > 0
    assert run()[0] is True
    assert run()[1] > 0


def test_programs_are_apart_by_what_made_them(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = programs.cache().folder
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert programs.cache().folder != folder
    monkeypatch.undo()
    monkeypatch.setenv(programs.VARIABLE, str(place))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert programs.cache().folder == folder
    other = {**programs.made_with(), "jaxlib": "0.0.1"}
    monkeypatch.setattr(programs, "made_with", lambda: other)
    assert programs.cache().folder != folder


def test_a_folder_that_others_can_write_is_not_loaded_from(place: Path) -> None:
    folder = programs.cache().folder
    assert folder is not None
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    assert "others" in programs.use_cache().reason
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_a_place_that_cannot_be_written_is_no_error(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place.write_text("a file")
    found = programs.use_cache()
    assert found.folder is None
    assert str(place) in found.reason
    for name, value in (("WLPLAN_CACHE", "off"), ("JAX_ENABLE_COMPILATION_CACHE", "false")):
        monkeypatch.setenv(name, value)
        assert programs.use_cache().reason.startswith(name)
        monkeypatch.delenv(name)


def test_the_oldest_go_and_what_is_not_ours_stays(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = programs.use_cache().folder
    assert folder is not None
    for number in range(4):
        path = folder / f"jit_f-{number}-cache"
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 + number, 1e9 + number))
    (place / "foreign").mkdir()
    (place / "foreign" / "thesis.tex").touch()
    monkeypatch.setattr(programs, "_LONGEST", float("inf"))
    monkeypatch.setattr(programs, "_MOST", 250)
    programs._prune()
    assert [path.name for path in programs.cache().programs()] == [
        "jit_f-2-cache",
        "jit_f-3-cache",
    ]
    monkeypatch.setattr(programs, "_LONGEST", 60.0)
    programs._prune()
    assert programs.cache().programs() == []
    programs.clear()
    assert not folder.exists()
    assert (place / "foreign" / "thesis.tex").exists()


def test_times_are_remembered(place: Path) -> None:
    kept = programs.use_cache()
    assert kept.seconds("plan") is None
    kept.remember("plan", 12.34)
    kept.remember("play", 3.0)
    assert programs.cache().seconds("plan") == 12.3
    assert kept.folder is not None
    (kept.folder / "times.json").write_text('{"plan": "x"')
    assert kept.seconds("plan") is None


def test_the_command_shows_and_clears(place: Path) -> None:
    kept = programs.use_cache().folder
    assert kept is not None
    (kept / "jit_f-1-cache").write_bytes(bytes(2000))
    shown = json.loads(CliRunner().invoke(wlplan, ["cache", "--json"]).stdout)
    assert (shown["programs"], shown["bytes"]) == (1, 2000)
    assert shown["folder"] == str(kept)
    words = CliRunner().invoke(wlplan, ["cache"]).stdout
    assert words.startswith("1 programs, 0.0 MB, in ")
    cleared = json.loads(CliRunner().invoke(wlplan, ["cache", "--clear", "--json"]).stdout)
    assert cleared["cleared"] >= 2
    assert cleared["programs"] == 0
    assert not kept.exists()


@pytest.mark.parametrize(
    ("version", "given", "expected"),
    [
        ("0.10.2", None, "--xla_cpu_use_fusion_emitters=false"),
        ("0.8.0", "", "--xla_cpu_use_fusion_emitters=false"),
        ("0.11.0", None, None),
        ("0.7.2", None, None),
        ("0.10.2", "--xla_dump_to=here", "--xla_dump_to=here"),
    ],
)
def test_only_versions_that_know_the_flag_are_told(
    version: str, given: str | None, expected: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs, "_version", lambda name: version)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if given is not None:
        monkeypatch.setenv("XLA_FLAGS", given)
    programs.compile_fast()
    assert os.environ.get("XLA_FLAGS") == expected
