"""Laws of ensembles: their mean, their calibrated spread, their place in a world."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trainings import check_that_a_killed_one_ends_alike

import wlplan
from wlplan.constants import ACTION_HIGH
from wlplan.dataset import VARIABLES, Dataset
from wlplan.errors import InputError
from wlplan.models.ensemble import Ensemble
from wlplan.models.storage import load_model, read_description
from wlplan.terrain.automaton import relax
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.training import (
    EvaluationReport,
    PsiHighSettings,
    PsiLowSettings,
    evaluate_performance,
    fitting,
    held_out,
    train,
)
from wlplan.types import (
    LoadingPlan,
    LocalHeightmap,
    Performance,
    Pile,
    Pose,
    Rollout,
    action_from,
)
from wlplan.worlds.learned import LearnedWorld
from wlplan.worlds.shipped import pretrained_path

MEMBERS = 5
LIGHT: dict[str, Any] = {
    "epochs": 30,
    "batch": 160,
    "hidden": (128,),
    "dropout": 0.0,
    "learning_rate": 1e-2,
    "members": MEMBERS,
}
ACTION = jnp.array([0.3, 2.0, 0.2, 3.0])


def scatter(slope: Any) -> Any:
    """Standard deviation of the mass that no input tells about [tonne]."""
    return 0.02 + 0.5 * (slope - 0.2)


def cycles(rollouts: int = 200, loads: int = 20, seed: int = 0) -> Dataset:
    """Cycles whose mass scatters the more, the steeper the pile."""
    n = rollouts * loads
    random = np.random.default_rng(seed)
    low, high = np.array([0.2, 0.0, -0.2, -0.2]), np.array([0.6, 1.0, 0.3, 0.3])
    shape = random.uniform(low, high, (n, 4))
    action = random.uniform(0.0, ACTION_HIGH, (n, 4))
    mass = 2.0 + 3.0 * shape[:, 0] - action[:, 0] + scatter(shape[:, 0]) * random.normal(size=n)
    time = 8.0 + 3.0 * action[:, 2] + 0.2 * random.normal(size=n)
    columns = {name: np.zeros((n, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    rise = np.arange(36, dtype=np.float32) * 0.1
    columns |= {
        "mass": mass.astype(np.float32),
        "time": time.astype(np.float32),
        "work": (120.0 * mass + 5.0 * random.normal(size=n)).astype(np.float32),
        "characteristics": shape.astype(np.float32),
        "h36": (shape[:, :1, None] * rise[None, :, None] * np.ones((1, 1, 36))).astype(np.float32),
        "action": action.astype(np.float32),
        "rollout": np.repeat(np.arange(rollouts, dtype=np.int32), loads),
        "valid": np.ones(n, bool),
    }
    return Dataset(**columns, attributes={})


@pytest.fixture(scope="module")
def data() -> Dataset:
    return cycles()


@pytest.fixture(scope="module")
def saved(
    data: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Ensemble, EvaluationReport]:
    directory = tmp_path_factory.mktemp("ensemble") / "psi_low"
    model, report = train(PsiLowSettings(**LIGHT), data, out=directory)
    assert isinstance(report, EvaluationReport)
    return directory, model, report


def flat(performance: Performance) -> jax.Array:
    return jnp.stack([performance.mass, performance.time, performance.work])


@jax.jit
def of_view(model: Any, view: jax.Array) -> jax.Array:
    return flat(model.of_view(view, ACTION))


@jax.jit
def with_deviation(model: Ensemble, view: jax.Array, action: jax.Array = ACTION) -> jax.Array:
    """Mean and deviation, shape [2, 3]."""
    return jnp.stack([flat(p) for p in model.of_view_with_deviation(view, action)])


def test_nine_in_ten_held_out_cycles_lie_inside_the_interval(
    saved: tuple[Path, Ensemble, EvaluationReport],
) -> None:
    report = saved[2]
    assert report.intervals is not None
    assert set(report.intervals) == {"mass", "time", "work"}
    for interval in report.intervals.values():
        assert 0.85 <= interval.coverage <= 0.95
        assert np.mean(interval.coverage_by_fifths) == pytest.approx(interval.coverage)
    json.dumps(report.as_dict(), allow_nan=False)


def test_the_deviation_is_that_of_the_data_where_they_scatter_much_and_where_little(
    saved: tuple[Path, Ensemble, EvaluationReport],
) -> None:
    model = saved[1]
    view = jnp.array([0.4, 0.5, 0.0, 0.0])
    for slope in (0.25, 0.55):
        _, deviation = with_deviation(model, view.at[0].set(slope))
        assert float(deviation[0]) == pytest.approx(scatter(slope), rel=0.35)


def test_the_check_of_the_interval_can_fail(
    saved: tuple[Path, Ensemble, EvaluationReport], data: Dataset
) -> None:
    model = saved[1]
    narrow = model.replace(factor=0.3 * model.factor)
    report = evaluate_performance(narrow, held_out(data, read_description(saved[0])))
    assert report.intervals is not None
    assert all(interval.coverage < 0.6 for interval in report.intervals.values())


def test_an_ensemble_is_the_mean_of_its_members_which_differ(
    saved: tuple[Path, Ensemble, EvaluationReport],
) -> None:
    model = saved[1]
    view = jnp.array([0.4, 0.5, 0.0, 0.1])
    told = []
    for k in range(model.size):
        params = jax.tree.map(lambda leaf, k=k: leaf[k], model.members.params)
        told.append(of_view(model.members.replace(params=params), view))
    each = np.stack(told)
    assert len(each) == MEMBERS
    assert (each.std(axis=0) > 1e-4).all()
    mean, deviation = with_deviation(model, view)
    # A part of the deviation is added, so that sums come out.
    added = model.bias * deviation / model.factor
    np.testing.assert_allclose(mean, each.mean(axis=0) + added, rtol=1e-5)
    np.testing.assert_array_equal(of_view(model, view), mean)
    assert model.bias[0] == 0.0
    assert (deviation > model.factor * each.std(axis=0)).all()


def test_sums_come_out_where_what_happens_is_skewed(data: Dataset) -> None:
    """One loading in ten takes 6 s more, and nothing tells which: Huber's loss leaves that out."""
    random = np.random.default_rng(1)
    slow = 6.0 * (random.random(len(data)) < 0.1).astype(np.float32)
    skewed = dataclasses.replace(data, time=data.time + slow)
    model, report = train(PsiLowSettings(**LIGHT), skewed)
    assert isinstance(report, EvaluationReport)
    assert isinstance(model, Ensemble)
    part = held_out(skewed, {"dataset": {"fingerprints": []}})
    unbiased = evaluate_performance(model.replace(bias=jnp.zeros(3)), part)
    assert unbiased.every.total_relative["time"] < -0.03
    # Over so few cycles the slow ones are not the same tenth in every part.
    assert abs(report.every.total_relative["time"]) < 0.015


