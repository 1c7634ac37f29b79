"""What a command tells while it works."""

import io
import sys
import time

import click
import pytest
from click.testing import CliRunner

from wlplan.cli import progress as telling
from wlplan.cli.outputs import remark
from wlplan.cli.verbosity import quiet_or_verbose


@click.command()
@quiet_or_verbose
def command() -> None:
    """Tells a note and some progress."""
    with telling.Progress() as progress:
        progress.phase("reading")
        progress("loads", 1, 2, 3.0)
        progress.phase("planning")
    remark("it is steep")


def test_quiet_tells_nothing_and_verbose_how_long_it_took() -> None:
    said = CliRunner().invoke(command, []).stderr
    assert said == "loads 1/2, cost 3.000\nnote: it is steep\n"
    assert CliRunner().invoke(command, ["-q"]).stderr == ""
    assert "reading: 0.0 s\n" in CliRunner().invoke(command, ["--verbose"]).stderr
    both = CliRunner().invoke(command, ["-q", "-v"])
    assert both.exit_code == 2
    assert "-q and -v" in both.stderr


def test_a_line_now_and_then_where_there_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(telling, "_PAUSE", 0.02)
    told = ""
    with telling.Progress() as progress:
        progress.phase("reading scan.laz")
        while told.count("\n") < 3:
            time.sleep(0.01)
            told += capsys.readouterr().err
    assert set(told.splitlines()) == {"reading scan.laz, 0 s"}


def test_what_was_compiled_is_told_beside_the_last_time(monkeypatch: pytest.MonkeyPatch) -> None:
    spans: list[tuple[float, float]] = [(0.0, 5.0)]
    monkeypatch.setattr(telling, "_compilations", spans)
    progress = telling.Progress(seconds=47.2)
    with progress:
        progress.phase("planning")
        assert progress.now() == "planning, 0 s"
        # One inside of the other.
        spans += [(10.0, 22.0), (12.0, 20.0)]
        assert progress.now() == "planning, 0 s; compiled for 12 s (47 s the last time)"


def test_a_terminal_shows_it_all_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with telling.Progress() as progress:
        progress.phase("reading scan.laz")
        progress("loads", 1, 2, 3.0)
        while "1/2" not in stream.getvalue():
            time.sleep(0.01)
    assert "reading scan.laz, 0 s" in stream.getvalue()
    assert "cost 3.000" in stream.getvalue()
