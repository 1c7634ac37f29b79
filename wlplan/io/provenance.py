"""Where a result comes from: the command that made it, and the versions it was made with."""

from __future__ import annotations

import importlib.metadata
import shlex
import sys
from pathlib import Path


def command() -> str:
    """The words that this process was started with."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    # Run by `python -m`, a module has a name, and a package is named by its `__main__`.
    module = [] if spec is None else ["python", "-m", spec.name.removesuffix(".__main__")]
    return shlex.join([*(module or [Path(sys.argv[0]).name]), *sys.argv[1:]])


def versions() -> dict[str, str]:
    """Versions of the packages that decide the numbers."""
    return {name: importlib.metadata.version(name) for name in ("wlplan", "jax", "numpy")}
