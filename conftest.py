"""The code blocks of README and docs/ are tests: `make test-slow` runs them.

Python blocks run, one after the other in one namespace a page, in a folder that holds a scan and
models for them. Blocks called `bash` run too, in that folder, and a block called `output` after one
holds lines that it printed, numbers aside. Blocks called `sh` are not run, for some would take
hours: every `wlplan` command has to parse, every target of make, every extra of pip and every
module of Python has to exist. TOML blocks are read as what their first line calls them, and written
for the blocks after.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import pytest
from sybil import Example, Sybil
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser

ROOT = Path(__file__).parent


def check_shell(example: Example) -> None:
    """Looks at every line of a shell block."""
    text = re.sub(r"\\\n\s*", " ", str(example.parsed))
    # A number stands for variables of a scheduler.
    for line in re.sub(r"\$\w+", "3", text).splitlines():
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
        targets = re.findall(r"^([\w-]+)[\w -]*:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(rest) <= set(targets), f"no such target: {rest}"
    elif program == "pip":
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        extras = re.findall(r"\[([\w,]+)\]", " ".join(rest))
        wanted = {extra for group in extras for extra in group.split(",")}
        assert wanted <= set(project["optional-dependencies"]), f"no such extra: {wanted}"
    elif program == "python":
        assert rest[0] == "-m"
        assert importlib.util.find_spec(rest[1]) is not None, f"no such module: {rest[1]}"
    else:
        raise AssertionError(f"{program}: do not know how to check it; skip the block")


def run_shell(example: Example) -> None:
    """Runs a shell block, with this package as `wlplan`, and remembers what it printed."""
    text = str(example.parsed)
    if re.search(r"^chromium ", text, re.MULTILINE) and shutil.which("chromium") is None:
        pytest.skip("there is no chromium to print with")
    tools = Path("tools").resolve()
    tools.mkdir(exist_ok=True)
    # The sandbox of a browser does not go with a container's root.
    for name, command in {
        "wlplan": f"{shlex.quote(sys.executable)} -m wlplan",
        "chromium": f"{shutil.which('chromium')} --no-sandbox",
    }.items():
        (tools / name).write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        (tools / name).chmod(0o755)
    traces = ROOT / ".pytest_cache" / "traces"
    traces.mkdir(parents=True, exist_ok=True)
    paths = {"PATH": f"{tools}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    # Each command is a process; users keep what was traced, too.
    paths["WLPLAN_TRACES"] = str(traces)
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", text],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=os.environ | paths,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    example.namespace["_printed"] = done.stdout


def without_numbers(line: str) -> str:
    """A line as it is on every machine: last digits differ, and with them plans and widths."""
    return " ".join(re.sub(r"[-+]?\d+([.,]\d+)*", "#", line).split())


def check_output(example: Example) -> None:
    """Refuses a line that the last shell block did not print."""
    printed = {without_numbers(line) for line in example.namespace["_printed"].splitlines()}
    wanted = [without_numbers(line) for line in str(example.parsed).splitlines()]
    missing = [line for line in wanted if line not in printed]
    assert wanted, "an empty block shows nothing"
    assert not missing, f"not printed: {missing}, but {sorted(printed)}"


def check_toml(example: Example) -> None:
    """Reads a TOML block as the machine or the soil that its first line names, and writes it."""
    from wlplan.site.presets import machine_named, soil_named

    text = str(example.parsed)
    tomllib.loads(text)
    if named := re.match(r"# (my-(loader|soil)\.toml)", text):
        Path(named[1]).write_text(text)
        (machine_named if named[2] == "loader" else soil_named)(named[1])


def enter_folder(namespace: dict[str, Any]) -> None:
    """A folder with what the pages speak of: a scan as `scan.tif`, and the models that ship."""
    namespace["_back"], namespace["_folder"] = os.getcwd(), tempfile.mkdtemp()
    os.chdir(namespace["_folder"])
    import rasterio

    import wlplan
    from wlplan.worlds.shipped import pretrained_path

    pile = wlplan.seed_pile("conical", slope=0.5, height=2.0)
    north_up = pile.height.T[::-1]
    west, south = (float(v) - 0.05 for v in pile.origin)
    step = rasterio.Affine(0.1, 0.0, west, 0.0, -0.1, south + 0.1 * len(north_up))
    shape = {"height": north_up.shape[0], "width": north_up.shape[1], "count": 1}
    with rasterio.open(
        "scan.tif", "w", driver="GTiff", dtype="float32", transform=step, **shape
    ) as file:
        file.write(north_up, 1)
    for name, kind in (("my-psi-low", "psi_low"), ("my-psi-high", "psi_high"), ("my-phi", "phi")):
        shutil.copytree(pretrained_path(kind), name)


def leave_folder(namespace: dict[str, Any]) -> None:
    """Back to where the tests run."""
    os.chdir(namespace["_back"])
    shutil.rmtree(namespace["_folder"])


pytest_collect_file = Sybil(
    parsers=[
        PythonCodeBlockParser(),
        CodeBlockParser("sh", check_shell),
        CodeBlockParser("bash", run_shell),
        CodeBlockParser("output", check_output),
        CodeBlockParser("toml", check_toml),
        SkipParser(),
    ],
    filenames=["README.md", "CONTRIBUTING.md", *(path.name for path in ROOT.glob("docs/**/*.md"))],
    setup=enter_folder,
    teardown=leave_folder,
).pytest()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Documents are slow: they compile worlds."""
    for item in items:
        if item.path.suffix == ".md":
            item.add_marker(pytest.mark.slow)
