"""What the commands give out: folders, JSON, tables and remarks."""

from __future__ import annotations

import contextlib
import io
import json
import os
import secrets
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import click

from wlplan.cli.said import tell
from wlplan.cli.verbosity import is_asked
from wlplan.errors import InputError, one_line, shown


def checked_folder(name: str, files: Iterable[str] = ()) -> Path:
    """A folder to write to, found out to be possible before anything long is begun.

    Args:
        name: Path of the folder.
        files: Names of the files that are to be written into it.

    Raises:
        InputError: If it is a file, below one, or cannot be written; or one of the files is there
            and not from us.
    """
    from wlplan.io.files import is_ours, remove_empty

    if not name.strip():
        raise InputError("the name of the folder to write to is empty: give one.")
    if os.path.lexists(name) and not os.path.isdir(name):
        raise InputError(f"{name}: is a file: name a folder to write to.")
    folder = Path(name)
    for file in files:
        if os.path.lexists(folder / file) and not is_ours(folder / file):
            raise InputError(
                f"{folder / file}: is there and not from wlplan: name another folder, or move it."
            )
    place = folder.absolute()
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise InputError(f"{name}: {place} is a file: name a folder to write to.")
    probe = place / f".wlplan-{secrets.token_hex(6)}.tmp"
    with contextlib.ExitStack() as at_end:
        # Twice: the first may be interrupted, or fail.
        at_end.callback(remove_empty, probe)
        at_end.callback(remove_empty, probe)
        try:
            probe.mkdir()
        except OSError as error:
            reason = one_line(error.strerror or error)
            raise InputError(
                f"{name}: cannot be written ({reason}): choose another folder."
            ) from error
    return folder


def write_files(folder: Path, contents: Mapping[str, str | bytes]) -> None:
    """Write files into a folder, all or none; other files there stay.

    Args:
        folder: Folder, made if it is missing.
        contents: Name of a file -> what it holds; text is written as UTF-8.

    Raises:
        InputError: If a file cannot be written.
        OSError: If the folder cannot.
    """
    from wlplan.io.files import atomic_folder, write_bytes_atomic

    with atomic_folder(folder, existing="add") as temporary:
        for name, content in contents.items():
            data = content.encode() if isinstance(content, str) else content
            write_bytes_atomic(temporary / name, data)


def json_text(document: Mapping[str, Any]) -> str:
    """A result as JSON, without a newline at the end.

    Raises:
        InputError: If a number is not finite, which JSON cannot express.
    """
    try:
        return json.dumps(document, indent=2, allow_nan=False)
    except ValueError as error:
        raise InputError(
            "the result holds numbers that are not finite: check the pile for spikes, or use "
            "another world."
        ) from error


def remark(text: str) -> None:
    """Print on stderr what is worth knowing but no error."""
    if not is_asked("quiet"):
        tell(f"note: {text}")


def titled_table(title: str) -> Any:
    """A table without columns yet, as `rich` has them, in the look of all commands."""
    from rich import box
    from rich.table import Table

    return Table(
        title=shown(title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )


def print_table(table: Any) -> None:
    """Print a table on stdout."""
    from rich.console import Console

    # A file or a pipe has no width of its own: take what the table needs.
    width = None if sys.stdout.isatty() else 140
    # Units stand in square brackets, which would count as markup. On a stream whose reader has gone
    # the library would end the process by itself.
    buffer, terminal = io.StringIO(), sys.stdout.isatty()
    Console(file=buffer, force_terminal=terminal, width=width, highlight=False, markup=False).print(
        table
    )
    sys.stdout.write(buffer.getvalue())


def print_bold(text: str) -> None:
    """Print on stdout what is to be seen first, bold where there is a terminal."""
    print(click.style(shown(text), bold=True) if sys.stdout.isatty() else shown(text))
