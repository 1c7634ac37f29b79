"""Files and folders, written in one piece or not at all; errors for files that cannot be read."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from wlplan.errors import InputError, one_line

# Windows would else change the ends of lines.
_BINARY = getattr(os, "O_BINARY", 0)
# Of Linux: relative to the working directory, and names that change places.
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file as UTF-8, in one piece or not at all: see `write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode())


def write_bytes_atomic(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file beside its target and move it there, so that no reader sees half of it.

    Raises:
        InputError: If the folder is missing or the file cannot be written there. The target is then
            as it was.
    """
    try:
        replace_file(Path(path), content)
    except OSError as error:
        reason = one_line(error.strerror or error)
        raise InputError(f"{path}: cannot be written ({reason}): choose another place.") from error


def replace_file(path: Path, content: bytes) -> None:
    """`write_bytes_atomic` for callers that word the error themselves.

    Raises:
        OSError: If the folder is missing or the file cannot be written there.
    """
    temporary = _temporary(path)
    try:
        # Nobody else reads or changes it before it is whole.
        handle = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY | _BINARY, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~_mask())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


@contextlib.contextmanager
def atomic_folder(
    path: str | os.PathLike[str],
    *,
    existing: Literal["refuse", "replace", "add"] = "refuse",
    locked: bool = False,
) -> Iterator[Path]:
    """A temporary folder to write to, which becomes the folder at `path` when the block ends.

    If the block fails or is interrupted, or the last step does, what is at `path` is as it was, and
    nothing else is left. Only a process that is killed leaves its temporary folder, a hidden one
    with a name like `.models.0123456789ab.tmp`.

    Args:
        path: Folder to write. Missing folders above it are made. Of a symbolic link to a folder,
            that folder is meant.
        existing: What is done if there is a folder already:
            "refuse": nothing, an error is raised, unless it is empty;
            "replace": the new folder takes its place, and the old one is removed. On Linux that
            is one step; elsewhere a process that is killed between the two leaves none there, and
            the old one beside it, hidden;
            "add": the new files are moved into it one by one, over files of the same name; all
            other files stay, and if a move fails the earlier ones are undone.
        locked: The caller keeps other processes from writing to `path`. Temporary folders that
            killed ones left are then removed first.

    Yields:
        An empty folder on the file system of `path`.

    Raises:
        FileExistsError: If there is a file at `path`, or a folder that is refused.
        IsADirectoryError: If there is a folder where a new file goes.
        OSError: If `path` cannot be written.
    """
    place = Path(os.path.realpath(path))
    if place.exists() and not place.is_dir():
        raise FileExistsError(errno.EEXIST, "a file is there", str(path))
    adds = existing == "add" and place.is_dir()
    if existing == "refuse" and place.is_dir() and any(place.iterdir()):
        raise FileExistsError(errno.EEXIST, "the folder is there and not empty", str(path))
    if locked:
        _remove_leftovers(place)
    missing = [folder for folder in place.parents if not folder.exists()]
    # Files are added from inside the folder: it may be all that can be written to.
    temporary = _temporary(place / place.name if adds else place)
    with contextlib.ExitStack() as at_end:
        for folder in reversed(missing):
            at_end.callback(remove_empty, folder)
        # Twice: an interrupt may cut the first short.
        at_end.callback(_remove_folder, temporary)
        at_end.callback(_remove_folder, temporary)
        if missing:
            place.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir(0o700)
        yield temporary
        temporary.chmod(0o777 & ~_mask())
        if adds:
            _move_files(temporary, place)
        elif existing == "replace" and place.is_dir():
            _replace_folder(place, temporary)
        else:
            os.replace(temporary, place)


