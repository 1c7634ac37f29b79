"""The experiments as a tool: the list, where results go, and a run of all that goes on."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import __main__ as command
from experiments._common import catalogue, everything, places
from experiments._common import results as record
from experiments._common.catalogue import Experiment
from wlplan.io import write_bytes_atomic

ROOT = Path(__file__).parents[1]
# --- the list


def test_the_list_has_all_and_takes_no_jax() -> None:
    code = (
        "import sys; from experiments.__main__ import main; main([]); "
        "sys.exit(int('jax' in sys.modules))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.splitlines()
    names = {path.stem for path in (ROOT / "experiments").glob("[!_]*.py")}
    assert {line.split()[0] for line in told[1:-2]} | {"dem_cycles"} == names
    assert told[-1].endswith(": dem_cycles")
    assert told[0].split()[:3] == ["name", "paper", "result"]


def test_what_an_experiment_shows_is_what_the_map_of_the_paper_says() -> None:
    """Each item of an experiment has a row that is of that item and names the experiment."""
    cells = [
        line.split(" | ", 1)
        for line in (ROOT / "docs" / "paper-map.md").read_text().splitlines()
        if line.startswith("| ")
    ]
    shown = {one.name: re.findall(r"\d+", one.paper) for one in catalogue.experiments()}
    assert len([name for name, items in shown.items() if items]) > 10
    for name, items in shown.items():
        for item in items:
            of_it = [rest for first, rest in cells if item in re.findall(r"\d+", first)]
            assert any(re.search(rf"experiments\.{name}\b", rest) for rest in of_it), (name, item)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("Paper, figures 9 and 10: errors", "figures 9 and 10"),
        ("Paper, table 3 and figure 14, here over ten piles", "table 3 and figure 14"),
        ("Paper, figures 5, 11 and 12.", "figures 5, 11 and 12"),
        ("Figure 3 of something else", ""),
    ],
)
def test_items_of_the_paper_are_read_from_docstrings(words: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "one.py"
    path.write_text(
        f'"""A title.\n\n{words}\n"""\nENGINE = ("full",)\ndef run(): ...\ndef draw(): ...\n'
    )
    one = catalogue._read(path)
    assert one == Experiment("one", "A title.", said, ("full",))
    path.write_text('"""A recipe."""\ndef run(): ...\n')
    assert catalogue._read(path) is None


def test_a_name_that_is_none_is_said_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["seed_pile"]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert told == ["error: There is no experiment 'seed_pile': did you mean seed_piles?"]


@pytest.mark.parametrize(
    ("seconds", "said"), [(0.4, "0 s"), (99.4, "99 s"), (99.6, "2 min"), (9000.0, "2.5 h")]
)
def test_durations_are_read_easily(seconds: float, said: str) -> None:
    assert catalogue.duration(seconds) == said


# --- where results go


def run(preset: str) -> dict[str, float]:
    return {"value": 1.0}


def draw(folder: Path) -> None:
    value = json.loads((folder / "some.json").read_text())["value"]
    write_bytes_atomic(folder / "some.png", f"{value}".encode())


@pytest.fixture
def committed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of the committed results, with one; the working directory is beside it."""
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "some.json").write_text('{"value": 7.0}')
    monkeypatch.setattr(places, "RESULTS", folder)
    monkeypatch.setattr(record, "RESULTS", folder)
    monkeypatch.chdir(tmp_path)
    return folder


def called(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["some", *words])
    record.main("some", run, draw)


def test_a_run_leaves_the_committed_results_alone_unless_they_are_meant(
    committed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path.name: path.read_bytes() for path in committed.iterdir()}
    called(monkeypatch)
    called(monkeypatch, "--preset", "smoke")
    assert {path.name: path.read_bytes() for path in committed.iterdir()} == before
    for preset in ("full", "smoke"):
        folder = Path("out") / "experiments" / preset
        assert json.loads((folder / "some.json").read_text())["conditions"]["run_seconds"] >= 0.0
        assert (folder / "some.png").read_text() == "1.0"
    told = capsys.readouterr().err
    assert "out/experiments/full" in told
    called(monkeypatch, "--update")
    assert json.loads((committed / "some.json").read_text())["value"] == 1.0
    assert (committed / "some.png").read_text() == "1.0"


