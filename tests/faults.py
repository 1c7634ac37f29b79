"""Faults of files on purpose: operation number k below a folder fails, for every k.

What writes, makes, moves or removes something is counted, whoever calls it in this process: files
opened to be written, each write to them and their close, and the functions of `os` below. One of
them then raises, before it is done, after it, or for good. Libraries that write by machine code of
their own are not seen; for them a disk can be full (`no_room`).
"""

from __future__ import annotations

import builtins
import contextlib
import errno
import gc
import io
import itertools
import os
import shutil
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from wlplan.io import files

# Which of their arguments are paths.
_OPERATIONS = {
    "open": 1,
    "write": 1,
    "fsync": 1,
    "mkdir": 1,
    "chmod": 1,
    "unlink": 1,
    "remove": 1,
    "rmdir": 1,
    "rename": 2,
    "replace": 2,
    "link": 2,
    "symlink": 2,
}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC

Tree = dict[str, tuple[int, bytes | None]]
Ended = tuple[int, str]


class Kind(NamedTuple):
    """A kind of fault."""

    name: str
    # Of the operation number n; they take turns where it makes no difference to us.
    error: Callable[[int], BaseException]
    after: bool = False  # it is done, and fails then
    for_good: bool = False  # so do all operations after it


def _os_error(number: int) -> OSError:
    code = (errno.ENOSPC, errno.EIO, errno.EROFS)[number % 3]
    return OSError(code, os.strerror(code))


def _gone(_: int) -> OSError:
    return OSError(errno.EROFS, os.strerror(errno.EROFS))


ERROR = Kind("error", _os_error)
INTERRUPT_BEFORE = Kind("Ctrl-C before", lambda _: KeyboardInterrupt())
INTERRUPT_AFTER = Kind("Ctrl-C after", lambda _: KeyboardInterrupt(), after=True)
READ_ONLY = Kind("read-only from here on", _gone, for_good=True)
KINDS = (ERROR, INTERRUPT_BEFORE, INTERRUPT_AFTER)


class Fault:
    """What strikes operation number `number` below a folder.

    Attributes:
        done: Operations so far.
        struck: Names of the operations that failed, in order.
    """

    def __init__(self, folder: Path, kind: Kind, number: int) -> None:
        self._folder, self._kind, self._number = os.path.realpath(folder), kind, number
        self.done, self.struck = 0, list[str]()
        self._lock = threading.Lock()

    def concerns(self, *paths: Any) -> bool:
        """Whether one of them is below the folder; a number is an open file."""
        return any(self._is_below(path) for path in paths)

    def _is_below(self, path: Any) -> bool:
        if isinstance(path, int):
            with contextlib.suppress(OSError):
                return os.readlink(f"/proc/self/fd/{path}").startswith(self._folder + os.sep)
            return False
        place = os.path.abspath(os.fsdecode(path))
        return os.path.realpath(os.path.dirname(place)).startswith(self._folder)

    def of(self, name: str, operation: Callable[[], Any]) -> Any:
        """Does an operation, or has it fail."""
        error = self._next(name)
        if error is not None and not self._kind.after:
            raise error
        result = operation()
        if error is not None:
            raise error
        return result

    def _next(self, name: str) -> BaseException | None:
        # Ctrl-C goes to the main thread.
        interrupts = isinstance(self._kind.error(0), KeyboardInterrupt)
        if interrupts and threading.current_thread() is not threading.main_thread():
            return None
        with self._lock:
            self.done += 1
            now = self.done
            if now == self._number or (self._kind.for_good and now > self._number):
                self.struck.append(name)
                return self._kind.error(now)
        return None


