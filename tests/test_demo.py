"""What a user sees first: the real command, with the real planner and worlds, as a process."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


def wlplan(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "wlplan", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
        cwd=folder,
    )


def test_two_loads_are_planned_written_and_played_again(tmp_path: Path) -> None:
    done = wlplan(tmp_path, "plan", "--loads", 2, "--out", "out")
    assert done.returncode == 0, done.stderr
    assert "error" not in done.stderr
    for words in (
        "2 loads from bundled",
        "predicted",
        "cost for efficiency",
        "ledger",
        "avalanches",
    ):
        assert words in done.stdout
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["plan.json", "plan.png", "report.html", "totals.png"]

    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert (plan["world"], plan["planner"], plan["referee"]) == ("hybrid", "iterated_greedy", True)
    predicted, simulated = (plan["total"][part] for part in ("predicted", "simulated"))
    assert min(predicted["mass"], simulated["mass"]) > 6.0
    # The prediction holds up, or a note says of which load it does not.
    told = " ".join(note for note in plan["notes"] if "off what was played" in note)
    for number, load in enumerate(plan["loads"], start=1):
        for quantity in ("mass", "time"):
            if load["predicted"][quantity] != pytest.approx(load["simulated"][quantity], rel=0.25):
                assert f"load {number}" in told or f", {number}" in told
    page = (Path(__file__).parents[1] / "docs/plan-json.md").read_text()
    for fields in (plan, plan["total"], plan["ledger"], plan["loads"][0]):
        assert not [name for name in fields if f"`{name}`" not in page]
    ledger = plan["ledger"]
    lost = ledger["density"] * (ledger["volume_before"] - ledger["volume_after"])
    assert ledger["mass_removed"] == pytest.approx(lost, rel=1e-4)
    assert ledger["solves"]["unsettled_loads"] == []

    again = wlplan(tmp_path, "simulate", "bundled", "out/plan.json", "--out", "again", "--json")
    assert again.returncode == 0, again.stderr
    played = json.loads(again.stdout)
    for quantity in ("mass", "time", "work", "cost"):
        assert played["total"]["simulated"][quantity] == pytest.approx(
            simulated[quantity], rel=1e-3
        )
    assert sorted(path.name for path in (tmp_path / "again").iterdir()) == names


def test_a_map_of_the_bundled_pile_in_the_world_that_is_the_default(tmp_path: Path) -> None:
    done = wlplan(tmp_path, "diggability", "--locations", 20, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["world"] == "hybrid"
    assert 1.0 < document["summary"]["mass"]["median"] < 6.0
