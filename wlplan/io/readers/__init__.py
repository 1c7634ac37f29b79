"""Readers of pile files: one module for each format, found by what it says of itself.

A reader is anything, a module as a rule, that has

* `ENDINGS`: the endings of the files that it reads, in lower case, such as `(".las", ".laz")`;
* `read(path)`: what such a file holds, a `Heightmap` or a `PointCloud` of `wlplan.io`. It raises
  `wlplan.InputError` for what the user can mend, without the name of the file and in one line.
  Whatever else it raises is taken for damage of the file.
* if it likes, `OPTIONS`: names of keyword arguments that its `read` takes too, such as `("band",)`.

A module in this folder is a reader of the package; nothing else names it. It imports only numpy and
light modules of the package at its top, and the library of its format inside `read`, since the
command line asks for the endings before it imports anything heavy. Readers elsewhere come in by
`register_reader`, or as entry points of the group `wlplan.readers` of an installed package, each
named after its ending without the dot::

    [project.entry-points."wlplan.readers"]
    pts = "their_package.pts"

Nobody else can register the endings of the package's own readers.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from importlib import metadata
from pathlib import Path
from typing import Protocol, runtime_checkable

from wlplan.errors import InputError, one_line
from wlplan.io.scans import Scan

ENTRY_POINTS = "wlplan.readers"
"""The group of the entry points that are readers."""


@runtime_checkable
class Reader(Protocol):
    """What reads one format; the module says more."""

    @property
    def ENDINGS(self) -> tuple[str, ...]:  # noqa: N802
        """Endings of its files, in lower case."""
        ...

    def read(self, path: Path, /) -> Scan:
        """What a file holds, not yet checked."""
        ...


_registered: dict[str, Reader] = {}


def register_reader(reader: Reader) -> None:
    """Let `read_pile` read one more format, in this process.

    Args:
        reader: Module or object with `ENDINGS` and `read`. Registering it again changes nothing.

    Raises:
        InputError: If it lacks one of them, an ending is not like `.pts`, or another reader has it.
    """
    _add(reader, _registered, _own() | _registered)


def known_endings() -> tuple[str, ...]:
    """Endings of all pile files that can be read, in alphabetical order; loads no entry point."""
    return tuple(sorted({*_own(), *_registered, *_installed()}))


def find_reader(path: Path) -> Reader:
    """The reader of a file, by the ending of its name; whether there is such a file plays no role.

    Raises:
        InputError: If the ending is unknown, or its reader is an entry point that does not load.
    """
    ending = path.suffix.lower()
    known = _own() | _registered
    if ending in known:
        return known[ending]
    places = _installed().get(ending)
    if not places:
        raise InputError(
            f"{path}: unknown kind of pile file {path.suffix!r}: use one of "
            f"{', '.join(known_endings())}."
        )
    if len(places) > 1:
        raise InputError(
            f"{path}: {' and '.join(sorted(places))} both read {ending}: uninstall one of them."
        )
    ((place, point),) = places.items()
    try:
        reader: Reader = point.load()
        _check(reader)
    except Exception as error:
        # It is the code of others: importing it may raise anything.
        raise InputError(
            f"{path}: {place}, which reads {ending}, cannot be used ({one_line(error)}): install "
            f"its package again, or uninstall it."
        ) from error
    return reader


@functools.cache
def _own() -> dict[str, Reader]:
    """Ending -> module in this folder."""
    found: dict[str, Reader] = {}
    for module in pkgutil.iter_modules(__path__, f"{__name__}."):
        _add(importlib.import_module(module.name), found, found)
    return found


def _installed() -> dict[str, dict[str, metadata.EntryPoint]]:
    """Ending -> place of the reader -> its entry point, of other packages; none is loaded."""
    found: dict[str, dict[str, metadata.EntryPoint]] = {}
    for point in metadata.entry_points(group=ENTRY_POINTS):
        # A package may be listed twice, as it is after an editable install.
        found.setdefault(f".{point.name.lower()}", {})[point.value] = point
    return found


def _add(reader: Reader, readers: dict[str, Reader], taken: dict[str, Reader]) -> None:
    """Enter a reader under its endings, all of them or none."""
    _check(reader)
    for ending in reader.ENDINGS:
        other = taken.get(ending, reader)
        if other is not reader:
            raise InputError(
                f"{_name(reader)} reads {ending}, as {_name(other)} does already: choose another "
                f"ending."
            )
    readers.update(dict.fromkeys(reader.ENDINGS, reader))


def _check(reader: object) -> None:
    """Refuse what is no reader."""
    if not isinstance(reader, Reader) or not callable(reader.read):
        raise InputError(f"{_name(reader)} is no reader: it needs `ENDINGS` and `read(path)`.")
    endings = reader.ENDINGS
    # A single text would count as many endings of one letter.
    if isinstance(endings, str) or not endings or not all(map(_is_ending, endings)):
        raise InputError(
            f"{_name(reader)} has `ENDINGS` {endings!r}: give a tuple of endings in lower case, "
            f'such as (".pts",).'
        )


def _is_ending(text: object) -> bool:
    return isinstance(text, str) and text == text.lower() == Path(f"name{text}").suffix != ""


def _name(reader: object) -> str:
    return getattr(reader, "__name__", type(reader).__name__)
