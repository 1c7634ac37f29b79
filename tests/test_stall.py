"""Laws of the predictor of stalls: probabilities, their calibration, their place in a world."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from laws import assert_gradient
from trainings import check_that_a_killed_one_ends_alike

import wlplan
from wlplan.constants import ACTION_HIGH
from wlplan.dataset import VARIABLES, Dataset
from wlplan.engines.limits import STOP_REASONS
from wlplan.errors import InputError
from wlplan.models.normaliser import Normaliser
from wlplan.models.stall import StallModel, StallNetwork
from wlplan.models.storage import load_model, read_description
from wlplan.terrain.heightmap import sample_local
from wlplan.training import StallReport, StallSettings, evaluate_stalls, held_out, train
from wlplan.training.stall import EDGES, log_odds, scaling, stall_report
from wlplan.types import LocalHeightmap

ACTION = jnp.array([0.3, 2.0, 0.2, 3.0])
LIGHT: dict[str, Any] = {
    "epochs": 30,
    "batch": 160,
    "hidden": (32,),
    "dropout": 0.0,
    "learning_rate": 1e-2,
}


def odds_of(slope: Any, threshold: Any) -> Any:
    """Log odds of a stall in the cycles below: steep faces, and thresholds that are not reached."""
    return -4.0 + 12.0 * (slope - 0.3) + 5.0 * threshold


def cycles(rollouts: int = 300, loads: int = 20, seed: int = 0) -> Dataset:
    """Cycles on plane faces that stall with a known probability."""
    n = rollouts * loads
    random = np.random.default_rng(seed)
    slope = random.uniform(0.2, 0.6, n)
    action = random.uniform(0.0, ACTION_HIGH, (n, 4))
    likely = 1.0 / (1.0 + np.exp(-odds_of(slope, action[:, 0])))
    stalls = random.random(n) < likely
    columns = {name: np.zeros((n, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    shape = np.zeros((n, 4))
    shape[:, 0] = slope
    rise = np.tan(slope)[:, None, None] * (0.1 * np.arange(36.0))[None, :, None]
    columns |= {
        "characteristics": shape.astype(np.float32),
        "h36": (rise * np.ones((1, 1, 36))).astype(np.float32),
        "action": action.astype(np.float32),
        "stop_reason": np.where(stalls, STOP_REASONS.index("timeout"), 0).astype(np.int32),
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
) -> tuple[Path, StallModel, StallReport]:
    directory = tmp_path_factory.mktemp("stall") / "stall"
    model, report = train(StallSettings(**LIGHT), data, out=directory)
    assert isinstance(report, StallReport)
    return directory, model, report


def untrained(seed: int = 0) -> StallModel:
    """Large output weights, so that its probabilities are not all even."""
    network = StallNetwork((16, 16), rngs=nnx.Rngs(seed))
    output: Any = network.head.output
    output.kernel[...] = 20.0 * output.kernel[...]
    random = np.random.default_rng(seed)
    network.encoder.basis[...] = jnp.asarray(random.normal(0, 0.1, (36 * 36, 24)), jnp.float32)
    graph, params = nnx.split(network)
    low = np.array([0.2, 0.0, -0.3, -0.2, 0.0, 0.0, 0.0, 0.0], np.float32)
    high = np.array([0.6, 1.5, 0.3, 0.4, 0.7, 5.0, 0.7, 5.0], np.float32)
    inputs = Normaliser.of(np.stack([low, high]))
    maps = Normaliser.of(np.array([[-0.5], [2.5]], np.float32))
    return StallModel(params=params, maps=maps, inputs=inputs, graph=graph)


def face(seed: int = 0, rise: float = 0.5) -> jax.Array:
    random = np.random.default_rng(seed)
    rows = rise * 0.1 * np.arange(36.0)[:, None] + 0.05 * random.normal(size=(36, 36))
    return jnp.asarray(rows, jnp.result_type(float))


# --- the model


def test_probabilities_are_probabilities_however_wild_the_face() -> None:
    model = untrained()
    for size in (1.0, 1e2, 1e6):
        likely = jax.vmap(model.of_view, in_axes=(0, None))(
            jnp.stack([size * face(seed) for seed in range(20)]), ACTION
        )
        assert np.isfinite(likely).all()
        assert ((likely >= 0.0) & (likely <= 1.0)).all()


def test_a_batch_equals_its_members_and_other_weights_are_no_other_program() -> None:
    call = jax.jit(lambda model, view: model.of_view(view, ACTION))
    views = jnp.stack([face(seed) for seed in range(5)])
    one, other = untrained(), untrained(1)
    batch = jax.vmap(call, in_axes=(None, 0))(one, views)
    np.testing.assert_allclose(batch, [call(one, view) for view in views], rtol=1e-5, atol=1e-7)
    assert not np.allclose(batch, [call(other, view) for view in views])
    assert call._cache_size() == 1  # type: ignore[attr-defined]


def test_its_gradient_is_that_of_finite_differences() -> None:
    model = untrained()
    with jax.enable_x64(True):
        directions = jnp.asarray(np.random.default_rng(3).normal(0, 0.1, (3, 36, 36)))
        base = face(rise=0.4)

        def odds(point: tuple[jax.Array, jax.Array]) -> jax.Array:
            return model.log_odds(base + jnp.tensordot(point[0], directions, 1), point[1])

        point = (np.array([0.1, -0.2, 0.05]), np.asarray(ACTION, np.float64))
        assert odds((jnp.asarray(point[0]), jnp.asarray(point[1]))).dtype == jnp.float64
        assert_gradient(odds, point, step=1e-6, relative=1e-4)


def test_a_map_of_another_grid_is_refused() -> None:
    with pytest.raises(InputError, match="36") as error:
        untrained()(LocalHeightmap(jnp.zeros((52, 52)), 0.1, 0.0), ACTION)
    assert "\n" not in str(error.value)


def test_a_calibrated_model_has_its_log_odds_on_a_line() -> None:
    model = untrained()
    for view in (face(1), face(2)):
        want = 0.5 * float(model.log_odds(view, ACTION)) - 1.0
        assert float(model.calibrated(0.5, -1.0).log_odds(view, ACTION)) == pytest.approx(
            want, rel=1e-4, abs=1e-5
        )
        # Twice is one line after the other.
        twice = model.calibrated(0.5, -1.0).calibrated(2.0, 2.0)
        assert float(twice.log_odds(view, ACTION)) == pytest.approx(2.0 * want + 2.0, abs=1e-4)


# --- its training


def test_it_finds_the_probabilities_behind_the_cycles(
    saved: tuple[Path, StallModel, StallReport], data: Dataset
) -> None:
    directory, model, report = saved
    part = held_out(data, read_description(directory, "stall"))
    true = odds_of(part.characteristics[:, 0], part.action[:, 0])
    best = stall_report(true, part.stop_reason == STOP_REASONS.index("timeout"))
    assert report.cycles == len(part)
    assert best.score.negative_log_likelihood < 0.8 * best.constant.negative_log_likelihood
    assert report.score.negative_log_likelihood < 1.06 * best.score.negative_log_likelihood
    assert report.score.brier < 1.06 * best.score.brier
    assert report.area_under_curve is not None
    assert best.area_under_curve is not None
    assert report.area_under_curve > best.area_under_curve - 0.02
    assert report.calibration_error < 0.05
    # What was foreseen is near what is true, cycle by cycle.
    found, behind = (1.0 / (1.0 + np.exp(-o)) for o in (log_odds(model, part), true))
    assert np.abs(found - behind).mean() < 0.05
    json.dumps(report.as_dict(), allow_nan=False)


def test_it_is_saved_and_loaded_as_it_is(
    saved: tuple[Path, StallModel, StallReport], data: Dataset, tmp_path: Path
) -> None:
    directory, model, report = saved
    again = load_model(directory, "stall")
    assert isinstance(again, StallModel)
    np.testing.assert_array_equal(log_odds(again, data), log_odds(model, data))
    description = read_description(directory, "stall")
    assert description["held_out"] == json.loads(json.dumps(report.as_dict()))
    assert description["architecture"]["hidden"] == [32]
    with pytest.raises(InputError, match="is 'stall'"):
        load_model(directory, "psi_high")
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    (damaged / "model.json").write_text(
        json.dumps({**description, "normaliser": {**description["normaliser"], "maps": {}}})
    )
    with pytest.raises(InputError, match="damaged") as error:
        load_model(damaged, "stall")
    assert "\n" not in str(error.value)


def test_data_in_which_nothing_stalls_is_refused(data: Dataset) -> None:
    smooth = data.select(data.stop_reason == 0)
    with pytest.raises(InputError, match="stall") as error:
        train(StallSettings(**LIGHT), smooth)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_killed_training_ends_alike(
    data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = StallSettings(**{**LIGHT, "epochs": 4})
    check_that_a_killed_one_ends_alike(data, tmp_path, monkeypatch, settings, weight_decay=0.02)


# --- calibration and its report


def test_scaling_finds_the_line_that_the_odds_are_off() -> None:
    random = np.random.default_rng(0)
    true = random.normal(-2.0, 2.0, 200_000)
    happened = random.random(len(true)) < 1.0 / (1.0 + np.exp(-true))
    slope, shift = scaling((true + 1.5) / 0.6, happened)
    assert slope == pytest.approx(0.6, abs=0.02)
    assert shift == pytest.approx(-1.5, abs=0.03)


def test_scaling_stays_finite_where_the_odds_part_both_kinds() -> None:
    slope, shift = scaling(np.array([-3.0, -2.0, -1.0, 1.0, 2.0]), np.arange(5) > 2)
    assert 0.0 < slope < 10.0
    assert abs(shift) < 10.0


def test_a_report_by_hand() -> None:
    likely = np.array([0.002, 0.2, 0.2, 0.8, 0.95])
    happened = np.array([False, False, True, True, False])
    report = stall_report(np.log(likely / (1.0 - likely)), happened)
    chosen = np.where(happened, likely, 1.0 - likely)
    assert report.score.negative_log_likelihood == pytest.approx(-np.log(chosen).mean())
    assert report.score.brier == pytest.approx(np.mean((1.0 - chosen) ** 2))
    assert report.constant.brier == pytest.approx(0.4 * 0.6)
    assert report.constant.negative_log_likelihood == pytest.approx(
        -(0.4 * np.log(0.4) + 0.6 * np.log(0.6))
    )
    # Of six pairs three and a half are in order: 0.2 and 0.2 share theirs.
    assert report.area_under_curve == pytest.approx(3.5 / 6.0)
    filled = {EDGES[n]: one for n, one in enumerate(report.bins) if one is not None}
    assert list(filled) == [0.001, 0.1, 0.7, 0.9]
    assert (filled[0.1].cycles, filled[0.1].stalled) == (2, 0.5)
    assert report.calibration_error == pytest.approx((0.002 + 2 * 0.3 + 0.2 + 0.95) / 5.0)


def test_a_report_of_one_kind_has_no_curve() -> None:
    report = stall_report(np.array([-3.0, -2.0]), np.zeros(2, bool))
    assert report.area_under_curve is None
    assert report.constant.negative_log_likelihood == pytest.approx(0.0, abs=1e-12)


def test_the_check_of_the_calibration_can_fail(
    saved: tuple[Path, StallModel, StallReport], data: Dataset
) -> None:
    directory, model, report = saved
    part = held_out(data, read_description(directory, "stall"))
    worse = evaluate_stalls(model.calibrated(1.0, 2.0), part)
    assert worse.calibration_error > 3.0 * report.calibration_error
    assert worse.area_under_curve == pytest.approx(report.area_under_curve, abs=1e-6)


# --- in a world


def test_the_world_asks_it_about_the_face(saved: tuple[Path, StallModel, StallReport]) -> None:
    model = saved[1]

    def psi(local: LocalHeightmap, action: jax.Array) -> wlplan.Performance:
        return wlplan.Performance(action[0], action[1], action[2])

    pile = wlplan.relax(wlplan.seed_pile("conical", slope=np.radians(30.0), height=2.0))
    pose, action = wlplan.Pose(-3.0, 0.0, 0.0), wlplan.Action(0.3, 2.0, 0.2, 3.0)
    world = wlplan.LearnedWorld(psi, stall=model)
    assert world.has_stall_probability
    want = float(model(sample_local(pile, pose), ACTION))
    assert float(world.stall_probability(pile, pose, action)) == pytest.approx(want, rel=1e-5)
    silent = wlplan.LearnedWorld(psi)
    assert not silent.has_stall_probability
    with pytest.raises(InputError, match="train stall") as error:
        silent.stall_probability(pile, pose, action)
    assert "\n" not in str(error.value)
