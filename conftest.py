"""The code blocks of README and docs/ are tests: `make test-slow` runs them.

Python blocks run, one after the other in one namespace a page. Shell blocks are not run, for some
would take hours: every `wlplan` command has to parse, every target of make and every extra of pip
has to exist. TOML blocks are read as what their first line calls them.
"""

from __future__ import annotations

import re
import shlex
import tempfile
import tomllib
from pathlib import Path

import pytest
from sybil import Example, Sybil
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser

ROOT = Path(__file__).parent


def check_shell(example: Example) -> None:
    """Looks at every line of a shell block."""
    text = re.sub(r"\\\n\s*", " ", str(example.parsed))
    for line in text.splitlines():
        words = shlex.split(line, comments=True)
        if words:
            check_command(words)


def check_command(words: list[str]) -> None:
    """Refuses a command that does not exist as it is written."""
    program, rest = Path(words[0]).name, words[1:]
    if program == "wlplan":
        from wlplan import cli

        with cli.wlplan.make_context("wlplan", [*rest]) as context:
            name, command, arguments = cli.wlplan.resolve_command(context, rest)
            assert command is not None
            command.make_context(name, arguments, parent=context)
    elif program == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(rest) <= set(targets), f"no such target: {rest}"
    elif program == "pip":
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        extras = re.findall(r"\[([\w,]+)\]", " ".join(rest))
        wanted = {extra for group in extras for extra in group.split(",")}
        assert wanted <= set(project["optional-dependencies"]), f"no such extra: {wanted}"
    else:
        raise AssertionError(f"{program}: do not know how to check it; skip the block")


def check_toml(example: Example) -> None:
    """Reads a TOML block as the machine or the soil that its first line names."""
    from wlplan.site.presets import machine_named, soil_named

    text = str(example.parsed)
    tomllib.loads(text)
    named = re.match(r"# my-(loader|soil)\.toml", text)
    if named:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "given.toml"
            path.write_text(text)
            (machine_named if named[1] == "loader" else soil_named)(path)


pytest_collect_file = Sybil(
    parsers=[
        PythonCodeBlockParser(),
        CodeBlockParser("sh", check_shell),
        CodeBlockParser("toml", check_toml),
        SkipParser(),
    ],
    filenames=["README.md", "CONTRIBUTING.md", *(path.name for path in ROOT.glob("docs/*.md"))],
).pytest()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Documents are slow: they compile worlds."""
    for item in items:
        if item.path.suffix == ".md":
            item.add_marker(pytest.mark.slow)
