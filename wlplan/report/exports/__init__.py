"""A plan in the files of other tools, in the coordinates of the scan.

One file here for each kind, with `NAME`, the file that it makes, `LIBRARY`, what it needs beside
what is always there, and `content(played)`. They are imported when they are asked for.
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from wlplan.errors import InputError
from wlplan.io.libraries import library

if TYPE_CHECKING:
    from wlplan.types import Pile

KINDS = tuple(
    module.name for module in pkgutil.iter_modules(__path__) if not module.name.startswith("_")
)
"""What there is, by the name of its module."""


def check(kinds: Sequence[str]) -> None:
    """Finds out whether all is there that kinds need, before anything long is begun.

    Raises:
        InputError: If a library is missing.
    """
    for kind in kinds:
        if name := _module(kind).LIBRARY:
            try:
                with library(name, install="wlplan[scan]"):
                    pass
            except InputError as error:
                raise InputError(f"{kind}: {error}") from error


def names(kinds: Sequence[str]) -> list[str]:
    """Names of the files that kinds make."""
    return [_module(kind).NAME for kind in kinds]


@dataclasses.dataclass(frozen=True)
class Played:
    """A plan that was played.

    Attributes:
        document: Content of its plan.json.
        before: The pile before the first load, in the frame of the document.
        heights: As each load leaves them, [n, nx, ny] in metres.
    """

    document: Mapping[str, Any]
    before: Pile
    heights: Any

    @property
    def after(self) -> Pile:
        """The pile that is left."""
        left: Pile = self.before.replace(height=self.heights[-1])
        return left


def exported(kinds: Sequence[str], played: Played) -> dict[str, bytes]:
    """Contents of files by name.

    Args:
        kinds: Of `KINDS`.
        played: What they are to show.
    """
    modules = [_module(kind) for kind in dict.fromkeys(kinds)]
    return {module.NAME: module.content(played) for module in modules}


def file_names() -> tuple[str, ...]:
    """Names of the files of all kinds whose libraries are installed."""
    return tuple(_module(kind).NAME for kind in KINDS if _is_there(kind))


def kind_of(name: str) -> str | None:
    """The kind that makes a file of a name; None if none does."""
    return next((kind for kind in KINDS if name == _module(kind).NAME), None)


def _is_there(kind: str) -> bool:
    try:
        check((kind,))
    except InputError:
        return False
    return True


def _module(kind: str) -> Any:
    return importlib.import_module(f"{__name__}.{kind}")