def test_how_long_a_run_took_is_not_known_where_it_went_on(
    committed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def with_rows(preset: str, rows: Path) -> dict[str, float]:
        rows.parent.mkdir(parents=True, exist_ok=True)
        rows.write_text("made before\n")
        return run(preset)

    known = []
    for _ in range(2):
        monkeypatch.setattr(sys, "argv", ["some"])
        record.main("some", with_rows, draw)
        written = Path("out") / "experiments" / "full" / "some.json"
        known.append("run_seconds" in json.loads(written.read_text())["conditions"])
    assert known == [True, False]


def test_a_short_run_never_replaces_what_is_committed(
    committed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        called(monkeypatch, "--preset", "smoke", "--update")
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert (committed / "some.json").read_text() == '{"value": 7.0}'


def test_drawing_takes_the_result_of_the_folder_and_else_the_committed_one(
    committed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    called(monkeypatch, "--draw", "--out", "mine")
    assert [path.name for path in Path("mine").iterdir()] == ["some.png"]
    assert Path("mine/some.png").read_text() == "7.0"
    assert not (committed / "some.png").exists()
    Path("mine/some.json").write_text('{"value": 8.0}')
    called(monkeypatch, "--draw", "--out", "mine")
    assert Path("mine/some.png").read_text() == "8.0"
    called(monkeypatch, "--draw", "--update")
    assert (committed / "some.png").read_text() == "7.0"
    (committed / "some.json").unlink()
    with pytest.raises(SystemExit):
        called(monkeypatch, "--draw", "--out", "other")
    assert "run it without --draw" in capsys.readouterr().err


def test_a_file_in_place_of_the_folder_is_said_in_one_line(
    committed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("taken").write_text("mine")
    with pytest.raises(SystemExit) as ended:
        called(monkeypatch, "--out", "taken")
    assert ended.value.code == 2
    assert "cannot be the folder of results" in capsys.readouterr().err
    assert Path("taken").read_text() == "mine"


# --- all of them


def of(name: str, paper: str = "", engine: tuple[str, ...] = ()) -> Experiment:
    return Experiment(name, "What it is.", paper, engine)


def test_a_run_of_all_goes_on_where_it_was_and_ends_with_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[str] = []
    broken = {"b"}

    def succeeds(name: str, preset: str, folder: Path, log: Path) -> bool:
        ran.append(name)
        log.write_text(f"{name} says why\n")
        return name not in broken

    monkeypatch.setattr(everything, "_succeeds", succeeds)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    chosen = [of("a"), of("b"), of("c"), of("d", engine=("full",))]
    assert everything.run_all(chosen, "full", tmp_path) == 1
    assert ran == ["a", "b", "c"]
    told = capsys.readouterr().err
    assert "d skipped: it needs the engine of discrete elements" in told
    assert "b says why" in told
    assert "1 of 4 failed: b" in told
    # Only what failed is tried again; once all went through, the next run is of all.
    ran.clear()
    broken.clear()
    assert everything.run_all(chosen, "full", tmp_path) == 0
    assert ran == ["b"]
    assert everything.run_all(chosen, "full", tmp_path) == 0
    assert ran == ["b", "a", "b", "c"]


def test_the_engine_matters_to_presets_that_need_it_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []

    def succeeds(name: str, *_: object) -> bool:
        ran.append(name)
        return True

    monkeypatch.setattr(everything, "_succeeds", succeeds)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    everything.run_all([of("d", engine=("full",))], "smoke", tmp_path)
    assert ran == ["d"]


def test_an_experiment_that_fails_leaves_a_log(tmp_path: Path) -> None:
    log = tmp_path / "none.log"
    assert not everything._succeeds("none_of_that_name", "full", tmp_path, log)
    assert "none_of_that_name" in log.read_text()


def test_the_paper_is_the_full_preset_of_what_shows_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[list[str], str, Path]] = []

    def run_all(chosen: list[Experiment], preset: str, folder: Path, *, anew: bool = False) -> int:
        asked.append(([one.name for one in chosen], preset, folder))
        return 0

    monkeypatch.setattr(everything, "run_all", run_all)
    monkeypatch.setattr(everything, "experiments", lambda: [of("a", "figure 1"), of("b")])
    for preset in ("smoke", "paper", "full"):
        assert everything.main(["--preset", preset]) == 0
    assert asked == [
        (["a", "b"], "smoke", places.OUT / "smoke"),
        (["a"], "full", places.OUT / "full"),
        (["a", "b"], "full", places.OUT / "full"),
    ]


def test_a_run_of_all_that_is_stopped_says_how_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(name: str, *_: object) -> bool:
        if name == "b":
            raise KeyboardInterrupt
        return True

    monkeypatch.setattr(everything, "_succeeds", stopped)
    monkeypatch.setattr(everything, "experiments", lambda: [of("a"), of("b")])
    assert everything.main(["--out", str(tmp_path)]) == 130
    assert "goes on where it was" in capsys.readouterr().err
    assert list(json.loads((tmp_path / "finished.json").read_text())) == ["a"]
