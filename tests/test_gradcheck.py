"""The gradient check: right ones pass, wrong ones and kinks are told apart, the command says so."""

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from wlplan import cli, io
from wlplan.constants import ACTION_HIGH
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError
from wlplan.planning.job import make_job
from wlplan.studies import gradcheck
from wlplan.studies.gradcheck import (
    COMPONENTS,
    Component,
    GradientCheck,
    as_table,
    check_gradient,
    plan_from,
    random_plan,
)
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import toe_contour
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose
from wlplan.worlds import shipped as worlds
from wlplan.worlds.capabilities import with_derivatives


@jax.custom_vjp
def misled(x: jax.Array, factor: jax.Array) -> jax.Array:
    """The identity, whose cotangent is too long by a factor."""
    return x


misled.defvjp(lambda x, factor: (x, factor), lambda factor, g: (factor * g, jnp.zeros_like(factor)))


class SmoothWorld(struct.PyTreeNode):
    """Each loading takes a part of the whole pile; smooth but for what a test asks for."""

    error: Any = 0.0  # relative error of the derivative in k_bm
    kink: Any = math.inf  # k_bm at which the time has a kink
    curvature: Any = 0.0  # of the time in k_bm
    ripple: Any = math.inf  # k_bm at which the time has an inflection in a short wave
    noise: Any = 0.0  # size of a term that rounds [s]

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pile, shrunk, and what was taken."""
        part = 0.05 + 0.02 * jnp.sin(pose.x + 2.0 * pose.y) * action.delta_bm
        after = pile.replace(height=pile.height * (1.0 - part))
        mass = (pile.height - after.height).sum() * pile.cell_size**2
        k_bm = misled(action.k_bm, 1.0 + jnp.asarray(self.error))
        time = 10.0 + jnp.cos(pose.heading) * k_bm + self.curvature * k_bm**2
        time = time + jnp.where(k_bm > self.kink, 4.0 * (k_bm - self.kink), 0.0)
        ahead = jnp.where(jnp.isfinite(self.ripple), k_bm - self.ripple, 0.0)
        time = time + 4.0 * jnp.sin(1e3 * ahead) / 1e3
        time = (time + self.noise) - self.noise
        work = 300.0 + 50.0 * jnp.tanh(action.delta_bk) * action.k_bk
        return after, Performance(mass=mass, time=time, work=work)


@pytest.fixture(scope="module")
def pile() -> Pile:
    return seed_pile("conical", slope=math.radians(30.0), height=1.5, noise=0.0)


# Of the loading alone: the best way to the truck may be another one a step further.
SMOOTH = {
    "mass": 2.0,
    "time": (1.0, lambda loading: loading.performance.time / 46.3),
    "work": (1.0, lambda loading: loading.performance.work / 1033.0),
}


@pytest.fixture(scope="module")
def check(pile: Pile) -> Callable[..., GradientCheck]:
    """Compare a plan of two loads in the world with the given flaws."""

    def run(
        plan: LoadingPlan | None = None, step: float = gradcheck.STEP, **flaws: float
    ) -> GradientCheck:
        job = make_job(SmoothWorld(**flaws), pile, objective=SMOOTH)
        plan = random_plan(pile, 2, seed=0) if plan is None else plan
        return check_gradient(job, plan, step=step)

    return run


@pytest.fixture(scope="module")
def k_bm(pile: Pile) -> float:
    return float(random_plan(pile, 2, seed=0).action.k_bm[0])


def named(components: Iterable[Component]) -> list[tuple[int, str]]:
    return [(c.load, c.component) for c in components]


# --- the plan


def test_a_random_plan_lies_on_the_toe_and_inside_the_box(pile: Pile) -> None:
    plan = random_plan(pile, 5, seed=3)
    points = np.stack([plan.pose.x, plan.pose.y], axis=-1)
    toe = toe_contour(pile).points
    assert np.abs(points[:, None] - toe[None]).max(axis=-1).min(axis=-1).max() < 1e-5
    # Closer than half a bucket is wide.
    assert np.hypot(*np.diff(points, axis=0).T).max() < 1.35
    action = np.asarray(as_table(plan))[:, 3:]
    assert (action > 0.0).all()
    assert (action < ACTION_HIGH).all()
    same, other = (np.asarray(as_table(random_plan(pile, 5, seed=s))) for s in (3, 4))
    np.testing.assert_array_equal(same, as_table(plan))
    assert np.abs(other - same).max() > 0.1


def test_tables_and_plans_are_inverse() -> None:
    table = np.random.default_rng(0).normal(size=(3, 4, 7)).astype(np.float32)
    plan = plan_from(table)
    np.testing.assert_array_equal(as_table(plan), table)
    for k, name in enumerate(COMPONENTS):
        part = plan.pose if hasattr(plan.pose, name) else plan.action
        np.testing.assert_array_equal(getattr(part, name), table[..., k])


def test_a_plan_that_cannot_be_made_is_refused(pile: Pile) -> None:
    with pytest.raises(InputError, match="at least 1"):
        random_plan(pile, 0, seed=0)
    with pytest.raises(InputError, match="Nothing to dig"):
        random_plan(pile.replace(height=0.0 * pile.height), 1, seed=0)
    with pytest.raises(InputError, match="can start nowhere"):
        random_plan(pile.replace(valid=jnp.zeros(pile.height.shape, bool)), 1, seed=0)


# --- the verdicts


def test_a_right_gradient_passes(check: Callable[..., GradientCheck]) -> None:
    found = check()
    assert named(found.components) == [(n, name) for n in (1, 2) for name in COMPONENTS]
    assert {c.verdict for c in found.components} == {"ok"}
    assert found.largest_error < 1e-6
    assert found.kink_fraction == 0.0
    assert max(abs(c.reverse) for c in found.components) > 0.01


def test_a_gradient_that_is_a_thousandth_too_long_is_wrong(
    check: Callable[..., GradientCheck],
) -> None:
    found = check(error=1e-3)
    assert named(found.with_verdict("wrong")) == [(1, "k_bm"), (2, "k_bm")]
    assert found.largest_error == pytest.approx(1e-3, rel=0.01)
    assert found.kink_fraction == 0.0


@pytest.mark.parametrize("ahead", [3e-8, 3e-7, -3e-7])
def test_a_kink_is_named_and_not_called_wrong(
    check: Callable[..., GradientCheck], k_bm: float, ahead: float
) -> None:
    found = check(kink=k_bm + ahead)
    assert named(found.with_verdict("kink")) == [(1, "k_bm")]
    assert found.with_verdict("wrong") == []
    assert found.kink_fraction == pytest.approx(1 / 14)
    # The component at the kink does not count among the errors.
    assert found.largest_error < 1e-6


def test_a_kink_does_not_excuse_a_wrong_gradient(
    check: Callable[..., GradientCheck], k_bm: float
) -> None:
    """The narrower difference, which has no kink in it, is off too."""
    found = check(kink=k_bm + 9e-7, error=1e-2)
    assert (1, "k_bm") in named(found.with_verdict("wrong"))


def test_curvature_does_not_excuse_a_wrong_gradient(
    check: Callable[..., GradientCheck], pile: Pile
) -> None:
    """Where the slope is small against the curvature, one-sided differences disagree as well."""
    table = np.array(as_table(random_plan(pile, 1, seed=0)))
    table[0, 4] = 1e-4
    found = check(plan_from(table), curvature=5e3, error=5e-4)
    assert named(found.with_verdict("wrong")) == [(1, "k_bm")]
    assert {c.verdict for c in check(plan_from(table), curvature=5e3).components} == {"ok"}


def test_a_step_that_is_too_wide_is_not_called_wrong(
    check: Callable[..., GradientCheck], k_bm: float
) -> None:
    found = check(ripple=k_bm, step=1e-4)
    assert {c.verdict for c in found.components} == {"ok"}
    assert found.components[4].step == pytest.approx(1e-5)


def test_rounding_is_not_called_wrong(check: Callable[..., GradientCheck]) -> None:
    found = check(noise=1e7)
    assert found.with_verdict("wrong") == []
    assert any(c.step > found.step for c in found.components)


def test_a_gradient_that_is_not_finite_is_wrong(check: Callable[..., GradientCheck]) -> None:
    found = check(error=math.nan)
    assert named(found.with_verdict("wrong")) == [(1, "k_bm"), (2, "k_bm")]
    text = json.dumps(found.as_dict(), allow_nan=False)
    assert [row["reverse"] for row in json.loads(text)["rows"]].count(None) == 2
    assert json.loads(text)["largest_relative_error"] is None


def test_it_refuses_what_makes_no_sense(check: Callable[..., GradientCheck], pile: Pile) -> None:
    job = make_job(SmoothWorld(), pile)
    plan = random_plan(pile, 1, seed=0)
    with pytest.raises(InputError, match="step"):
        check_gradient(job, plan, step=0.0)
    with pytest.raises(InputError, match="tolerance"):
        check_gradient(job, plan, tolerance=math.nan)
    with pytest.raises(InputError, match="not finite"):
        check(noise=math.nan)


def test_progress_reaches_the_end(pile: Pile) -> None:
    job = make_job(SmoothWorld(error=0.1), pile)
    told = []
    check_gradient(job, random_plan(pile, 2, seed=0), progress=lambda *both: told.append(both))
    assert told[0] == (0, 14)
    # Two wrong components, each with two more steps.
    assert told[-1] == (18, 18)


def test_the_simulator_gets_its_derivatives() -> None:
    found = with_derivatives(Simulator())
    assert isinstance(found, Simulator)
    assert found.settings.differentiable
    world = SmoothWorld()
    assert with_derivatives(world) is world


# --- the command


@pytest.fixture
def scan(tmp_path: Path, pile: Pile) -> str:
    path = tmp_path / "scan.npz"
    io.write_pile(path, pile)
    return str(path)


@pytest.fixture
def command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, scan: str
) -> Callable[..., tuple[int, str, str]]:
    """Run `wlplan gradcheck` on a small pile; with flaws, in a world that has them."""

    def run(*words: object, **flaws: float) -> tuple[int, str, str]:
        if flaws:
            monkeypatch.setattr(worlds, "load_world", lambda name, **_: SmoothWorld(**flaws))
        capsys.readouterr()
        code = cli.main(["gradcheck", scan, *(str(word) for word in words)])
        return code, *capsys.readouterr()

    return run


@pytest.mark.slow
def test_the_command_passes_the_world_that_ships(
    command: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    code, out, err = command("--loads", 2, "--out", tmp_path / "out")
    assert code == 0
    assert "WRONG" not in out
    assert "14 components" in out
    for name in COMPONENTS:
        assert name in out
    assert "median" in out
    assert "error" not in err
    document = json.loads((tmp_path / "out" / "gradcheck.json").read_text())
    assert document["world"] == "hybrid"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["gradcheck.json"]


@pytest.mark.slow
def test_a_wrong_gradient_ends_with_code_1(command: Callable[..., tuple[int, str, str]]) -> None:
    code, out, _ = command("--loads", 2, error=1e-3)
    assert code == 1
    assert "WRONG: load 1 k_bm, load 2 k_bm" in out
    assert "14 components: 12 ok, 0 at kinks (0.0 %), 2 wrong" in out
    assert command("--loads", 2, "--tolerance", 0.01, error=1e-3)[0] == 0


def test_a_kink_is_named_and_ends_with_code_0(
    command: Callable[..., tuple[int, str, str]], k_bm: float
) -> None:
    code, out, _ = command("--loads", 2, kink=k_bm + 3e-7)
    assert code == 0
    assert "at kinks: load 1 k_bm" in out
    assert "WRONG" not in out


def test_json_holds_every_component_and_nothing_else(
    command: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    options = ("--loads", 2, "--seed", 4, "--objective", "productivity", "--step", 2e-6)
    code, out, _ = command(*options, "--json", "--out", tmp_path / "out", error=1e-3)
    assert code == 1
    assert out == (tmp_path / "out" / "gradcheck.json").read_text()
    document = json.loads(out)
    assert document["format"] == "wlplan.gradcheck/1"
    assert (document["objective"], document["seed"], document["step"]) == ("productivity", 4, 2e-6)
    rows = document["rows"]
    assert [(row["load"], row["component"]) for row in rows] == [
        (n, name) for n in (1, 2) for name in COMPONENTS
    ]
    for row in rows:
        assert row["verdict"] == ("wrong" if row["component"] == "k_bm" else "ok")
        assert math.isfinite(row["reverse"])
        assert math.isfinite(row["central"])
    assert (document["components"], document["wrong"], document["kinks"]) == (14, 2, 0)
    assert len(document["loads"]) == 2


def test_the_command_and_the_module_agree() -> None:
    """The command repeats these to keep help fast."""
    defaults = {option.name: option for option in cli.wlplan.commands["gradcheck"].params}
    assert defaults["step"].default == gradcheck.STEP
    help_text = defaults["tolerance"].help
    assert help_text is not None
    help_text = help_text.replace("e-0", "e-")
    for tolerance in (gradcheck.TOLERANCE, gradcheck.SIMULATOR_TOLERANCE):
        assert f"{tolerance:.0e}".replace("e-0", "e-") in help_text


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--loads", "0"], "--loads"),
        (["--loads", "51"], "--loads"),
        (["--loads", "11", "--world", "simulator"], "at most 10"),
        (["--world", "moon"], "simulator"),
        (["--objective", "fun"], "efficiency"),
        (["--step", "0"], "--step"),
        (["--step", "nan"], "'nan' is not a finite number"),
        (["--tolerance", "-1"], "--tolerance"),
        (["--model", "missing"], "no such model"),
        (["--out", ""], "empty"),
        (["more.npz"], "more.npz"),
    ],
)
def test_bad_usage_is_one_line(
    command: Callable[..., tuple[int, str, str]], words: list[str], told: str
) -> None:
    code, out, err = command(*words)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert told in err


@pytest.mark.slow
def test_the_command_passes_the_simulator(command: Callable[..., tuple[int, str, str]]) -> None:
    code, out, _ = command("--loads", 1, "--world", "simulator")
    assert code == 0
    assert "7 components" in out
