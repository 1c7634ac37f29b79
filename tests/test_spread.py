"""Laws of work that several processes share: rows that none makes twice, parts that add up."""

import argparse
import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments._common import spread
from experiments._common.row_files import (
    RowFiles,
    add_row_options,
    matching,
    part_of,
    time_is_up,
)
from wlplan.errors import InputError
from wlplan.xla import cores

ROOT = Path(__file__).parents[1]


# --- row files


def test_a_row_is_made_once_and_anew_where_it_hangs_on_something_else(tmp_path: Path) -> None:
    rows = RowFiles(tmp_path / "rows")
    made: list[int] = []

    def make() -> dict[str, int]:
        made.append(len(made))
        return {"number": made[-1]}

    assert rows.all() == []
    assert rows.read("a", {"of": 1}) is None
    first = rows.get("a", {"of": 1}, make)
    assert first == {"number": 0, "made_with": {"of": 1}}
    assert rows.get("a", {"of": 1}, make) == first == rows.read("a", {"of": 1})
    assert rows.get("a", {"of": 2}, make) == {"number": 1, "made_with": {"of": 2}}
    rows.get("b", {"of": 2}, make)
    assert [row["number"] for row in rows.all()] == [1, 2]


def test_rows_from_elsewhere_are_laid_beside_those_that_are_there(tmp_path: Path) -> None:
    rows = RowFiles(tmp_path / "rows")
    rows.lay({"a": {"number": 1}})
    rows.lay({"a": {"number": 2}, "b": {"number": 3}})
    assert rows.all() == [{"number": 1}, {"number": 3}]


def test_a_row_that_another_process_makes_is_not_made_twice(tmp_path: Path) -> None:
    rows = RowFiles(tmp_path)
    code = (
        "import sys; from pathlib import Path; "
        "from experiments._common.row_files import RowFiles; "
        "make = lambda: print('at it', flush=True) or {'number': len(sys.stdin.readline())}; "
        f"RowFiles(Path({str(tmp_path)!r})).get('a', {{}}, make)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=ROOT,
        text=True,
    ) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        assert other.stdout.readline() == "at it\n"
        assert rows.get("a", {}, lambda: {"number": -1}) is None
        assert rows.get("b", {}, lambda: {"number": 5}) is not None
        other.stdin.write("\n")
        other.stdin.flush()
        other.wait(60)
    assert rows.read("a", {}) == {"number": 1, "made_with": {}}


def test_a_process_that_dies_leaves_its_row_to_others(tmp_path: Path) -> None:
    rows = RowFiles(tmp_path)

    def breaks() -> dict[str, int]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rows.get("a", {}, breaks)
    assert rows.all() == []
    assert rows.get("a", {}, lambda: {"number": 1}) is not None


def test_parts_add_up_and_patterns_order() -> None:
    parts = [part_of(range(10), (number, 3)) for number in (1, 2, 3)]
    assert sorted(itertools.chain(*parts)) == list(range(10))

    class One:
        def __init__(self, name: str):
            self.name = name

    every = [One("cat"), One("dog"), One("cow")]
    assert [one.name for one in matching(every, ["d*", "c*w"])] == ["dog", "cow"]
    assert matching(every, None) == every


def test_what_is_no_part_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    add_row_options(parser, Path("rows"))
    options = parser.parse_args(["--shard", "2/3"])
    assert options.shard == (2, 3)
    assert not time_is_up(options)()
    assert time_is_up(parser.parse_args(["--minutes", "-1"]))()
    for text in ("0/3", "4/3", "1", "a/b"):
        with pytest.raises(SystemExit):
            parser.parse_args(["--shard", text])
        assert "no part" in capsys.readouterr().err


# --- parts of a command


def test_every_part_has_its_number() -> None:
    assert spread.parts(["collect", "--out", "{}.zarr"], 2) == [
        ("collect", "--out", "1.zarr", "--shard", "1/2"),
        ("collect", "--out", "2.zarr", "--shard", "2/2"),
    ]


def test_a_part_whose_time_is_over_is_queued_again_as_it_is() -> None:
    pytest.importorskip("submitit")
    part = spread.Part(("true",))
    again = part.checkpoint()
    assert again.function == part
    assert again.result() == 0


def test_parts_run_side_by_side_each_on_cores_of_its_own(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    count = min(cores(), 2)
    code = (
        "import os, sys, pathlib; "
        "own = sorted(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else [0]; "
        "pathlib.Path(sys.argv[1]).write_text(f'{sys.argv[3]} {own}'); "
        "sys.exit(3 * (sys.argv[3] == '2/2'))"
    )
    jobs = spread.start(
        [sys.executable, "-c", code, str(tmp_path / "{}.txt")], count, logs=tmp_path / "logs"
    )
    assert spread.wait(jobs) == int(count == 2)
    said = [(tmp_path / f"{n}.txt").read_text().split(maxsplit=1) for n in range(1, count + 1)]
    assert [shard for shard, _ in said] == [f"{n}/{count}" for n in range(1, count + 1)]
    if hasattr(os, "sched_getaffinity"):
        assert len({own for _, own in said}) == count


def test_more_parts_than_cores_are_refused_and_so_is_slurm_where_it_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("submitit")
    too_many = str(cores() + 1)
    assert spread.main(["--jobs", too_many, "--logs", str(tmp_path), "--", "true"]) == 2
    assert capsys.readouterr().err.startswith(f"error: {too_many} jobs of 1 core are too many")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="Slurm is not here"):
        spread.start(["true"], 1, cluster="slurm", logs=tmp_path)


def test_without_submitit_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(InputError, match=r"wlplan\[cluster\]"):
        spread.start(["true"], 1)


def test_slurm_is_given_one_array_of_all_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a Slurm that only writes down what it is given."""
    pytest.importorskip("submitit")
    given = tmp_path / "given"
    for name in ("srun", "sbatch"):
        tool = tmp_path / name
        tool.write_text(f"#!/bin/sh\ncp \"$1\" '{given}'\necho Submitted batch job 12\n")
        tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    jobs = spread.start(
        ["true"],
        3,
        cluster="slurm",
        cores_each=2,
        hours=0.5,
        logs=tmp_path / "logs",
        slurm={"partition": "quiet"},
    )
    assert [job.job_id for job in jobs] == ["12_0", "12_1", "12_2"]
    script = given.read_text()
    for line in ("--array=0-2", "--cpus-per-task=2", "--time=30", "--partition=quiet"):
        assert f"#SBATCH {line}" in script
