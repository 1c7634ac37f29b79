"""What the experiments on trained models compute: floors, sums of errors, cosines, kept models."""

import dataclasses
import itertools
import platform
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from test_training import synthetic

from experiments import (
    hyperparameters,
    learning_curve,
    model_gradients,
    noise_floor,
    protocol,
    reliability,
    sequential_loading,
)
from experiments._common import training_rows
from experiments._common.models import load_or_train as trained
from experiments._common.training_rows import train_row
from wlplan.constants import CELL_SIZE
from wlplan.dataset import fingerprint
from wlplan.training import PsiHighSettings, PsiLowSettings, Settings
from wlplan.types import Action, Performance, Pile, Pose

ROOT = Path(__file__).parents[1]

# --- models that are kept


def breaks(*_: object, **__: object) -> None:
    raise ZeroDivisionError


@pytest.mark.slow
def test_a_model_is_trained_once_and_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = synthetic(rollouts=10, loads=6)
    settings = PsiLowSettings(activation="swish", epochs=1, hidden=(4,))
    first, seconds = trained(tmp_path, data, settings)
    assert seconds is not None
    assert seconds > 0.0
    with monkeypatch.context() as patched:
        patched.setattr("wlplan.training.train", breaks)
        again, same = trained(tmp_path, data, settings)
        # Swish is the default: to name it makes no other model.
        trained(tmp_path, data, PsiLowSettings(epochs=1, hidden=(4,)))
    assert same == seconds
    inputs = jnp.asarray(data.characteristics[0]), jnp.asarray(data.action[0])
    assert first.of_view(*inputs).mass == again.of_view(*inputs).mass
    trained(tmp_path, data, dataclasses.replace(settings, seed=1))
    trained(tmp_path, data.select(data.rollout < 8), settings)
    names = [path.name for path in tmp_path.iterdir() if path.is_dir()]
    assert len(names) == 3
    assert sum(fingerprint(data)[7:15] in name for name in names) == 2


@pytest.mark.slow
def test_another_default_is_another_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = synthetic(rollouts=10, loads=6)

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class OtherDefault(PsiLowSettings):
        learning_rate: float = dataclasses.field(
            default=1e-3,
            metadata=PsiLowSettings.__dataclass_fields__["learning_rate"].metadata,
        )

    for settings in (PsiLowSettings, OtherDefault):
        trained(tmp_path, data, settings(epochs=1, hidden=(4,)))
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 2


@pytest.mark.slow
def test_a_training_that_was_cut_short_has_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = synthetic(rollouts=10, loads=6)
    settings = PsiLowSettings(epochs=1, hidden=(4,))
    with monkeypatch.context() as patched:
        patched.setattr("wlplan.training.train", breaks)
        with pytest.raises(ZeroDivisionError):
            trained(tmp_path, data, settings)
    assert trained(tmp_path, data, settings)[1] is None


# --- learning curve


def test_parts_of_the_learning_curve_are_drawn_without_repetition() -> None:
    pool = synthetic(rollouts=30, loads=10)
    part, epochs = learning_curve._part(pool, 90, seed=0)
    assert len(part) == 100
    pairs = np.unique(np.column_stack([part.rollout, part.mass]), axis=0)
    assert len(pairs) == 100
    other, _ = learning_curve._part(pool, 90, seed=1)
    assert fingerprint(part) != fingerprint(other)
    assert epochs == learning_curve.LEAST_STEPS
    whole, _ = learning_curve._part(pool, 10_000, seed=0)
    assert fingerprint(whole) == fingerprint(pool)


# --- the grid of the paper's appendix B, and its protocol


def test_the_grid_has_the_papers_models_and_begins_with_a_part_of_all_kinds() -> None:
    every = hyperparameters.runs("full")
    assert len({one.name for one in every}) == len(every)
    papers = [one for one in every if one.kind != hyperparameters.OURS and one.seed == 0]
    assert len(papers) == 480
    first = [one for one in every if one.is_first]
    assert every[: len(first)] == first
    for name, least in (("kind", 3), ("activation", 2), ("layers", 3), ("units", 5)):
        assert len({getattr(one, name) for one in first}) >= least
    costs = [one.cost for one in first]
    assert costs == sorted(costs)


