"""What the command line prints: whatever names hold, and whoever has closed a stream."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scene

from wlplan import cli
from wlplan.cli import outputs
from wlplan.cli.said import say, tell
from wlplan.errors import shown

# Clears a terminal and sets its title; writes from right to left; is no character; a new line.
EVIL = "a\x1b[2J\x1b]0;title\x07\u202e\udc80\nerror: none"
ESCAPED = r"a\x1b[2J\x1b]0;title\x07\u202e\udc80\nerror: none"


def test_what_is_no_visible_character_is_escaped() -> None:
    assert shown(EVIL) == ESCAPED
    for plain in ("scan.npz", "Höhe 5 m³ \u00a0–\u202f°", "掘削.tif", ""):
        assert shown(plain) == plain


@pytest.fixture
def pile(tmp_path: Path) -> Path:
    path = tmp_path / f"{EVIL.replace('/', '')}.npz"
    np.savez(path, height=scene.grid(0.4), cell_size=0.4)
    return path


@pytest.mark.parametrize("words", [["info"], ["info", "--json"], ["info", "--up", "y"]])
def test_the_name_of_a_file_steers_no_terminal(
    pile: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code = cli.main([*words, str(pile)])
    out, err = capsys.readouterr()
    assert code == (2 if "--up" in words else 0)
    assert "--json" in words or "title" in out + err
    assert not set("\x1b\x07\u202e\udc80") & set(out + err)


def test_a_name_in_a_complaint_about_usage_is_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plan", "--loads", EVIL]) == 2
    _, err = capsys.readouterr()
    assert r"\x1b[2J" in err
    assert "\x1b" not in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_nothing(pile: Path, tmp_path: Path, closed: str) -> None:
    (tmp_path / "a.npz").write_bytes(pile.read_bytes())
    for name, code in (("a.npz", 0), ("none.npz", 2)):
        done = subprocess.run(
            ["sh", "-c", f'"{sys.executable}" -m wlplan info {name} {closed}'],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code
        assert "Traceback" not in done.stderr
        assert "should not happen" not in done.stderr
    assert (tmp_path / "a.npz").read_bytes() == pile.read_bytes()


class Gone:
    """A stream that nobody reads any more."""

    encoding = "utf-8"

    def write(self, _: str) -> None:
        """Fails."""
        raise BrokenPipeError

    def flush(self) -> None:
        """Fails."""
        raise BrokenPipeError

    def isatty(self) -> bool:
        """No terminal."""
        return False


def test_notes_that_nobody_reads_end_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Gone())
    tell("note")
    monkeypatch.setattr(sys, "stdout", Gone())
    with pytest.raises(BrokenPipeError):
        say("a line")
    # Not an end of the process, as the library has it.
    table = outputs.titled_table("title")
    table.add_column("a")
    table.add_row("b")
    with pytest.raises(BrokenPipeError):
        outputs.print_table(table)


@pytest.mark.parametrize("reader", ["head -n 1", "true"])
def test_a_reader_that_goes_early_is_no_error(pile: Path, tmp_path: Path, reader: str) -> None:
    (tmp_path / "a.npz").write_bytes(pile.read_bytes())
    words = f'("{sys.executable}" -m wlplan info a.npz; echo $? >code) | {reader}'
    done = subprocess.run(
        ["sh", "-c", words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    assert (tmp_path / "code").read_text() == "0\n"


@pytest.mark.parametrize(
    "words",
    [
        ["gradcheck", "--step", "nan"],
        ["gradcheck", "--tolerance", "nan"],
        ["train", "psi-low", "--data", "x", "--out", "y", "--dropout", "nan"],
        ["plan", "--tonnes", "nan"],
        ["plan", "--crop", "0,0,1,inf"],
        ["plan", "--truck", "nan,0"],
        ["plan", "--ground", "-inf"],
    ],
)
def test_options_are_finite(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 2
    assert "finite" in capsys.readouterr().err