def test_it_errs_less_than_a_member_alone(
    saved: tuple[Path, Ensemble, EvaluationReport], data: Dataset
) -> None:
    model = saved[1]
    part = held_out(data, read_description(saved[0]))
    whole = evaluate_performance(model, part).every.mean_absolute["mass"]
    alone = []
    for k in range(model.size):
        params = jax.tree.map(lambda leaf, k=k: leaf[k], model.members.params)
        member = model.members.replace(params=params)
        alone.append(evaluate_performance(member, part).every.mean_absolute["mass"])
    assert whole < np.mean(alone)


def test_the_gradient_of_mean_and_deviation_is_finite_also_far_from_the_data(
    saved: tuple[Path, Ensemble, EvaluationReport],
) -> None:
    model = saved[1]
    jacobian = jax.jit(jax.jacrev(lambda v, a: with_deviation(model, v, a), (0, 1)))
    for view in (jnp.zeros(4), jnp.array([0.4, 0.5, 0.0, 0.1]), jnp.full(4, 1e4)):
        assert all(np.isfinite(slope).all() for slope in jacobian(view, ACTION))


def test_the_gradient_of_mean_and_deviation_is_that_of_finite_differences() -> None:
    """Of the weights that ship: a part of the deviation is in their mean."""
    with jax.enable_x64(True):
        model = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float64), load_model(pretrained_path("psi_low"))
        )
        view = jnp.array([0.45, 0.1, 0.02, -0.03])
        point = np.asarray(ACTION, np.float64)

        def of(action: jax.Array) -> jax.Array:
            both: jax.Array = with_deviation(model, view, action)
            return both

        exact = np.asarray(jax.jacfwd(of)(jnp.asarray(point)))
        steps = 1e-5 * np.eye(4)
        central = np.stack([(of(point + s) - of(point - s)) / 2e-5 for s in steps], axis=-1)
    np.testing.assert_allclose(exact, central, rtol=1e-4, atol=1e-6)
    assert np.abs(exact).min() > 0.0


