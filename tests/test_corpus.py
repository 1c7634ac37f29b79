"""The corpus of files with something wrong: each is read or ends with one line, and soon.

`tests/make_corpus.py` made most of them; what `make fuzz` finds is added. All are read by a process
of its own that may take little memory, which may crash or hang by itself.
"""

from __future__ import annotations

import faulthandler
import json
import resource
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest

from wlplan.dataset import open_dataset
from wlplan.errors import InputError
from wlplan.io import read_pile, read_plan
from wlplan.io.areas import read_areas
from wlplan.models.storage import load_model, read_description
from wlplan.planning.amounts import amount_recorded
from wlplan.report.stands import stands_of
from wlplan.site.frame import frame_recorded
from wlplan.site.presets import machine_named, machine_recorded, soil_named, soil_recorded

CORPUS = Path(__file__).parent / "corpus"
FILES = sorted(path for path in CORPUS.rglob("*") if path.is_file())
# Most seconds that a file of some kB may take, and memory beyond what there is at first [bytes].
MOST_SECONDS, MOST_MEMORY = 30, 2**31


def read_plan_whole(path: Path) -> None:
    """A plan with all that is read of it to play it."""
    _, document = read_plan(path)
    for name, read in (("soil", soil_recorded), ("machine", machine_recorded)):
        record = document.get(name)
        if isinstance(record, dict):
            read(record.get("parameters"))
    frame_recorded(document)
    amount_recorded(document.get("job"))
    stands_of(document)


def read_model(path: Path) -> None:
    """A model of whatever kind it says it is."""
    load_model(path, read_description(path, None)["kind"])


def unpacked(read: Callable[[Path], object]) -> Callable[[Path], object]:
    """The same of a folder that is kept as an archive."""

    def from_archive(path: Path) -> None:
        with tempfile.TemporaryDirectory() as folder, tarfile.open(path) as archive:
            archive.extractall(Path(folder) / "f", filter="data")
            read(Path(folder) / "f")

    return from_archive


READERS: dict[str, Callable[[Path], object]] = {
    "scans": read_pile,
    "plans": read_plan_whole,
    "soils": soil_named,
    "machines": machine_named,
    "areas": read_areas,
    "models": unpacked(read_model),
    "stores": unpacked(open_dataset),
}


class TooSlowError(BaseException):
    """A file took longer than it may."""


def outcome(read: Callable[[Path], object], path: Path) -> str:
    """Says "read", or the line that a file was refused with; any other error goes on."""

    def too_slow(*_: int | FrameType | None) -> None:
        raise TooSlowError(f"{path} takes longer than {MOST_SECONDS} s")

    before = signal.signal(signal.SIGALRM, too_slow)
    # Again and again: where it strikes as garbage is collected, Python ignores it.
    signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS, 0.1)
    try:
        read(path)
    except InputError as error:
        return f"refused: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    return "read"


def replay() -> None:
    """Prints what becomes of each file of the corpus, as lines of JSON."""
    faulthandler.enable()
    # What is loaded at the first use of a library is not a file's.
    for part in READERS:
        first = next(path for path in FILES if path.parent.name == part)
        outcome(READERS[part], first)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY,) * 2)
    for path in FILES:
        begin = time.monotonic()
        try:
            became = outcome(READERS[path.parent.name], path)
        except BaseException as error:
            became = f"{type(error).__name__}: {error}"
        row = [path.relative_to(CORPUS).as_posix(), became, time.monotonic() - begin]
        print(json.dumps(row), flush=True)


@pytest.fixture(scope="module")
def outcomes() -> dict[str, str]:
    """What became of each file, by its path below the corpus."""
    code = f"import sys; sys.path[:0] = {sys.path!r}; import test_corpus as t; t.replay()"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=600
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    last = rows[-1][0] if rows else "none"
    assert done.returncode == 0, f"it ended after {last}: {done.stderr[-2000:]}"
    assert done.stderr == ""
    return {name: became for name, became, _ in rows}


def test_every_file_of_the_corpus_is_read_or_refused_in_one_line(outcomes: dict[str, str]) -> None:
    assert len(outcomes) == len(FILES) > 200
    wrong = {
        name: became
        for name, became in outcomes.items()
        if not (became == "read" or (became.startswith("refused: ") and "\n" not in became))
    }
    assert not wrong
    # The line names what is wrong with which file, in words that a person reads to the end.
    assert max(map(len, outcomes.values())) < 600


@pytest.mark.parametrize("part", READERS)
def test_most_of_what_is_wrong_is_seen(outcomes: dict[str, str], part: str) -> None:
    refused = [became != "read" for name, became in outcomes.items() if name.startswith(part)]
    assert sum(refused) > 0.6 * len(refused)


def test_the_corpus_is_small() -> None:
    assert sum(path.stat().st_size for path in FILES) < 1_000_000
    assert {path.parent.name for path in FILES} == set(READERS)


def test_the_law_can_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is no `InputError` is seen, and so is what takes too long."""

    def stumbles(_: Path) -> None:
        raise KeyError("height")

    with pytest.raises(KeyError):
        outcome(stumbles, tmp_path)
    monkeypatch.setattr(sys.modules[__name__], "MOST_SECONDS", 1)
    with pytest.raises(TooSlowError):
        outcome(lambda _: time.sleep(5), tmp_path)
