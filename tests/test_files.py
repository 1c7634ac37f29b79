"""Laws of folders: written as a whole or not at all, and nothing of anybody else is touched."""

import errno
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import pytest

from wlplan.io import files
from wlplan.io.files import MADE_BY, atomic_folder, is_ours

Existing = Literal["refuse", "replace", "add"]


def contents(folder: Path) -> dict[str, str | None]:
    """What every file below a folder holds, hidden ones too; of a folder None."""
    return {
        path.relative_to(folder).as_posix(): path.read_text() if path.is_file() else None
        for path in folder.rglob("*")
    }


def fill(folder: Path, word: str) -> None:
    """Writes a file, and one in a folder."""
    (folder / "a.txt").write_text(word)
    (folder / "sub").mkdir()
    (folder / "sub" / "b.txt").write_text(word)


def make(path: Path, *, then: Callable[[], None] = lambda: None, **options: Any) -> None:
    """Writes a folder as `fill` does; `then` is called before the block ends."""
    with atomic_folder(path, **options) as temporary:
        fill(temporary, "new")
        then()


def raiser(error: type[BaseException]) -> Callable[[], None]:
    """A function that raises."""

    def fail() -> None:
        raise error

    return fail


def filled(word: str) -> dict[str, str | None]:
    return {"a.txt": word, "sub": None, "sub/b.txt": word}


def below(name: str, entries: Mapping[str, str | None]) -> dict[str, str | None]:
    """`entries` as `contents` has them one folder further up."""
    return {name: None} | {f"{name}/{key}": value for key, value in entries.items()}


@pytest.fixture
def target(tmp_path: Path) -> Path:
    """A folder with files of its own."""
    folder = tmp_path / "out"
    folder.mkdir()
    for name in ("a.txt", "other.txt", ".hidden"):
        (folder / name).write_text("old")
    return folder


OLD = {"a.txt": "old", "other.txt": "old", ".hidden": "old"}
EXISTING = ("refuse", "replace", "add")
FAILURES = (KeyboardInterrupt, SystemExit, OSError, ValueError)


def failing(
    monkeypatch: pytest.MonkeyPatch,
    which: int,
    error: type[BaseException] = KeyboardInterrupt,
    after: bool = False,
) -> None:
    """Has the call number `which` to `os.replace` fail: before it is done, or right after."""
    real, calls = os.replace, []

    def replace(source: Path, goal: Path) -> None:
        calls.append(goal)
        if len(calls) != which:
            return real(source, goal)
        if after:
            real(source, goal)
        raise error

    monkeypatch.setattr(os, "replace", replace)


# --- where nothing is


@pytest.mark.parametrize("existing", EXISTING)
def test_a_new_folder_appears_as_a_whole(tmp_path: Path, existing: Existing) -> None:
    path = tmp_path / "not" / "yet" / "out"
    with atomic_folder(path, existing=existing) as temporary:
        fill(temporary, "new")
        assert not path.exists()
        assert temporary.stat().st_dev == tmp_path.stat().st_dev
    assert contents(path) == filled("new")
    assert [entry.name for entry in path.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("existing", EXISTING)
def test_an_empty_folder_is_filled(tmp_path: Path, existing: Existing) -> None:
    with atomic_folder(tmp_path, existing=existing) as temporary:
        fill(temporary, "new")
    assert contents(tmp_path) == filled("new")


@pytest.mark.parametrize("existing", EXISTING)
@pytest.mark.parametrize("failure", FAILURES)
def test_what_fails_leaves_nothing(
    tmp_path: Path, existing: Existing, failure: type[BaseException]
) -> None:
    with pytest.raises(failure):
        make(tmp_path / "not" / "yet", existing=existing, then=raiser(failure))
    assert contents(tmp_path) == {}


def test_a_folder_above_that_somebody_else_uses_stays(tmp_path: Path) -> None:
    def fail() -> None:
        (tmp_path / "not" / "theirs.txt").write_text("theirs")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "not" / "yet" / "out", then=fail)
    assert contents(tmp_path) == below("not", {"theirs.txt": "theirs"})


@pytest.mark.parametrize("existing", ["refuse", "add"])
def test_what_appears_meanwhile_is_not_overwritten(tmp_path: Path, existing: Existing) -> None:
    path = tmp_path / "out"

    def appear() -> None:
        path.mkdir()
        (path / "theirs.txt").write_text("theirs")

    with pytest.raises(OSError, match="not empty"):
        make(path, existing=existing, then=appear)
    assert contents(tmp_path) == below("out", {"theirs.txt": "theirs"})


# --- where something is


@pytest.mark.parametrize("existing", EXISTING)
def test_a_file_is_no_folder(tmp_path: Path, existing: Existing) -> None:
    (tmp_path / "file").write_text("old")
    begun = raiser(AssertionError)
    with pytest.raises(FileExistsError):
        make(tmp_path / "file", existing=existing, then=begun)
    with pytest.raises(NotADirectoryError):
        make(tmp_path / "file" / "x", existing=existing, then=begun)
    assert contents(tmp_path) == {"file": "old"}


@pytest.mark.parametrize("existing", ["replace", "add"])
@pytest.mark.parametrize("failure", FAILURES)
def test_what_fails_leaves_what_was_there(
    target: Path, existing: Existing, failure: type[BaseException]
) -> None:
    before = contents(target.parent)
    with pytest.raises(failure):
        make(target, existing=existing, then=raiser(failure))
    assert contents(target.parent) == before


def test_a_folder_with_something_in_it_is_refused_before_anything_is_done(target: Path) -> None:
    before = contents(target.parent)
    with pytest.raises(FileExistsError):
        make(target, then=raiser(AssertionError))
    assert contents(target.parent) == before


