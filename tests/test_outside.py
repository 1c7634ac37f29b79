"""What others write without touching the package: a planner, an objective, a world, a reader."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from wlplan.cli.inputs import planner_named
from wlplan.errors import InputError

_MODULE = '''
"""Somebody else's planner, objective and world."""

import dataclasses

import jax
import jax.numpy as jnp

import wlplan
from wlplan.planning.job import Decisions


@dataclasses.dataclass(frozen=True)
class Even:
    """Square to the toe, evenly spread, always the same action."""

    threshold: float = 0.0

    def propose(self, job, loads, *, seed, progress=None):
        place = (jnp.arange(loads) + 0.5) / loads
        return wlplan.Proposals(
            Decisions(place, jnp.zeros(loads), jnp.full((loads, 4), self.threshold))
        )


class Fixed:
    """A planner of poses of its own, which no toe moves."""

    def propose(self, job, loads, *, seed, progress=None):
        pose = wlplan.Pose(*(jnp.full((1, loads), v) for v in (-6.0, 0.0, 0.0)))
        action = wlplan.Action(*(jnp.full((1, loads), v) for v in (0.3, 2.0, 0.4, 3.0)))
        return wlplan.Proposals(wlplan.LoadingPlan(pose, action))


def west(loading):
    """Keeps the digs in the west."""
    return loading.pose.x


goal = wlplan.Objective({"mass": 2.0, "west": (0.1, west), "north": wlplan.Constraint(
    lambda loading: loading.pose.y - 100.0
)})


def flat(pile, pose, action):
    """Two tonnes out of the whole pile at once."""
    lost = 2.0 / 1.727 / pile.cell_size**2
    above = pile.height - pile.floor
    after = pile.replace(height=pile.height - lost * above / above.sum())
    mass = jnp.asarray(2.0) + 0.0 * pose.x
    return after, wlplan.Performance(mass, 10.0 + action.k_bm, 300.0 * mass)
'''


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine.py").write_text(_MODULE)
    # Nothing in the folder stands in for what is installed.
    (tmp_path / "json.py").write_text("raise SystemExit('another json')")
    return tmp_path


def command(folder: Path, *words: object) -> dict[str, Any]:
    done = subprocess.run(
        # As the installed command does: without the current folder at the head of the path.
        [sys.executable, "-P", "-m", "wlplan", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=folder,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    assert done.returncode == 0, done.stderr
    document: dict[str, Any] = json.loads(done.stdout)
    return document


@pytest.mark.slow
def test_planner_objective_and_world_run_from_the_command_line(folder: Path) -> None:
    document = command(
        folder,
        *("plan", "--loads", 2, "--planner", "mine:Even", "--objective", "mine:goal"),
        *("--world", "mine:flat", "--no-referee", "--json"),
    )
    assert (document["planner"], document["world"]) == ("mine:Even", "mine:flat")
    assert [load["predicted"]["mass"] for load in document["loads"]] == pytest.approx([2.0, 2.0])
    assert document["total"]["simulated"]["mass"] > 1.0
    # Costs are of the objective: twice M0 / M, and a tenth of x.
    x = sum(load["x"] for load in document["loads"])
    cost = 2 * 2.0 * 4.29 / (2.0**2 + 0.1**2) ** 0.5 + 0.1 * x
    assert document["total"]["predicted"]["cost"] == pytest.approx(cost, rel=1e-4)


def test_they_are_values_in_python_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(folder))
    (folder / "json.py").unlink()
    import mine

    import wlplan
    from wlplan.io import bundled_pile_path

    pile = wlplan.read_pile(bundled_pile_path())
    even = wlplan.plan_loads(mine.flat, pile, loads=2, planner=mine.Even(), objective=mine.west)
    assert list(even.terms) == ["west"]
    assert float(even.cost) == pytest.approx(float(even.plan.pose.x.sum()))
    fixed = wlplan.plan_loads(mine.flat, pile, loads=2, planner=mine.Fixed(), objective=mine.goal)
    assert fixed.plan.pose.x.tolist() == [-6.0, -6.0]
    assert fixed.terms["north"].tolist() == [0.0, 0.0]


def test_what_is_no_planner_is_told_where_it_is_named() -> None:
    with pytest.raises(InputError, match=r"3\.14\S* is no planner"):
        planner_named("math:pi")
