"""Laws of training and of models on disk."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from wlplan.constants import ACTION_HIGH
from wlplan.dataset import VARIABLES, Dataset, split
from wlplan.errors import InputError
from wlplan.models import storage
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.models.storage import load_model, read_description, save_model
from wlplan.training import (
    LOSSES,
    EvaluationReport,
    PsiLowSettings,
    evaluate_performance,
    fitting,
    held_out,
    shares_piles,
    train,
)

LIGHT = PsiLowSettings(epochs=40, batch=64, hidden=(32, 32), dropout=0.0, learning_rate=1e-2)
ONE_EPOCH = dataclasses.replace(LIGHT, epochs=1)


def synthetic(rollouts: int = 40, loads: int = 15, seed: int = 0) -> Dataset:
    """Cycles whose outcome is a smooth closed form of characteristics and action."""
    n = rollouts * loads
    random = np.random.default_rng(seed)
    low, high = np.array([0.2, 0.0, -0.2, -0.2]), np.array([0.6, 1.0, 0.3, 0.3])
    shape = random.uniform(low, high, (n, 4))
    action = random.uniform(0.0, ACTION_HIGH, (n, 4))
    mass = 2.0 + 3.0 * shape[:, 0] - 0.5 * shape[:, 1] ** 2 + shape[:, 2] - action[:, 0]
    time = 8.0 + 3.0 * action[:, 2] + 0.1 * action[:, 1] ** 2
    work = 120.0 * mass + 20.0 * action[:, 3]
    columns = {name: np.zeros((n, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    columns |= {
        "mass": mass.astype(np.float32),
        "time": time.astype(np.float32),
        "work": work.astype(np.float32),
        "characteristics": shape.astype(np.float32),
        "action": action.astype(np.float32),
        "rollout": np.repeat(np.arange(rollouts, dtype=np.int32), loads),
        "valid": np.ones(n, bool),
    }
    return Dataset(**columns, attributes={"seed": seed, "soil": {"density": 1727.0}})


@pytest.fixture(scope="module")
def data() -> Dataset:
    return synthetic()


@pytest.fixture(scope="module")
def saved(
    data: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, LowPerformanceModel, EvaluationReport]:
    directory = tmp_path_factory.mktemp("training") / "psi_low"
    model, report = train(LIGHT, data, out=directory)
    assert isinstance(report, EvaluationReport)
    return directory, model, report


@pytest.fixture
def copy(saved: tuple[Path, LowPerformanceModel, EvaluationReport], tmp_path: Path) -> Path:
    return shutil.copytree(saved[0], tmp_path / "copy")


def refused(call: Callable[[], object], *words: str) -> None:
    with pytest.raises(InputError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    assert len(message) > 20
    for word in words:
        assert word in message


def leaves(model: Any) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(model)]


def contents(directory: Path) -> dict[Path, tuple[int, bytes]]:
    return {
        p.relative_to(directory): (p.stat().st_mtime_ns, p.read_bytes())
        for p in directory.rglob("*")
        if p.is_file()
    }


# --- training


def test_training_learns_a_closed_form(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport],
) -> None:
    errors = saved[2].loaded
    assert errors.mean_relative["mass"] < 0.02
    assert errors.mean_relative["time"] < 0.02
    assert errors.mean_relative["work"] < 0.02
    for value in errors.total_relative.values():
        assert abs(value) < 0.01


def test_training_reduces_the_loss(
    data: Dataset, saved: tuple[Path, LowPerformanceModel, EvaluationReport]
) -> None:
    description = read_description(saved[0])["training"]
    short, _ = train(ONE_EPOCH, data)
    whole = held_out(data, read_description(saved[0]))
    first = evaluate_performance(short, whole).every.mean_absolute
    assert all(saved[2].every.mean_absolute[name] < 0.5 * first[name] for name in first)
    assert description["best_validation_loss"] <= description["last_validation_loss"]
    assert 1 <= description["best_epoch"] <= LIGHT.epochs


def test_the_same_seed_gives_the_same_weights_and_cycles_that_are_not_valid_play_no_role(
    data: Dataset,
) -> None:
    settings = dataclasses.replace(LIGHT, epochs=2, dropout=0.1, seed=4)
    done = []
    valid = np.arange(len(data)) % 15 != 0
    models = []
    for wrong in (np.nan, 1e3):
        spoilt = dataclasses.replace(
            data, mass=np.where(valid, data.mass, np.float32(wrong)), valid=valid
        )
        model, report = train(settings, spoilt, progress=lambda *n: done.append(n))
        assert isinstance(report, EvaluationReport)
        assert np.isfinite(report.every.mean_relative["mass"])
        models.append(leaves(model))
    assert done == [(1, 2), (2, 2)] * 2
    assert all(np.array_equal(a, b) for a, b in zip(models[0], models[1], strict=True))


def test_the_validation_part_chooses_the_weights() -> None:
    """A learning rate that blows the network up late must not cost what was learnt before."""
    graph, *states = nnx.split(PsiLow((8,), rngs=nnx.Rngs(0)), nnx.Param, ...)
    params, rest = states
    optimiser = optax.sgd(1e3)
    fit = fitting.Fit(
        params, rest, optimiser.init(params), (params, rest), jnp.asarray(1e-9), jnp.asarray(7)
    )
    examples = (jnp.ones((64, 8)), jnp.zeros((64, 3)))
    after, _ = fitting._epoch(
        graph,
        lambda network, e, rngs: jnp.mean((network(e[0], rngs=rngs) - e[1]) ** 2),
        optimiser,
        32,
        None,
        fit,
        jax.random.key(0),
        jnp.asarray(8),
        examples,
        examples,
    )
    assert int(after.best_epoch) == 7
    assert float(after.best_loss) == pytest.approx(1e-9)
    best, kept = jax.tree.leaves(after.best), jax.tree.leaves((params, rest))
    assert all(np.array_equal(a, b) for a, b in zip(best, kept, strict=True))


def test_data_that_cannot_be_trained_on_is_refused(data: Dataset) -> None:
    few = data.select(data.rollout < 2)
    refused(lambda: train(LIGHT, few), "2 rollouts")
    holed = dataclasses.replace(data, time=np.where(data.rollout == 3, np.nan, data.time))
    refused(lambda: train(LIGHT, holed), "not finite")
    none = dataclasses.replace(data, valid=np.zeros(len(data), bool))
    refused(lambda: train(LIGHT, none), "valid")
    refused(lambda: dataclasses.replace(LIGHT, epochs=0), "at least 1")


# --- the paper's protocol


def test_patience_ends_a_training_that_gets_no_better(data: Dataset, tmp_path: Path) -> None:
    settings = dataclasses.replace(
        LIGHT, hidden=(8,), optimiser="adam", learning_rate=1e-30, epochs=9, patience=3
    )
    seen: list[int] = []
    train(settings, data, out=tmp_path / "m", progress=lambda done, _: seen.append(done))
    # The first epoch is the best of all that change nothing.
    assert seen == [1, 2, 3, 4]
    record = read_description(tmp_path / "m")["training"]
    assert (record["epochs"], record["best_epoch"]) == (4, 1)
    assert record["optimiser"] == "Adam, constant rate"
    saved = fitting.SavedState(tmp_path / ".m.training.npz", {})
    assert saved.load(fitting.Fit(*[0.0] * 6)) is None


def test_a_training_that_still_gets_better_goes_on_to_its_end() -> None:
    others = dict.fromkeys(("params", "rest", "optimiser", "best", "best_loss"))
    fits = [fitting.Fit(**others, best_epoch=jnp.asarray(epoch)) for epoch in (5, 2, [2, 5])]
    assert [fitting._is_converged(fit, 6, 3) for fit in fits] == [False, True, False]
    assert not fitting._is_converged(fits[1], 1000, 0)


def test_adam_keeps_its_rate_and_lets_weights_be() -> None:
    weights = jnp.ones(4)

    def steps(optimiser: str, gradient: float) -> tuple[jax.Array, list[float]]:
        settings = dataclasses.replace(LIGHT, optimiser=optimiser, learning_rate=1e-2)
        chain = fitting._optimiser(settings, 40)
        state, at, sizes = chain.init(weights), weights, []
        for _ in range(40):
            change, state = chain.update(jnp.full(4, gradient), state, at)
            sizes.append(float(jnp.abs(change).max()))
            at = jnp.asarray(optax.apply_updates(at, change))
        return at, sizes

    assert np.allclose(steps("adam", 1.0)[1], 1e-2, rtol=1e-3)
    sizes = steps("adamw", 1.0)[1]
    assert sizes[0] < 1e-3 < max(sizes)
    assert sizes[-1] < 1e-3
    np.testing.assert_array_equal(steps("adam", 0.0)[0], weights)
    assert float(steps("adamw", 0.0)[0].max()) < 1.0


def test_scaled_by_the_range_a_network_has_no_units_of_its_own(data: Dataset) -> None:
    def scales(scaling: str) -> list[np.ndarray]:
        model, _ = train(dataclasses.replace(ONE_EPOCH, scaling=scaling), data)
        network = nnx.merge(model.graph, model.params)
        units = (network.scale_in, network.scale_out)
        return [np.asarray(each[...]) for unit in units for each in (unit.mean, unit.spread)]

    assert all(set(each.tolist()) <= {0.0, 1.0} for each in scales("min-max"))
    assert not any(set(each.tolist()) <= {0.0, 1.0} for each in scales("spread"))


def test_of_so_many_samples_a_training_sees_no_more_and_the_test_part_stays(
    data: Dataset, tmp_path: Path
) -> None:
    counts = {}
    for samples in (0, 90, 100_000):
        place = tmp_path / str(samples)
        train(dataclasses.replace(ONE_EPOCH, samples=samples), data, out=place)
        counts[samples] = read_description(place)["training"]["cycles"]
    assert counts[90] == [80, 10, counts[0][2]]
    assert counts[100_000] == counts[0]


def test_of_a_model_that_was_split_by_cycle_the_same_cycles_are_held_out(
    data: Dataset, tmp_path: Path
) -> None:
    settings = dataclasses.replace(ONE_EPOCH, split="cycle")
    model, report = train(settings, data, out=tmp_path / "model")
    assert isinstance(report, EvaluationReport)
    part = held_out(data, read_description(tmp_path / "model"))
    assert len(part) == pytest.approx(0.1 * len(data), abs=1)
    assert len(np.unique(part.rollout)) > 0.5 * len(np.unique(data.rollout))
    assert evaluate_performance(model, part).as_dict() == report.as_dict()


def test_a_part_of_the_maps_is_mirrored() -> None:
    maps = jnp.arange(2.0 * 3.0 * 4.0).reshape(2, 3, 4)
    for part, wanted in ((0.0, maps), (1.0, maps[:, :, ::-1])):
        mirrored, which = fitting.mirror_some(jax.random.key(0), maps, part)
        np.testing.assert_array_equal(mirrored, wanted)
        assert which.all() == (part == 1.0)


# --- evaluation


def test_the_errors_are_what_they_are_called(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport], data: Dataset
) -> None:
    _, model, _ = saved
    p = jax.vmap(model.of_view)(jnp.asarray(data.characteristics), jnp.asarray(data.action))
    mass, time, work = (np.asarray(v) for v in (p.mass, p.time, p.work))
    truth = dataclasses.replace(data, mass=mass / 1.25, time=time - 1.0, work=work)
    errors = evaluate_performance(model, truth).every
    assert errors.cycles == len(data)
    assert errors.mean_relative["mass"] == pytest.approx(0.25, rel=1e-4)
    assert errors.total_relative["mass"] == pytest.approx(0.25, rel=1e-4)
    assert errors.mean_absolute["time"] == pytest.approx(1.0, rel=1e-4)
    assert errors.mean_relative["work"] == pytest.approx(0.0, abs=1e-5)


def test_empty_buckets_do_not_drown_the_relative_error(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport], data: Dataset
) -> None:
    _, model, _ = saved
    mass = data.mass.copy()
    mass[::10] = 0.0
    some_empty = evaluate_performance(model, dataclasses.replace(data, mass=mass))
    assert some_empty.loaded.mean_relative["mass"] < 0.05
    assert some_empty.every.mean_relative["mass"] > 10.0
    assert some_empty.loaded.cycles == np.sum(mass >= 0.5)
    json.dumps(some_empty.as_dict(), allow_nan=False)
    empty = dataclasses.replace(data, mass=np.zeros_like(mass))
    refused(lambda: evaluate_performance(model, empty), "nothing to evaluate")


def test_only_the_test_part_of_the_training_data_is_held_out(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport], data: Dataset
) -> None:
    description = read_description(saved[0])
    part = held_out(data, description)
    assert len(part) == saved[2].every.cycles == description["training"]["cycles"][2]
    assert evaluate_performance(saved[1], part).as_dict() == description["held_out"]
    other = synthetic(seed=1)
    assert held_out(other, description) is other


def test_a_data_set_that_begins_with_the_same_piles_is_noticed(
    data: Dataset, tmp_path: Path
) -> None:
    def of_seed(seed: int) -> Dataset:
        return dataclasses.replace(data, attributes={**data.attributes, "seed": seed})

    train(ONE_EPOCH, of_seed(3), out=tmp_path / "model")
    description = read_description(tmp_path / "model")
    assert description["dataset"]["seeds"] == [3]
    assert shares_piles(of_seed(3).select(data.rollout < 3), description)
    assert not shares_piles(of_seed(4), description)
    assert not shares_piles(dataclasses.replace(data, attributes={}), description)


# --- models on disk


def test_of_several_data_sets_each_has_its_own_test_part(data: Dataset, tmp_path: Path) -> None:
    other = synthetic(rollouts=20, seed=1)
    _, report = train(ONE_EPOCH, [data, other], out=tmp_path / "model")
    assert isinstance(report, EvaluationReport)
    description = read_description(tmp_path / "model")
    parts = [held_out(each, description) for each in (data, other)]
    assert [len(set(part.rollout)) for part in parts] == [
        len(set(split(each)[2].rollout)) for each in (data, other)
    ]
    assert report.every.cycles == sum(map(len, parts))
    assert len(held_out(synthetic(seed=2), description)) == len(data)
    # Alone, the first data set keeps the same test part: its errors can be compared.
    train(ONE_EPOCH, data, out=tmp_path / "alone")
    alone = held_out(data, read_description(tmp_path / "alone"))
    np.testing.assert_array_equal(alone.mass, parts[0].mass)


def test_data_sets_of_other_soils_are_not_joined(data: Dataset) -> None:
    other = dataclasses.replace(data, attributes={"soil": {"density": 1500.0}})
    refused(lambda: train(LIGHT, [data, other]), "soil")


def test_few_cycles_far_from_the_others_do_not_spoil_the_rest(data: Dataset) -> None:
    random = np.random.default_rng(0)
    stalls = random.random(len(data)) < 0.03
    time = np.where(stalls, data.time + 60.0, data.time).astype(np.float32)
    stalled = dataclasses.replace(data, time=time)
    errors = {}
    for loss in LOSSES:
        model, _ = train(dataclasses.replace(LIGHT, loss=loss), stalled)
        errors[loss] = evaluate_performance(model, data).every.mean_absolute["time"]
    assert errors["huber"] < 0.5 * errors["squared"]
    refused(lambda: dataclasses.replace(LIGHT, loss="cubed"), "huber, squared")


@pytest.mark.parametrize("loss", LOSSES)
def test_small_errors_count_by_their_square(loss: str) -> None:
    errors = 0.05 * fitting._HUBER * jnp.array([1.0, -2.0])
    small, double = fitting.loss_of_errors(errors, loss)
    assert float(double / small) == pytest.approx(4.0, rel=0.02)
    large, double = fitting.loss_of_errors(jnp.array([10.0, -20.0]), loss)
    assert float(double / large) == pytest.approx({"huber": 2.0, "squared": 4.0}[loss], rel=0.02)


def test_a_model_comes_back_bit_by_bit_and_the_directory_stays_as_it_is(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport],
) -> None:
    directory, model, _ = saved
    before = contents(directory)
    loaded = load_model(directory)
    assert jax.tree.structure(loaded) == jax.tree.structure(model)  # type: ignore[operator]
    for got, want in zip(leaves(loaded), leaves(model), strict=True):
        assert got.dtype == want.dtype == np.float32
        np.testing.assert_array_equal(got, want)
    assert contents(directory) == before


def test_a_relative_path_will_do(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(saved[0].parent)
    assert leaves(load_model(saved[0].name))


def test_a_model_is_small_and_names_no_place_of_this_machine(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport], tmp_path: Path
) -> None:
    files = [path for path in saved[0].rglob("*") if path.is_file()]
    assert len(files) < 20
    assert sum(path.stat().st_size for path in files) < 100_000
    here = str(saved[0].parent).encode()
    assert not any(here in path.read_bytes() for path in files)


def test_the_description_says_where_a_model_comes_from(
    saved: tuple[Path, LowPerformanceModel, EvaluationReport], data: Dataset
) -> None:
    description = read_description(saved[0])
    assert description["format"] == "wlplan.model/1"
    assert description["kind"] == "psi_low"
    assert description["architecture"]["hidden"] == [32, 32]
    assert description["dataset"]["soil"] == data.attributes["soil"]
    assert description["dataset"]["fingerprints"][0].startswith("sha256:")
    assert description["held_out"]["loaded"]["mean_relative"]["mass"] < 0.02
    assert description["training"]["settings"] == LIGHT.as_dict()
    assert set(description["versions"]) >= {"wlplan", "jax", "numpy"}


def test_saving_replaces_a_model_and_nothing_else(
    copy: Path, saved: tuple[Path, LowPerformanceModel, EvaluationReport], tmp_path: Path
) -> None:
    (copy / "weights" / "left.over").write_text("old")
    save_model(copy, saved[1], {"note": "second"})
    assert read_description(copy)["note"] == "second"
    assert not (copy / "weights" / "left.over").exists()
    load_model(copy)

    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("keep me")
    refused(lambda: save_model(other, saved[1], {}), "not a model")
    refused(lambda: save_model(other / "thesis.txt", saved[1], {}), "is a file")
    (other / "model.json").write_text('{"name": "their model"}')
    refused(lambda: save_model(other, saved[1], {}), "thesis.txt")
    (other / "thesis.txt").unlink()
    refused(lambda: save_model(other, saved[1], {}), "not a model")
    (copy / "thesis.txt").write_text("keep me")
    refused(lambda: save_model(copy, saved[1], {}), "thesis.txt")
    assert (copy / "thesis.txt").read_text() == "keep me"
    assert (other / "model.json").read_text() == '{"name": "their model"}'
    (tmp_path / "file").write_text("")
    refused(lambda: save_model(tmp_path / "file" / "model", saved[1], {}), "is a file")
    save_model(tmp_path / "missing" / "folder" / "model", saved[1], {})
    load_model(tmp_path / "missing" / "folder" / "model")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["copy", "file", "missing", "other"]


def test_a_failed_save_leaves_the_old_model(
    copy: Path,
    saved: tuple[Path, LowPerformanceModel, EvaluationReport],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = contents(copy)

    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage, "_digests", fails)
    refused(lambda: save_model(copy, saved[1], {}), "No space")
    assert contents(copy) == before
    assert [p.name for p in copy.parent.iterdir()] == ["copy"]


def test_a_bad_place_is_refused_before_the_training(data: Dataset, tmp_path: Path) -> None:
    done = []
    (tmp_path / "file").write_text("")
    place = tmp_path / "file" / "b"
    refused(lambda: train(LIGHT, data, out=place, progress=lambda *n: done.append(n)), "is a file")
    assert not done


def test_a_missing_or_foreign_model_is_refused(tmp_path: Path, copy: Path) -> None:
    refused(lambda: load_model(tmp_path / "nothing"), "no such model")
    refused(lambda: load_model(tmp_path), "not a model")
    document = json.loads((copy / "model.json").read_text())
    for change in ({"format": "wlplan.model/9"}, {"kind": "psi_high"}):
        (copy / "model.json").write_text(json.dumps({**document, **change}))
        refused(lambda: load_model(copy), *change.values())
    (copy / "model.json").write_text((json.dumps(document))[:200])
    refused(lambda: load_model(copy), "not a model")
    (copy / "model.json").write_text("[]")
    refused(lambda: load_model(copy), "not a model")


def test_every_truncated_or_missing_file_is_noticed(copy: Path) -> None:
    files = [path for path in copy.rglob("*") if path.is_file() and path.name != "model.json"]
    for path in files:
        content = path.read_bytes()
        path.write_bytes(content[:-1])
        refused(lambda: load_model(copy), "damaged")
        path.unlink()
        refused(lambda: load_model(copy), "damaged")
        path.write_bytes(content)
    load_model(copy)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.pop("normaliser"),
        lambda d: d["architecture"].update(hidden=[32, 16]),
        lambda d: d["architecture"].update(activation="sine"),
        lambda d: d["normaliser"]["inputs"].update(low=[0.0]),
    ],
)
def test_a_description_that_does_not_fit_the_weights_is_refused(
    copy: Path, spoil: Callable[[dict[str, Any]], object]
) -> None:
    document = json.loads((copy / "model.json").read_text())
    spoil(document)
    (copy / "model.json").write_text(json.dumps(document))
    refused(lambda: load_model(copy), "damaged")
