"""Rows of a result that are kept as they are made: a run that was cut short goes on."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import wlplan
from experiments._common.places import say
from wlplan.io import write_text_atomic


@functools.cache
def of_package() -> dict[str, str]:
    """What rows hang on that the models that ship have a part in: version and weights."""
    weights = hashlib.sha256()
    folder = Path(str(files("wlplan") / "pretrained"))
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            weights.update(path.relative_to(folder).as_posix().encode())
            weights.update(path.read_bytes())
    return {"wlplan": wlplan.__version__, "weights": weights.hexdigest()[:16]}


class Rows:
    """Rows by name, in a file of one line each.

    Args:
        path: The file; there if some were made before.
        made_with: What the rows hang on beside the package and its weights. Rows that were made
            with anything else are made anew.
    """

    def __init__(self, path: Path, made_with: dict[str, Any]):
        self._path = path
        self._head = json.dumps({**of_package(), **made_with}, sort_keys=True)
        lines = path.read_text().splitlines() if path.is_file() else []
        kept = lines[1:] if lines and lines[0] == self._head else []
        self._rows: dict[str, Any] = dict(json.loads(line) for line in kept)

    def get(self, name: str, make: Callable[[], Any]) -> Any:
        """The row of a name; it is made and written if it is not there."""
        if name not in self._rows:
            self._rows[name] = json.loads(json.dumps(make()))
            self._path.parent.mkdir(parents=True, exist_ok=True)
            lines = [self._head, *(json.dumps(row) for row in self._rows.items())]
            write_text_atomic(self._path, "\n".join(lines) + "\n")
            say(name)
        return self._rows[name]
