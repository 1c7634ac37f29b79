"""Which experiments there are, read from their files: none is imported, nor is JAX."""

from __future__ import annotations

import ast
import dataclasses
import json
import re
from pathlib import Path

from experiments._common.places import RESULTS

_FOLDER = Path(__file__).parents[1]
# "Paper, table 2 and figures 11 and 12: ..." in the docstring of a module.
_SHOWS = re.compile(r"Paper, ((?:(?:table|figure)s? [\d, and]*\d(?: and )?)+)")


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A file with `run` and `draw`.

    Attributes:
        name: Of its module.
        about: First line of its docstring.
        paper: Which tables and figures of the paper it shows; empty if none.
        engine: Presets that need the engine of discrete elements.
    """

    name: str
    about: str
    paper: str
    engine: tuple[str, ...]

    def has_result(self, folder: Path = RESULTS) -> bool:
        """Whether its result lies in a folder; by default, whether it is committed."""
        return (folder / f"{self.name}.json").is_file()

    def seconds(self, folder: Path = RESULTS) -> float | None:
        """How long the run took that made a result; None if that is not known."""
        if not self.has_result(folder):
            return None
        said = json.loads((folder / f"{self.name}.json").read_text())
        seconds: float | None = said.get("conditions", {}).get("run_seconds")
        return seconds


def experiments() -> list[Experiment]:
    """All of them, by name."""
    found = (_read(path) for path in _files())
    return [one for one in found if one is not None]


def recipes() -> list[str]:
    """Names of files that collect data for the others: they have a command line and no result."""
    read = {path.stem: _functions(ast.parse(path.read_text("utf-8"))) for path in _files()}
    return [
        name for name, functions in read.items() if "main" in functions and "run" not in functions
    ]


def _files() -> list[Path]:
    return sorted(_FOLDER.glob("[!_]*.py"))


def _functions(module: ast.Module) -> set[str]:
    return {node.name for node in module.body if isinstance(node, ast.FunctionDef)}


def _read(path: Path) -> Experiment | None:
    """The experiment in a file; None if it is none."""
    module = ast.parse(path.read_text(encoding="utf-8"))
    if not {"run", "draw"} <= _functions(module):
        return None
    words = ast.get_docstring(module) or ""
    shows = _SHOWS.search(" ".join(words.split()))
    # "table 1 and section 6" shows the table.
    paper = shows[1].strip().removesuffix(" and") if shows else ""
    return Experiment(path.stem, words.partition("\n")[0], paper, _constant(module, "ENGINE"))


def _constant(module: ast.Module, name: str) -> tuple[str, ...]:
    """A constant of a module that is a tuple of words; empty if it has none of that name."""
    for node in module.body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == name for target in node.targets
        ):
            return tuple(ast.literal_eval(node.value))
    return ()


def table(found: list[Experiment]) -> str:
    """The experiments in lines: name, what of the paper, how long a full run took, what it is."""
    rows = [("name", "paper", "result", "took", "what it shows")]
    for one in found:
        seconds = one.seconds()
        rows.append(
            (
                one.name,
                one.paper or "-",
                "yes" if one.has_result() else "no",
                "-" if seconds is None else duration(seconds),
                one.about,
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def duration(seconds: float) -> str:
    """A time for people: 42 s, 12 min, 2.5 h."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5940.0 else f"{seconds / 3600.0:.1f} h"
