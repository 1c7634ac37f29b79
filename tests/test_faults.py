"""Whatever is written is whole or not there, whichever operation on files fails, and when."""

import contextlib
import errno
import itertools
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from faults import (
    ERROR,
    INTERRUPT_AFTER,
    KINDS,
    READ_ONLY,
    Ended,
    Fault,
    Kind,
    Tree,
    check_all_or_nothing,
    for_every_fault,
    struck,
    tree,
)

from wlplan.errors import InputError
from wlplan.io import files, write_pile, write_plan, write_text_atomic
from wlplan.io.files import atomic_folder
from wlplan.terrain.seed_piles import seed_pile


def ended(call: Callable[[], object]) -> Callable[[], Ended]:
    """How a call of Python ends, as the command line would say it."""

    def run() -> Ended:
        try:
            call()
        except (InputError, OSError) as error:
            return 2, f"error: {error}\n"
        except KeyboardInterrupt:
            return 130, "error: interrupted\n"
        return 0, ""

    return run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder whose files may fail."""
    (tmp_path / "watched").mkdir()
    return tmp_path / "watched"


# --- what everything is written with


def write_file(folder: Path) -> None:
    write_text_atomic(folder / "a", "new")


def write_into(folder: Path, existing: Any) -> None:
    with atomic_folder(folder / "above" / "out", existing=existing) as new:
        for name in "abc":
            write_text_atomic(new / name, "new")


def fill(folder: Path) -> None:
    """What is there before: a file of its own, one that is to be replaced, a folder."""
    (folder / "above" / "out").mkdir(parents=True)
    for path in (folder / "a", folder / "above" / "out" / "a", folder / "above" / "out" / "z"):
        path.write_text("old")


WRITERS: Mapping[str, tuple[bool, Callable[[Path], None]]] = {
    "a new file": (False, write_file),
    "a file": (True, write_file),
    "a new folder": (False, lambda folder: write_into(folder, "refuse")),
    "a new folder to add to": (False, lambda folder: write_into(folder, "add")),
    "a folder added to": (True, lambda folder: write_into(folder, "add")),
    "a folder replaced": (True, lambda folder: write_into(folder, "replace")),
}
each_writer = pytest.mark.parametrize("name", WRITERS)


@pytest.fixture(params=[True, False], ids=["one step", "two steps"])
def exchanges(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """With folders that can change places in one step, and without."""
    if not request.param:
        monkeypatch.setattr(files, "_exchange", lambda *_: False)


@each_writer
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@pytest.mark.usefixtures("exchanges")
def test_all_is_old_or_all_is_new(folder: Path, name: str, kind: Kind) -> None:
    filled, write = WRITERS[name]
    if filled:
        fill(folder)
    check_all_or_nothing(folder, kind, ended(lambda: write(folder)))


@each_writer
def test_on_a_disk_that_stays_read_only_each_file_is_whole(folder: Path, name: str) -> None:
    """Nothing can be undone there: files may be old and new side by side, and hidden ones stay."""
    filled, write = WRITERS[name]
    if filled:
        fill(folder)

    found: list[tuple[Fault, dict[str, bytes | None]]] = []

    def keep(fault: Fault, _: Ended, left: Tree) -> None:
        found.append((fault, shown(left)))

    run = ended(lambda: write(folder))
    count, before, after = for_every_fault(folder, READ_ONLY, run, keep)
    assert count > 0
    old, new = shown(before), shown(after)
    for fault, seen in found:
        assert set(old) & set(new) <= set(seen), fault.struck
        assert all(
            content in (old.get(name, new.get(name)), new.get(name, old.get(name)))
            for name, content in seen.items()
        ), fault.struck


def shown(found: Tree) -> dict[str, bytes | None]:
    """What is not hidden, without permissions."""
    return {
        name: content
        for name, (_, content) in found.items()
        if not any(part.startswith(".") for part in Path(name).parts)
    }


@each_writer
# A file that was just opened.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_ctrl_c_at_any_line_leaves_all_old_or_all_new(folder: Path, name: str) -> None:
    """At most a hidden folder stays, where it comes between two statements of the tidying up."""
    filled, write = WRITERS[name]
    states: list[Tree] = []
    for number in itertools.count(1):
        shutil.rmtree(folder)
        folder.mkdir()
        if filled:
            fill(folder)
        before = tree(folder)
        with contextlib.suppress(KeyboardInterrupt), interrupted_at_line(number) as lines:
            write(folder)
        left = tree(folder)
        if lines[0] < number:
            after = left
            break
        states.append(left)
    assert len(states) > 10
    assert all(shown(left) in (shown(before), shown(after)) for left in states)
    assert sum(left not in (before, after) for left in states) <= 1


@contextlib.contextmanager
def interrupted_at_line(number: int) -> Iterator[list[int]]:
    """Ctrl-C before line number `number` that runs of `wlplan/io/files.py`; yields the count."""
    seen = [0]

    def trace(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code.co_filename != files.__file__:
            return None
        if event == "line":
            seen[0] += 1
            if seen[0] == number:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield seen
    finally:
        sys.settrace(before)


def test_the_law_can_fail(folder: Path) -> None:
    """A file written where it belongs is seen half; one that is left behind is seen too."""

    def plain() -> None:
        with open(folder / "a", "w") as file:
            file.write("new" * 1000)

    def untidy() -> None:
        (folder / "a.tmp").write_text("new")
        os.replace(folder / "a.tmp", folder / "a")

    for write in (plain, untidy):
        with pytest.raises(AssertionError, match="neither old nor new"):
            check_all_or_nothing(folder, ERROR, ended(write))


# --- functions of Python


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_piles_and_plans_are_whole(folder: Path, kind: Kind) -> None:
    pile = seed_pile("conical", slope=0.5, height=1.0)
    load = {
        **dict.fromkeys(("x", "y", "heading"), 0.0),
        "action": dict.fromkeys(("delta_bm", "k_bm", "delta_bk", "k_bk"), 0.5),
    }
    document = {"format": "wlplan.plan/1", "loads": [load]}
    for name, write in (
        ("pile.npz", lambda: write_pile(folder / "pile.npz", pile)),
        ("plan.json", lambda: write_plan(folder / "plan.json", document)),
    ):
        check_all_or_nothing(folder, kind, ended(write))
        (folder / name).write_text("old")
        check_all_or_nothing(folder, kind, ended(write))