def test_the_more_weights_and_cycles_the_dearer() -> None:
    small = hyperparameters.Run("psi_low", "swish", 2, 64, 3000, 0)
    for dearer in (
        dataclasses.replace(small, units=4096),
        dataclasses.replace(small, layers=3, units=512),
        dataclasses.replace(small, samples=0),
        dataclasses.replace(small, kind="psi_high"),
    ):
        assert dearer.cost > small.cost
    few = dataclasses.replace(small, samples=100).settings
    assert few.epochs * max(89 // few.batch, 1) >= hyperparameters.LEAST_STEPS


def test_a_summary_says_how_much_of_the_grid_is_there() -> None:
    data = synthetic(rollouts=3, loads=2)
    data = dataclasses.replace(data, attributes={**data.attributes, "versions": {}})
    one = hyperparameters.runs("full")[0]
    row = {
        "cycles": [90, 10, 20],
        "mean_relative": {"mass": 0.1, "time": 0.2, "work": 0.3},
        **dict.fromkeys(("parameters", "epochs", "best_epoch"), 7),
        **dict.fromkeys(("epoch_s", "training_s", "inference_s", "inference_of_a_batch_s"), 0.5),
        "dataset": "sha256:0",
    }
    result = hyperparameters.run("full", data, {one.name: row})
    assert result["parts"]["paper"]["done"] == int(one.kind != hyperparameters.OURS)
    assert result["parts"]["all"]["trainings"] == len(hyperparameters.runs("full"))
    (found,) = result["rows"]
    assert dict(zip(result["columns"], found, strict=True))["cycles"] == 100
    assert result["datasets"] == 1


def test_from_the_papers_protocol_every_step_changes_something_and_the_last_is_ours() -> None:
    ends: tuple[tuple[list[protocol.Step], Settings], ...] = (
        (list(protocol._low(0)), PsiLowSettings()),
        (list(protocol._high(0)), PsiHighSettings(dropout=0.1)),
    )
    for steps, ours in ends:
        for key, value in protocol.PAPER.items():
            assert getattr(steps[0].settings, key) == value
        for before, after in itertools.pairwise(steps):
            assert before.settings != after.settings
        assert steps[-1].settings == ours
    names = [step.name for step in protocol.steps("full")]
    assert len(set(names)) == len(names)


def test_a_training_that_ends_with_its_epochs_is_not_called_converged() -> None:
    def row(optimiser: str, epochs: int) -> dict[str, object]:
        settings = {"optimiser": optimiser, "epochs": 100}
        return {"epochs": epochs, "made_with": {"settings": settings}}

    assert not protocol._is_converged(row("adam", 100))
    assert protocol._is_converged(row("adam", 99))
    assert protocol._is_converged(row("adamw", 100))


def test_a_row_of_a_training_leaves_no_model_behind(tmp_path: Path) -> None:
    data = synthetic(rollouts=10, loads=6)
    row = train_row(PsiLowSettings(epochs=2, hidden=(4,)), data, tmp_path / "deep" / "m")
    assert not list((tmp_path / "deep").iterdir())
    assert row["parameters"] == 8 * 4 + 4 + 4 * 3 + 3
    assert row["epochs"] == 2
    assert sum(row["cycles"]) == len(data)
    assert 0.0 < row["epoch_s"] < row["training_s"]


def test_a_row_serves_the_same_cycles_of_another_processor_and_no_others() -> None:
    data = synthetic(rollouts=2, loads=3)
    off = dataclasses.replace(data, mass=data.mass * np.float32(1.0 + 1e-6))
    assert fingerprint(off) != fingerprint(data)
    made = training_rows.made_with(PsiLowSettings(), data)
    assert training_rows.made_with(PsiLowSettings(), off) == made
    for name, value in (("seed", 12345), ("loads", 7)):
        other = dataclasses.replace(data, attributes={**data.attributes, name: value})
        assert training_rows.made_with(PsiLowSettings(), other) != made
    fewer = synthetic(rollouts=2, loads=2)
    assert training_rows.made_with(PsiLowSettings(), fewer) != made


FREED_AGAIN_AND_AGAIN = """
import resource, sys
from experiments._common.training_rows import keep_memory
if sys.argv[1] == "kept":
    keep_memory()
def pages():
    b"x" * 40_000_000
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
first = pages()
for _ in range(20):
    last = pages()
print(last - first)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc is told")
def test_memory_that_is_kept_is_not_made_anew() -> None:
    pages = {}
    for case in ("kept", "given back"):
        command = [sys.executable, "-c", FREED_AGAIN_AND_AGAIN, case]
        done = subprocess.run(command, check=True, capture_output=True, cwd=ROOT, text=True)
        pages[case] = int(done.stdout)
    # The pages may be of 2 MB.
    assert pages["given back"] >= 20 * 19
    assert pages["kept"] < 20


# --- noise floor


def test_the_floor_is_the_mean_deviation_of_what_cannot_be_told_apart() -> None:
    random = np.random.default_rng(0)
    mean = random.uniform(2.0, 4.0, (2000, 1, 3))
    spread = np.array([0.0, 0.01, 0.05])
    found = noise_floor.floor(mean * (1.0 + spread * random.normal(size=(2000, 12, 3))))
    np.testing.assert_allclose(found, np.sqrt(2.0 / np.pi) * spread, rtol=0.03, atol=1e-12)


def test_a_better_constant_lowers_the_floor() -> None:
    # Three repeats of four agree: that value is the best, and errs on the fourth alone.
    repeats = np.full((1, 4, 3), 2.0)
    repeats[0, 3] = 4.0
    np.testing.assert_allclose(noise_floor.floor(repeats), (0.5 / 4.0) * np.sqrt(4.0 / 3.0))


def test_changes_around_the_map_leave_the_map_and_the_ground_alone() -> None:
    slope = np.maximum(0.5 * (np.arange(52) * CELL_SIZE - 1.0), 0.0)
    surface = np.broadcast_to(slope[None, :, None], (2, 52, 52))
    changed = noise_floor.around(surface, 3, np.random.default_rng(0))
    assert changed.shape == (2, 3, 52, 52)
    inside = np.s_[..., 10:46, 8:44]
    np.testing.assert_array_equal(changed[inside], surface[:, None][inside].repeat(3, axis=1))
    np.testing.assert_array_equal(changed[..., :10, :], 0.0)
    assert np.abs(changed - surface[:, None]).max() > 0.05
    assert np.abs(changed[:, 0] - changed[:, 1]).max() > 0.05


# --- forty loads


@struct.dataclass
class TakesOne:
    """A world that says what it is told, and lowers every cell."""

    factor: float

    def __call__(self, pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        """The pose scaled as mass, time and work."""
        told = Performance(self.factor * pose.x, self.factor * pose.y, self.factor * pose.heading)
        return pile.replace(height=pile.height - 0.1 * self.factor), told


def sequence(loads: int = 4, cells: int = 5) -> sequential_loading.Sequence:
    random = np.random.default_rng(0)
    outcomes = random.uniform(1.0, 2.0, (loads, 3))
    steps = 0.1 * np.arange(loads + 1)
    return sequential_loading.Sequence(
        kind=0,
        origin=np.zeros(2),
        poses=outcomes,
        actions=np.zeros((loads, 4)),
        outcomes=outcomes,
        heights=np.broadcast_to(3.0 - steps[:, None, None], (loads + 1, cells, cells)),
    )


@pytest.mark.parametrize("own_pile", [True, False])
def test_the_right_world_has_no_error(own_pile: bool) -> None:
    played = sequence()
    found = sequential_loading.predicted(TakesOne(1.0), played, own_pile=own_pile)
    np.testing.assert_allclose(found[0], played.outcomes, rtol=1e-6)
    np.testing.assert_allclose(found[1], played.volumes[1:], rtol=1e-6)
    np.testing.assert_allclose(found[2], 0.0, atol=1e-5)


def test_errors_of_a_wrong_world_add_up() -> None:
    played = sequence()
    found = sequential_loading.predicted(TakesOne(1.2), played, own_pile=True)
    truth = played.outcomes[None]
    growth = sequential_loading._growth([found], truth, played.volumes[None])
    for name in sequential_loading.OUTCOMES:
        assert growth[name]["last"]["mean"] == pytest.approx(0.2, rel=1e-4)
    # 0.08 m too much were taken, of 2.6 m that should be left.
    assert growth["volume"]["last"]["mean"] == pytest.approx(-0.08 / 2.6, rel=1e-4)
    np.testing.assert_allclose(found[2][-1], 0.08 * 25 * CELL_SIZE**2, rtol=1e-4)
    # On the simulator's pile only the last load is misplaced, the volumes add up all the same.
    given = sequential_loading.predicted(TakesOne(1.2), played, own_pile=False)
    np.testing.assert_allclose(given[2], 0.02 * 25 * CELL_SIZE**2, rtol=1e-3)
    np.testing.assert_allclose(given[1], found[1], rtol=1e-5)
    assert sequential_loading._sizes([found], truth)["work"] == pytest.approx(0.2, rel=1e-4)


def test_errors_that_cancel_in_the_sum_still_have_a_size() -> None:
    played = sequence()
    wrong = played.outcomes + np.array([0.1, -0.1, 0.1, -0.1])[:, None]
    found = (wrong, played.volumes[1:], np.zeros(4))
    growth = sequential_loading._growth([found], played.outcomes[None], played.volumes[None])
    assert growth["mass"]["last"]["mean"] == pytest.approx(0.0, abs=1e-9)
    assert sequential_loading._sizes([found], played.outcomes[None])["mass"] > 0.05


# --- gradients


def test_the_summary_of_cosines_counts_what_points_nowhere() -> None:
    random = np.random.default_rng(0)
    truth = random.normal(size=(100, 4))
    same = model_gradients.summary(2.0 * truth, truth)
    assert same["median"] == pytest.approx(1.0)
    assert same["positive"] == 1.0
    assert same["median_length_ratio"] == pytest.approx(2.0)
    wrong = truth.copy()
    wrong[:20] *= -1.0
    wrong[20:30] = 0.0
    truth[99] = 0.0
    some = model_gradients.summary(wrong, truth)
    assert some["cycles"] == 99
    assert some["positive"] == pytest.approx(69 / 99)
    assert some["p10"] == pytest.approx(-1.0)


def test_derivatives_are_turned_into_the_frame_of_the_pose() -> None:
    """Of f = 2 ahead + 3 aside, at a pose that looks along 30 degrees."""
    heading = np.radians(30.0)
    ahead, aside = (np.cos(heading), np.sin(heading)), (-np.sin(heading), np.cos(heading))
    world = np.zeros((1, 3, 7))
    world[0, :, :2] = 2.0 * np.array(ahead) + 3.0 * np.array(aside)
    world[0, :, 2:] = 5.0
    vector = np.array([[1.0, 2.0, heading, 0.0, 0.0, 0.0, 0.0]])
    found = model_gradients._in_its_frame(world, vector)
    np.testing.assert_allclose(found[0, :, :2], [[2.0, 3.0]] * 3)
    np.testing.assert_array_equal(found[0, :, 2:], 5.0)


# --- reliability


def test_deviations_that_are_right_cover_as_they_say_and_others_do_not() -> None:
    random = np.random.default_rng(0)
    deviation = random.uniform(0.1, 2.0, 20_000)
    error = deviation * random.normal(size=len(deviation))
    right = reliability.reliability(error, deviation)
    np.testing.assert_allclose(right["coverage"], reliability.LEVELS, atol=0.01)
    np.testing.assert_allclose(right["error"], right["deviation"], rtol=0.06)
    np.testing.assert_allclose(right["inside"], 0.9, atol=0.03)
    # Half as large, the interval of 90 % is one of 59 %.
    small = reliability.reliability(error, 0.5 * deviation)
    assert small["coverage"][reliability.LEVELS.index(0.9)] == pytest.approx(0.589, abs=0.01)
