"""Rows of a result that are kept as they are made: a run that was cut short goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments._common.places import say
from wlplan.io import write_text_atomic


class Rows:
    """Rows by name, in a file of one line each.

    Args:
        path: The file; there if some were made before.
        made_with: What the rows hang on. Rows that were made with anything else are made anew.
    """

    def __init__(self, path: Path, made_with: dict[str, Any]):
        self._path, self._head = path, json.dumps(made_with, sort_keys=True)
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
