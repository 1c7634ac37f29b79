"""Functions as files that run without wlplan: for controllers in C++, and for Python without it.

`functions/` has one file for each function that can be exported, `formats/` one for each kind of
file; `export` writes, reads back and compares. This module is free of JAX, so that help comes at
once.
"""

from __future__ import annotations

import pkgutil
from pathlib import Path


def _modules(folder: str) -> tuple[str, ...]:
    """Names of the modules in a folder beside this file."""
    found = pkgutil.iter_modules([str(Path(__file__).parent / folder)])
    return tuple(module.name for module in found if not module.name.startswith("_"))


FUNCTIONS = tuple(name.replace("_", "-") for name in _modules("functions"))
"""What can be exported, by the name of its module."""

FORMATS = _modules("formats")
"""Kinds of files, by the name of their module."""

TOLERANCE = 1e-4
"""How far an output may be off, in parts of the largest value of that output."""