def test_a_folder_is_replaced_with_all_it_holds(target: Path) -> None:
    with atomic_folder(target, existing="replace") as new:
        fill(new, "new")
        assert contents(target) == OLD
    assert contents(target.parent) == below("out", filled("new"))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it takes two steps")
def test_on_linux_a_folder_is_replaced_in_one_step(
    target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing(monkeypatch, 1)
    make(target, existing="replace")
    assert contents(target.parent) == below("out", filled("new"))


@pytest.mark.parametrize("which", [1, 2])
@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("failure", FAILURES)
def test_a_replacement_that_fails_restores_the_old(
    target: Path,
    monkeypatch: pytest.MonkeyPatch,
    which: int,
    after: bool,
    failure: type[BaseException],
) -> None:
    """Where it takes two steps."""
    monkeypatch.setattr(files, "_exchange", lambda *_: False)
    failing(monkeypatch, which, failure, after)
    with pytest.raises(failure):
        make(target, existing="replace")
    assert contents(target.parent) == below("out", OLD)


def test_files_are_added_to_those_that_are_there(target: Path) -> None:
    inode = target.stat().st_ino
    with atomic_folder(target, existing="add") as new:
        fill(new, "new")
        assert {k: v for k, v in contents(target).items() if k in OLD} == OLD
    assert contents(target.parent) == below("out", OLD | filled("new"))
    assert target.stat().st_ino == inode


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("which", range(1, 5))
def test_files_that_cannot_all_be_added_are_not_added(
    target: Path, monkeypatch: pytest.MonkeyPatch, which: int, after: bool, links: bool
) -> None:
    """Both over files that are there and to new names, and without links by further moves."""
    if not links:

        def no_links(*_: object, **__: object) -> None:
            raise OSError(errno.EPERM, "no links here")

        monkeypatch.setattr(os, "link", no_links)
    failing(monkeypatch, which, after=after)

    def add() -> None:
        with atomic_folder(target, existing="add") as new:
            for name in ("a.txt", "b.txt", "c.txt", "other.txt"):
                (new / name).write_text("new")

    with pytest.raises(KeyboardInterrupt):
        add()
    assert contents(target.parent) == below("out", OLD)
    add()
    names = dict.fromkeys(("a.txt", "b.txt", "c.txt", "other.txt"), "new")
    assert contents(target) == OLD | names


def test_a_folder_is_not_overwritten_by_a_file(target: Path) -> None:
    (target / "sub").mkdir()
    (target / "sub" / "theirs.txt").write_text("theirs")
    before = contents(target)
    with pytest.raises(IsADirectoryError):
        make(target, existing="add")
    assert contents(target) == before


@pytest.mark.parametrize("existing", ["replace", "add"])
def test_a_link_to_a_folder_means_that_folder(target: Path, existing: Existing) -> None:
    link = target.with_name("link")
    link.symlink_to(target)
    with atomic_folder(link, existing=existing) as new:
        (new / "b.txt").write_text("new")
    assert link.is_symlink()
    assert (target / "b.txt").read_text() == "new"
    assert sorted(entry.name for entry in target.parent.iterdir()) == ["link", "out"]


def test_the_working_directory_can_be_written_to(
    target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(target)
    with atomic_folder(".", existing="add") as new:
        (new / "b.txt").write_text("new")
    assert contents(target.parent) == below("out", OLD | {"b.txt": "new"})


# --- what killed processes left


def test_leftovers_are_removed_under_a_lock_only_and_nothing_like_them(tmp_path: Path) -> None:
    path = tmp_path / "out"
    left = tmp_path / ".out.0123456789ab.tmp"
    others = (".other.0123456789ab.tmp", ".out.notes.tmp", ".out.0123456789ab.old", "out.tmp")
    for name in (left.name, *others):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x").write_text("x")
    with atomic_folder(path) as new:
        fill(new, "first")
    assert left.exists()
    with atomic_folder(path, existing="replace", locked=True) as new:
        fill(new, "second")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted([*others, "out"])
    assert contents(path) == filled("second")


def test_a_name_with_special_characters_is_no_pattern(tmp_path: Path) -> None:
    (tmp_path / ".out.0123456789ab.tmp").mkdir()
    with atomic_folder(tmp_path / "o*t", locked=True) as new:
        fill(new, "new")
    assert (tmp_path / ".out.0123456789ab.tmp").exists()


# --- files


@pytest.mark.parametrize("failure", FAILURES)
def test_a_file_that_cannot_be_replaced_is_as_it_was(
    target: Path, monkeypatch: pytest.MonkeyPatch, failure: type[BaseException]
) -> None:
    failing(monkeypatch, 1, failure)
    with pytest.raises(failure):
        files.replace_file(target / "a.txt", b"new")
    assert contents(target) == OLD
    files.replace_file(target / "a.txt", b"new")
    assert contents(target) == OLD | {"a.txt": "new"}


# --- whose a file is


@pytest.mark.parametrize(
    ("content", "ours"),
    [
        (f"<meta content='{MADE_BY}'>", True),
        (f"{'x' * 200_000}{MADE_BY}", True),
        (f"{'x' * 200_000}{MADE_BY}{'x' * 200_000}", False),
        ('{\n  "format": "wlplan.plan/1",', True),
        ('{"format": "another"}', False),
        ("how wlplan plans", False),
        ("", False),
    ],
)
def test_a_file_of_ours_says_so(tmp_path: Path, content: str, ours: bool) -> None:
    path = tmp_path / "a"
    path.write_text(content)
    assert is_ours(path) is ours


def test_what_is_no_file_is_not_ours(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("nowhere")
    for name in ("pipe", "link", "none", "."):
        assert not is_ours(tmp_path / name)
