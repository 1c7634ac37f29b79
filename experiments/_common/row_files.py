"""Rows of a result, a file each: a run that was cut short goes on, and processes share the work."""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import filelock

from wlplan.io import write_text_atomic


class RowFiles:
    """Rows by name, in a folder.

    Any number of processes may make rows of one folder, also on several machines if its file system
    knows locks: none makes a row that another one has made or is making.

    Args:
        folder: The folder; made with the first row.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def read(self, name: str, made_with: dict[str, Any]) -> dict[str, Any] | None:
        """A row that is there.

        Args:
            name: Its name.
            made_with: What it hangs on; a row that was made with anything else counts as none.
        """
        path = self.folder / f"{name}.json"
        row: dict[str, Any] | None = json.loads(path.read_text()) if path.is_file() else None
        return row if row is not None and row["made_with"] == made_with else None

    def get(
        self, name: str, made_with: dict[str, Any], make: Callable[[], dict[str, Any]]
    ) -> dict[str, Any] | None:
        """A row; it is made and written if it is not there.

        Args:
            name: Its name.
            made_with: What it hangs on, as JSON has it.
            make: Makes it.

        Returns:
            The row; None if another process is making it.
        """
        if (row := self.read(name, made_with)) is not None:
            return row
        try:
            with self.alone(name, wait=False):
                # Another process may have made it between the two.
                if (row := self.read(name, made_with)) is not None:
                    return row
                text = json.dumps({**make(), "made_with": made_with}, allow_nan=False)
                write_text_atomic(self.folder / f"{name}.json", text + "\n")
                made: dict[str, Any] = json.loads(text)
                return made
        except filelock.Timeout:
            return None

    def lay(self, rows: Mapping[str, dict[str, Any]]) -> None:
        """Adds rows that were made elsewhere, by name; those that are there stay as they are."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, row in rows.items():
            path = self.folder / f"{name}.json"
            if not path.exists():
                write_text_atomic(path, json.dumps(row) + "\n")

    @contextlib.contextmanager
    def alone(self, name: str, *, wait: bool = True) -> Iterator[None]:
        """While the block runs, no other process is in one of this folder and name.

        Args:
            name: Of what is done.
            wait: Whether to wait until no other is.

        Raises:
            filelock.Timeout: If another is, and it is not waited for.
        """
        locks = self.folder / ".locks"
        locks.mkdir(parents=True, exist_ok=True)
        # The system takes it from a process that dies.
        with filelock.FileLock(locks / name, timeout=-1 if wait else 0):
            yield

    def all(self) -> list[dict[str, Any]]:
        """All rows that are there, whatever they were made with."""
        return [json.loads(path.read_text()) for path in sorted(self.folder.glob("*.json"))]


class Named(Protocol):
    """What makes a row."""

    @property
    def name(self) -> str:
        """As file names have it."""


Item = TypeVar("Item")
AnyNamed = TypeVar("AnyNamed", bound=Named)


def add_row_options(parser: argparse.ArgumentParser, rows: Path) -> None:
    """Adds the options of an experiment whose rows are files of their own.

    Args:
        parser: Parser of its command line.
        rows: Where the rows of the full preset are.
    """
    parser.add_argument(
        "--rows", type=Path, help=f"folder of the rows (default {rows}, for smoke a new one)"
    )
    parser.add_argument(
        "--shard", type=_shard, default=(1, 1), help="make the I-th of N parts of the rows: I/N"
    )
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="begin no row after so long"
    )
    parser.add_argument("--join", action="store_true", help="only join the rows that are there")
    parser.add_argument(
        "--only",
        action="append",
        metavar="PATTERN",
        help="only rows whose name matches, as file names do in a shell; more of it: in this order",
    )


def matching(every: Sequence[AnyNamed], patterns: Sequence[str] | None) -> list[AnyNamed]:
    """What makes the rows whose names match, those of the first pattern first.

    Args:
        every: What makes all rows.
        patterns: As file names have them in a shell; None: every name matches.
    """
    return [
        one
        for pattern in patterns or ["*"]
        for one in every
        if fnmatch.fnmatchcase(one.name, pattern)
    ]


def part_of(items: Sequence[Item], shard: tuple[int, int]) -> list[Item]:
    """Every N-th item, from the I-th on.

    Args:
        items: In order.
        shard: I, counted from 1, and N.
    """
    return list(items[shard[0] - 1 :: shard[1]])


def time_is_up(options: argparse.Namespace) -> Callable[[], bool]:
    """Whether, since this call, the minutes are over after which no row is begun."""
    until = time.monotonic() + 60.0 * options.minutes
    return lambda: time.monotonic() > until


def _shard(text: str) -> tuple[int, int]:
    """I and N of I/N."""
    try:
        number, count = (int(word) for word in text.split("/"))
        if not 1 <= number <= count:
            raise ValueError
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no part: give one of 1/8 to 8/8") from error
    return number, count
