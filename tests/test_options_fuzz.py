"""Whatever words a command is given: it goes on to its work, or ends with one line and exit code 2.

The heavy part of each command is a stand-in, so that only parsing and checks run.
"""

from __future__ import annotations

import json
import types
from pathlib import Path
from typing import Any

import click
import hypothesis.strategies as st
import pytest
from examples import examples
from hypothesis import given, settings
from make_corpus import PLAN

from wlplan import cli


class ReachedError(BaseException):
    """All words were taken: here the work of the command would begin."""


def _reached(*_: object, **__: object) -> Any:
    raise ReachedError


# Where the work of the commands begins. `plan` looks at its amount after it has read the pile.
HEAVY = (
    *(f"wlplan.cli.{name}.pile_named" for name in ("planning", "maps", "gradients", "exporting")),
    *("wlplan.report.making.make_plan", "wlplan.io.summary.info", "wlplan.studies.bench.run_bench"),
    *("wlplan.dataset.collect", "wlplan.dataset.merge", "wlplan.dataset.open_dataset"),
    *("wlplan.training.train_all", "wlplan.cli.serving._library"),
)

# What is a value, is almost one, or is none.
NUMBERS = ("0", "1", "-1", "7", "0.5", "1e3", "-0.0", "1e400", "nan", "inf", "-inf", "9" * 30)
TEXTS = (
    *("", " ", "\t", "\n", "-", "--", "=", ",", ",,", "a,b", "1,2", "1,2,3", "1;2", "1/2", "0/0"),
    *(
        "12,-3,30",
        "0.68,4.51,0.17,4.46",
        "1,nan",
        "x" * 5000,
        "\u0661",
        "\u202ea",
        "\ud800",
        "\x1b[2J",
    ),
    *("../x", "/", "/dev/null", "/proc/self/mem", "~", "a" * 300 + ".tif", "a.zarr", "CON", "*"),
    *("bundled", "gravel", "sand@40", "sand@x", "wa320", "hybrid", "greedy", "auto", "each"),
    *("no.module:Name", "math:pi", "time,mass", "elevation", "%s%n", "{0}", "$HOME", "'", '"'),
    *("plan.json", "scan.npz", "folder", "file", "folder/deeper", "file/below"),
)


def values(kind: click.ParamType[Any]) -> st.SearchStrategy[str]:
    """Texts for a parameter of a kind, most of them no value of it."""
    text = st.text(st.characters(exclude_characters="\0"), max_size=20)
    # What begins with a stroke is another option to the parser, so those are mixed in too.
    some = [st.sampled_from(NUMBERS), st.sampled_from(TEXTS), text]
    if isinstance(kind, click.Choice):
        some = [st.sampled_from([str(choice) for choice in kind.choices]), *some]
    if isinstance(kind, click.IntRange | click.FloatRange):
        ends = [end for end in (kind.min, kind.max) if end is not None]
        near = [str(end + step) for end in ends for step in (-1, 0, 1)]
        some = [st.sampled_from(near or ["3"]), st.integers().map(str), st.floats().map(str), *some]
    return st.one_of(some)


@st.composite
def words(draw: st.DrawFn, command: click.Command) -> list[str]:
    """Words for a command: its arguments and some of its options, with all sorts of values."""
    found: list[str] = []
    for parameter in command.params:
        if isinstance(parameter, click.Argument):
            most = 3 if parameter.nargs < 0 else 1
            found += draw(
                st.lists(values(parameter.type), min_size=parameter.required, max_size=most)
            )
    options = [one for one in command.params if isinstance(one, click.Option)]
    needed = [one for one in options if one.required and draw(st.booleans())]
    for option in needed + draw(st.lists(st.sampled_from(options), max_size=4)):
        name = draw(st.sampled_from([*option.opts, *option.secondary_opts]))
        found += [name] if option.is_flag or option.count else [name, draw(values(option.type))]
    return found


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where commands run: with a plan, a file and a folder; the work is stood in for."""
    (tmp_path / "plan.json").write_text(json.dumps(PLAN))
    (tmp_path / "scan.npz").write_bytes(b"x")
    (tmp_path / "file").write_text("theirs")
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WLPLAN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cli.programs, "use_cache", lambda: None)
    monkeypatch.setattr(cli.programs, "compile_fast", lambda: None)
    for name in HEAVY:
        monkeypatch.setattr(name, _reached)
    monkeypatch.setattr("wlplan.cli.planning.pile_named", lambda *_: types.SimpleNamespace())
    monkeypatch.setattr("wlplan.cli.planning.world_named", lambda *_: None)
    monkeypatch.setattr("wlplan.cli.planning.site_recorded", _reached)  # `simulate` reads the pile
    return tmp_path


def run(given: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """How a command ends: "reached", "done", or the line that it was refused with."""
    capsys.readouterr()
    try:
        code = cli.main(given)
    except ReachedError:
        return "reached"
    out, err = capsys.readouterr()
    assert code in (0, 2), err
    if code == 0:
        return "done"
    assert out == ""
    *notes, line = err.splitlines()
    assert line.startswith("error: "), err
    assert all(note.startswith("note: ") for note in notes), err
    assert "\x1b" not in err
    assert len(line) < 700
    return line


@pytest.mark.parametrize("name", list(cli.wlplan.commands))
def test_any_words_are_taken_or_refused_in_one_line(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert search(name, capsys, 40) >= 2
    # Nothing is left of what was refused.
    found = {path.name for path in folder.iterdir()}
    assert found - {"cache"} == {"plan.json", "scan.npz", "file", "folder"}
    assert (folder / "file").read_text() == "theirs"


def search(name: str, capsys: pytest.CaptureFixture[str], few: int) -> int:
    """Gives a command so many sets of words; returns how many different ends there were."""
    ends = set()

    @settings(max_examples=examples(few))
    @given(given=words(cli.wlplan.commands[name]))
    def each(given: list[str]) -> None:
        ends.add(run([name, *given], capsys))

    each()
    return len(ends)


def test_words_that_are_right_reach_the_work(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for line in (
        "plan --loads 2 --truck 1,2,3",
        "simulate bundled plan.json",
        "diggability --locations 3",
        "collect --cycles 10 --out d.zarr",
        "export world --out x",
        "gradcheck --loads 1",
        "bench",
        "info",
        "serve",
    ):
        assert run(line.split(), capsys) == "reached", line
    assert run(["plan", "--loads", "none"], capsys).startswith("error: ")
