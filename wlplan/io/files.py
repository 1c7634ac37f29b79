"""Files: written in one piece or not at all, and what is said of those that cannot be read."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from wlplan.errors import InputError


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file as UTF-8, in one piece or not at all: see `write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode())


def write_bytes_atomic(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file beside its target and move it there, so that no reader sees half of it.

    Raises:
        InputError: If the folder is missing or the file cannot be written there. The target is then
            as it was.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        try:
            with beside.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(beside, path)
        except BaseException:
            with contextlib.suppress(OSError):
                beside.unlink()
            raise
    except OSError as error:
        reason = error.strerror or one_line(error)
        raise InputError(f"{path}: cannot be written ({reason}): choose another place.") from error


def check_is_file(path: Path, what: str) -> None:
    """Refuse a path that is missing or a folder; `what` says what kind of file it should be."""
    # Unlike Path.exists, these take names that no file can have for missing ones.
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder: name the {what} file itself.")
    if not os.path.exists(path):
        raise InputError(f"{path}: no such {what} file: check the name.")


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Put the name of the file before the message of an `InputError`."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error.__cause__


def one_line(error: object) -> str:
    """The gist of a message: one line, at most 120 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:117] + "..."