def test_an_ensemble_comes_back_bit_by_bit(saved: tuple[Path, Ensemble, EvaluationReport]) -> None:
    directory, model, _ = saved
    loaded = load_model(directory)
    assert isinstance(loaded, Ensemble)
    assert jax.tree.structure(loaded) == jax.tree.structure(model)  # type: ignore[operator]
    for got, want in zip(jax.tree.leaves(loaded), jax.tree.leaves(model), strict=True):
        np.testing.assert_array_equal(got, want)
    description = read_description(directory)
    assert description["ensemble"]["members"] == MEMBERS
    assert len(description["training"]["best_epoch"]) == MEMBERS
    assert description["held_out"]["intervals"]["mass"]["coverage"] > 0.85


@pytest.mark.parametrize(
    "change",
    [{"members": 4}, {"factor": [1.0, 1.0]}, {"members": "many"}, {"bias": [0.0, "x", 0.0]}],
)
def test_a_record_that_does_not_fit_is_refused(
    saved: tuple[Path, Ensemble, EvaluationReport], tmp_path: Path, change: dict[str, Any]
) -> None:
    import shutil

    copy = shutil.copytree(saved[0], tmp_path / "copy")
    document = json.loads((copy / "model.json").read_text())
    document["ensemble"].update(change)
    (copy / "model.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="damaged"):
        load_model(copy)


@pytest.mark.slow
def test_a_killed_training_of_an_ensemble_ends_with_the_same_weights(
    data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = PsiLowSettings(
        **(LIGHT | {"epochs": 4, "hidden": (8,), "dropout": 0.1, "members": 3})
    )
    few = data.select(data.rollout < 12)
    check_that_a_killed_one_ends_alike(few, tmp_path, monkeypatch, settings, members=2)


def test_members_have_seeds_of_their_own_and_the_first_has_that_of_the_training() -> None:
    seeds = fitting.member_seeds(7, 6)
    assert seeds[0] == 7
    assert len(set(seeds)) == 6
    assert fitting.member_seeds(7, 3) == seeds[:3]
    assert not set(seeds[1:]) & set(fitting.member_seeds(8, 6))
    with pytest.raises(InputError, match="members"):
        PsiLowSettings(members=0)


# --- in a world


@pytest.fixture(scope="module")
def site() -> tuple[Pile, Pose]:
    pile = relax(seed_pile("conical", slope=np.radians(30.0), height=2.0))
    return pile, edge_poses(toe_contour(pile), 2)


@pytest.mark.slow
def test_a_world_of_an_ensemble_is_a_world_like_any_other(
    saved: tuple[Path, Ensemble, EvaluationReport], site: tuple[Pile, Pose]
) -> None:
    pile, poses = site
    world = LearnedWorld(saved[1])
    plan = LoadingPlan(poses, action_from(jnp.tile(ACTION, (2, 1))))

    def work(plan: LoadingPlan) -> tuple[jax.Array, Rollout]:
        outcome = wlplan.rollout(world, pile, plan)
        return outcome.performance.work.sum(), outcome

    (_, outcome), slope = jax.jit(jax.value_and_grad(work, has_aux=True))(plan)
    lost = np.asarray(pile.height - outcome.pile.height, np.float64).sum() * pile.cell_size**2
    assert lost * 1.727 == pytest.approx(float(outcome.performance.mass.sum()), rel=1e-3)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


@pytest.mark.slow
def test_a_world_predicts_the_deviation_of_its_error(
    saved: tuple[Path, Ensemble, EvaluationReport], data: Dataset, site: tuple[Pile, Pose]
) -> None:
    pile, poses = site
    pose = jax.tree.map(lambda leaf: leaf[0], poses)
    high, _ = train(PsiHighSettings(**(LIGHT | {"epochs": 2, "members": 2})), data)
    for world in (LearnedWorld(saved[1]), LearnedWorld(high)):

        def deviation_of(
            heading: jax.Array, world: LearnedWorld = world
        ) -> tuple[jax.Array, Performance]:
            found = world.uncertainty(pile, pose.replace(heading=heading), action_from(ACTION))
            return found.mass, found

        slope, found = jax.jit(jax.grad(deviation_of, has_aux=True))(pose.heading)
        assert (flat(found) > 0.0).all()
        assert np.isfinite(slope)
    deviation = high.with_deviation(LocalHeightmap(jnp.zeros((36, 36)), 0.1, 0.0), ACTION)[1]
    assert np.isfinite(flat(deviation)).all()


def test_a_world_of_a_single_model_does_not(data: Dataset, site: tuple[Pile, Pose]) -> None:
    pile, poses = site
    single, _ = train(PsiLowSettings(**(LIGHT | {"epochs": 1, "members": 1})), data)
    pose = jax.tree.map(lambda leaf: leaf[0], poses)
    with pytest.raises(InputError, match="--members"):
        LearnedWorld(single).uncertainty(pile, pose, action_from(ACTION))
    # Nor is there a part of it.
    assert LearnedWorld(single).roughly().performance is single


def test_roughly_it_is_its_first_members(
    saved: tuple[Path, Ensemble, EvaluationReport], site: tuple[Pile, Pose]
) -> None:
    whole, (pile, poses) = saved[1], site
    part = whole.roughly()
    assert part.size < whole.size
    view = jnp.array([0.4, 0.5, 0.0, 0.1])
    told = []
    for k in range(part.size):
        params = jax.tree.map(lambda leaf, k=k: leaf[k], whole.members.params)
        told.append(of_view(whole.members.replace(params=params), view))
    mean, deviation = with_deviation(part, view)
    added = whole.bias * deviation / whole.factor
    np.testing.assert_allclose(mean, np.mean(told, axis=0) + added, rtol=1e-5)
    # As a world it foresees about the same, and is as differentiable.
    pose = jax.tree.map(lambda leaf: leaf[0], poses)
    world = LearnedWorld(whole)
    rough, exact = (
        flat(one.foresee(pile, pose, action_from(ACTION))) for one in (world.roughly(), world)
    )
    np.testing.assert_allclose(rough, exact, rtol=0.2)
    assert (rough != exact).any()


def test_without_intervals_a_report_is_as_it_was(data: Dataset) -> None:
    single, report = train(PsiLowSettings(**(LIGHT | {"epochs": 1, "members": 1})), data)
    assert isinstance(report, EvaluationReport)
    assert report.intervals is None
    assert "intervals" not in report.as_dict()
    assert dataclasses.asdict(report)["intervals"] is None
    with pytest.raises(InputError, match="ensemble"):
        single.of_view_with_variance(jnp.zeros(4), ACTION)