def remove_empty(folder: Path) -> None:
    """Remove a folder if it is there and nothing is in it."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def _move_files(source: Path, target: Path) -> None:
    """Move all entries of a folder into another one: all, or none."""
    entries = sorted(source.iterdir())
    for entry in entries:
        if (target / entry.name).is_dir():
            raise IsADirectoryError(
                errno.EISDIR, "a folder is where a file goes", str(target / entry.name)
            )
    earlier = source / f".{secrets.token_hex(6)}.earlier"
    earlier.mkdir()
    begun: list[Path] = []
    try:
        for entry in entries:
            begun.append(entry)
            goal = target / entry.name
            if os.path.lexists(goal):
                _set_aside(goal, earlier / entry.name)
            os.replace(entry, goal)
    except BaseException:
        for entry in reversed(begun):
            goal, kept = target / entry.name, earlier / entry.name
            if os.path.lexists(kept):
                os.replace(kept, goal)
            elif not os.path.lexists(entry):
                os.replace(goal, entry)
        raise


def _set_aside(path: Path, aside: Path) -> None:
    """Give a file a second name; where the file system has no such names, only that one."""
    try:
        os.link(path, aside, follow_symlinks=False)
    except (OSError, NotImplementedError):
        os.replace(path, aside)


def _replace_folder(place: Path, new: Path) -> None:
    """Put a new folder in the place of an old one, which is removed; restored if that fails."""
    # In one step, so that no process that is killed leaves the place empty. The old one is then
    # where the new one was, and goes with it.
    if _exchange(new, place):
        return
    old = new.with_suffix(".old")
    try:
        os.replace(place, old)
        os.replace(new, place)
    except BaseException:
        if old.exists():
            if not new.exists():
                os.replace(place, new)
            os.replace(old, place)
        raise
    try:
        _remove_folder(old)
    finally:
        _remove_folder(old)


def _exchange(one: Path, other: Path) -> bool:
    """Have two folders change places in one step; False where that cannot be: only Linux can."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    places = (os.fsencode(path) for path in (one, other))
    if rename(_AT_FDCWD, next(places), _AT_FDCWD, next(places), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    # Kernels and file systems that do not know it.
    if code in (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP):
        return False
    raise OSError(code, os.strerror(code), str(other))


def _remove_folder(folder: Path) -> None:
    """Remove a folder with all it holds, as far as possible."""
    # What fails once may succeed.
    for _ in range(2):
        shutil.rmtree(folder, ignore_errors=True)


def _mask() -> int:
    """Permissions that the user wants no new file to have."""
    # It can only be read by being set: to what is harmless for the files of other threads.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _temporary(path: Path) -> Path:
    """A hidden name beside a path that nothing has yet."""
    return path.parent / f".{path.name or 'wlplan'}.{secrets.token_hex(6)}.tmp"


def _remove_leftovers(place: Path) -> None:
    """Remove the temporary folders that killed processes left beside a place."""
    pattern = re.compile(rf"\.{re.escape(place.name)}\.[0-9a-f]{{12}}\.tmp")
    if not place.parent.is_dir():
        return
    for entry in list(place.parent.iterdir()):
        if pattern.fullmatch(entry.name) and entry.is_dir():
            _remove_folder(entry)


MADE_BY = "made by wlplan"
"""What every file that is no JSON says in its head or tail, so that we know it for ours."""

# What says so in JSON, and how much of a file is looked at from either end.
_FORMAT = re.compile(rb'"format":\s*"wlplan\.')
_ENDS = 1 << 16


def is_ours(path: Path) -> bool:
    """Whether a file says that wlplan has written it; no for what cannot be read."""
    try:
        # A pipe would have to be waited for.
        if not stat.S_ISREG(os.stat(path).st_mode):
            return False
        with path.open("rb") as file:
            ends = [file.read(_ENDS)]
            file.seek(max(0, file.seek(0, os.SEEK_END) - _ENDS))
            ends.append(file.read(_ENDS))
    except OSError:
        return False
    return any(MADE_BY.encode() in end or _FORMAT.search(end) for end in ends)


def check_is_file(path: Path, what: str) -> None:
    """Refuse a path that is missing or a folder; `what` says what kind of file it should be."""
    # Unlike Path.exists, these take names that no file can have for missing ones.
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder: name the {what} file itself.")
    if not os.path.exists(path):
        raise InputError(f"{path}: no such {what} file: check the name.")
    # Some of them never end. A pipe does, and may be how a file is given.
    if stat.S_ISCHR(kind := os.stat(path).st_mode) or stat.S_ISBLK(kind):
        raise InputError(f"{path}: is a device: name a {what} file.")


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Put the name of the file before the message of an `InputError`."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error.__cause__