class _File:
    """A file opened to be written, whose writes and close are operations."""

    def __init__(self, file: Any, fault: Fault) -> None:
        self._file, self._fault = file, fault

    def write(self, content: Any) -> Any:
        """Where it fails, half of it was written."""

        def whole() -> Any:
            return self._file.write(content)

        try:
            return self._fault.of("write", whole)
        except BaseException:
            with contextlib.suppress(Exception):
                self._file.write(content[: len(content) // 2])
            raise

    def close(self) -> None:
        """It is closed either way."""
        if not self._file.closed:
            try:
                self._fault.of("close", lambda: None)
            finally:
                self._file.close()

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Any:
        return iter(self._file)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


@contextlib.contextmanager
def struck(folder: Path, kind: Kind, number: int) -> Iterator[Fault]:
    """Within it, operation number `number` (from 1 on) below a folder fails."""
    fault, real_open, real_exchange = Fault(folder, kind, number), io.open, files._exchange

    def patched(name: str, paths: int) -> Callable[..., Any]:
        real = getattr(os, name)

        def operation(*arguments: Any, **options: Any) -> Any:
            # Relative to an open folder, as when a tree is removed.
            near = [v for k, v in options.items() if k.endswith("dir_fd") and v is not None]
            reads = name == "open" and not (arguments[1] & _WRITES)
            if reads or not fault.concerns(*(near or arguments[:paths])):
                return real(*arguments, **options)
            return fault.of(name, lambda: real(*arguments, **options))

        return operation

    def exchange(one: Path, other: Path) -> bool:
        if not fault.concerns(one, other):
            return real_exchange(one, other)
        done: bool = fault.of("exchange", lambda: real_exchange(one, other))
        return done

    def open_file(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        if not set(mode) & set("wax+") or not fault.concerns(file):
            return real_open(file, mode, *arguments, **options)

        def opened() -> Any:
            return real_open(file, mode, *arguments, **options)

        # A number was counted when it was opened.
        return _File(opened() if isinstance(file, int) else fault.of("open", opened), fault)

    with pytest.MonkeyPatch.context() as patch:
        for name, paths in _OPERATIONS.items():
            patch.setattr(os, name, patched(name, paths))
        patch.setattr(files, "_exchange", exchange)
        patch.setattr(io, "open", open_file)
        patch.setattr(builtins, "open", open_file)
        yield fault


def tree(folder: Path) -> Tree:
    """Permissions and content of all below a folder, hidden ones too; of a folder None."""
    return {
        path.relative_to(folder).as_posix(): (
            stat.S_IMODE(path.lstat().st_mode),
            path.read_bytes() if path.is_file() else None,
        )
        for path in sorted(folder.rglob("*"))
    }


def for_every_fault(
    folder: Path,
    kind: Kind,
    run: Callable[[], Ended],
    check: Callable[[Fault, Ended, Tree], None],
    *,
    same: Callable[[Tree], object] = lambda found: found,
) -> tuple[int, Tree, Tree]:
    """Runs something once for each of its operations on files, which then fails.

    Args:
        folder: Folder whose files count; each run begins with what is in it now.
        kind: Of the faults.
        run: What is run; returns the exit code and what went to stderr.
        check: Is called after each run with what is in the folder then.
        same: What of a folder two runs without faults have in common; by default everything.

    Returns:
        How many faults there were, what was in the folder before, and what a run without any
        leaves there.
    """
    kept = folder.with_name(f"{folder.name}-kept")
    shutil.copytree(folder, kept)

    def restore() -> None:
        shutil.rmtree(folder)
        shutil.copytree(kept, folder)

    before = tree(folder)
    first = run()
    assert first[0] == 0, first
    after = tree(folder)
    for number in itertools.count(1):
        restore()
        with struck(folder, kind, number) as fault:
            ended = run()
        if not fault.struck:
            assert ended[0] == 0
            assert same(tree(folder)) == same(after)
            break
        check(fault, ended, tree(folder))
    restore()
    shutil.rmtree(kept)
    # What was opened as Ctrl-C came is forgotten here, not in the middle of another test.
    gc.collect()
    # For docs/reliability.md, see there.
    print(f"faults: {number - 1}")
    return number - 1, before, after


def check_all_or_nothing(folder: Path, kind: Kind, run: Callable[[], Ended]) -> int:
    """All files of a folder are what they were or the new ones, whichever operation fails.

    Nothing else is there: no temporary file and no lock. Exit code 2, or 130 after Ctrl-C, with one
    line on stderr; or 0 with all that was to be written, where only tidying up failed.

    Returns:
        How many faults there were.
    """
    found: list[tuple[Fault, Ended, Tree]] = []
    count, before, after = for_every_fault(folder, kind, run, lambda *row: found.append(row))
    wanted = 130 if isinstance(kind.error(0), KeyboardInterrupt) else 2
    for fault, (code, said), left in found:
        where = f"{kind.name}, operation {fault.done}, {fault.struck}"
        state = "old" if left == before else "new" if left == after else "neither"
        other = {k for k in {*left, *before, *after} if left.get(k) != before.get(k)}
        assert state != "neither", f"{where}: neither old nor new, differs in {sorted(other)}"
        if code == 0:
            assert state == "new", where
        else:
            assert code == wanted, f"{where}: exit code {code}, {said}"
            assert said.startswith("error: "), f"{where}: {said}"
            assert said.count("\n") == 1, f"{where}: {said}"
    assert count > 0, "nothing was written"
    return count
