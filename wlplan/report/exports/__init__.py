"""A plan in the files of other tools, in the coordinates of the scan.

One file here for each kind, with `NAME`, the file that it makes, `LIBRARY`, what it needs beside
what is always there, and `content(document, pile)`. They are imported when they are asked for.
"""

from __future__ import annotations

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


def exported(kinds: Sequence[str], document: Mapping[str, Any], after: Pile) -> dict[str, bytes]:
    """Contents of files by name.

    Args:
        kinds: Of `KINDS`.
        document: Content of a plan.json.
        after: The pile that the plan leaves, in the frame of the document.
    """
    modules = [_module(kind) for kind in dict.fromkeys(kinds)]
    return {module.NAME: module.content(document, after) for module in modules}


def _module(kind: str) -> Any:
    return importlib.import_module(f"{__name__}.{kind}")
