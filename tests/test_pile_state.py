"""Laws of the pile state predictors: mass exact, never below ground, finite on flat ground."""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from wlplan.dataset import VARIABLES, Dataset
from wlplan.errors import InputError
from wlplan.models.normaliser import Normaliser
from wlplan.models.phi import HeightChange, HeightChangeModel, Patterns, project
from wlplan.models.phi_vae import (
    PhiVae,
    VaePileStateModel,
    _gathered,
    _scattered,
    blended,
    scaled,
)
from wlplan.models.psi_high import HighPerformanceModel, PsiHigh
from wlplan.models.storage import load_model
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton import relax
from wlplan.terrain.automaton.slopes import steepest_slope
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.training import PhiSettings, PhiVaeSettings, PileStateErrors, evaluate_pile_state, train
from wlplan.types import LocalHeightmap, Performance, Pile, Pose, action_from
from wlplan.worlds.learned import LearnedWorld

ACTION = jnp.array([0.3, 2.0, 0.2, 3.0])


def slopes(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Maps of a slope that begins 1 m in, and the same with a dig of some size."""
    random = np.random.default_rng(seed)
    x = np.maximum(np.arange(52) * 0.1 - 1.0, 0.0)
    steep = random.uniform(0.3, 0.7, count)
    before = steep[:, None, None] * x[None, :, None] + random.normal(0.0, 0.01, (count, 52, 52))
    deep = random.uniform(0.1, 0.3, count)
    dig = np.zeros((52, 52))
    dig[12:36, 13:39] = 1.0
    after = before - np.minimum(deep[:, None, None] * dig, np.maximum(before, 0.0))
    return before.astype(np.float32), after.astype(np.float32)


@functools.cache
def model_of() -> HeightChangeModel:
    network = nnx.jit(lambda: HeightChange((32,), rngs=nnx.Rngs(0)))()
    before, after = (jnp.asarray(v) for v in slopes(60))
    random = np.random.default_rng(1)
    known = jnp.asarray(random.uniform(0.0, 2.0, (60, 5)), jnp.float32)
    network.fit_scales(before, after - before, known)
    # Near the mean change: without training the weights are of another size.
    kernel = network.weights.output.kernel
    kernel[...] = 0.002 * kernel[...]
    graph, params = nnx.split(network)
    return HeightChangeModel(params, graph)


def local(height: jax.Array) -> LocalHeightmap:
    return LocalHeightmap(jnp.asarray(height), 0.1, 1.0)


# --- mass


@pytest.mark.parametrize("volume", [0.0, 0.3, 1.7])
def test_exactly_the_wanted_volume_leaves_and_nothing_goes_below_the_floor(volume: float) -> None:
    random = np.random.default_rng(0)
    change = jnp.asarray(random.normal(-0.1, 0.2, (52, 52)), jnp.float32)
    above = jnp.asarray(slopes(1)[0][0].clip(0.0))
    got = project(change, above, jnp.asarray(volume, jnp.float32))
    assert -float(got.sum()) * 0.01 == pytest.approx(volume, abs=2e-5)
    assert float((above + got).min()) >= -1e-6
    assert (np.asarray(got)[np.asarray(change) > 0.0] >= 0.0).all()


def test_where_too_little_is_there_all_of_it_leaves_and_nothing_appears() -> None:
    above = jnp.full((52, 52), 0.01)
    change = jnp.full((52, 52), -0.2).at[:10].set(0.1)
    got = project(change, above, jnp.asarray(5.0))
    assert float((above + got).min()) >= -1e-7
    assert float(got.sum()) <= 1e-6


def test_the_projection_passes_gradients_and_stays_finite_on_flat_ground() -> None:
    change = jnp.asarray(np.random.default_rng(0).normal(-0.1, 0.1, (52, 52)), jnp.float32)
    volume = jnp.asarray(1.0)
    above = jnp.asarray(slopes(1)[0][0].clip(0.0))
    assert float(jax.grad(lambda v: -project(change, above, v).sum() * 0.01)(volume)) == (
        pytest.approx(1.0, rel=1e-4)
    )
    gradient = jax.jit(jax.grad(lambda *a: (project(*a) ** 2).sum(), (0, 1, 2)))
    for ground in (above, jnp.zeros((52, 52))):
        for wanted in (change, jnp.zeros((52, 52))):
            slope = gradient(wanted, ground, volume)
            assert all(np.isfinite(s).all() for s in slope)


# --- ours


def test_patterns_give_back_what_they_were_made_from() -> None:
    before, after = (jnp.asarray(v) for v in slopes(40))
    patterns = Patterns(20)
    patterns.fit(after - before)
    again = patterns.maps(patterns.weights(after - before))
    assert float(jnp.abs(again - (after - before)).mean()) < 1e-3
    assert float(jnp.abs(after - before).mean()) > 1e-2


def test_the_change_has_the_mass_and_a_finite_gradient() -> None:
    model = model_of()

    def after(height: jax.Array, action: jax.Array, volume: jax.Array) -> jax.Array:
        ground = jnp.zeros((52, 52))
        return height + model(local(height), action, volume, ground)

    gradient = jax.jit(jax.grad(lambda *a: (after(*a) ** 2).sum(), (0, 1, 2)))
    for height in (jnp.asarray(slopes(1)[0][0].clip(0.0)), jnp.zeros((52, 52))):
        slope = gradient(height, ACTION, jnp.asarray(0.5))
        assert all(np.isfinite(s).all() for s in slope)
    steep = jnp.asarray(slopes(1)[0][0].clip(0.0))
    left = (steep - after(steep, ACTION, jnp.asarray(0.5))).sum() * 0.01
    assert float(left) == pytest.approx(0.5, abs=1e-4)
    with pytest.raises(InputError, match="cells=52"):
        model(local(jnp.zeros((36, 36))), ACTION, jnp.asarray(0.5), jnp.zeros((36, 36)))


# --- the paper's


@functools.cache
def papers_model() -> VaePileStateModel:
    graph, params = nnx.split(nnx.jit(lambda: PhiVae((16,), rngs=nnx.Rngs(0)))())
    return VaePileStateModel(params, graph)


def test_patches_come_back() -> None:
    maps = jnp.arange(2.0 * 4 * 4 * 3).reshape(2, 4, 4, 3)
    np.testing.assert_array_equal(_scattered(_gathered(maps)), maps)
    np.testing.assert_array_equal(_gathered(maps)[0, 0, 0, :6], maps[0, 0, :2].ravel())


def test_scaling_and_blending() -> None:
    before, after = (jnp.asarray(v[0]) for v in slopes(1))
    unit, low, span = scaled(before, jnp.zeros((52, 52)))
    assert (float(unit.min()), float(unit.max())) == (0.0, 1.0)
    np.testing.assert_allclose(low + span * unit, before, atol=1e-6)
    mixed = before + blended(after - before)
    np.testing.assert_array_equal(mixed[0], before[0])
    np.testing.assert_array_equal(mixed[:, -1], before[:, -1])
    np.testing.assert_allclose(mixed[10:-10, 10:-10], after[10:-10, 10:-10], atol=1e-6)


def test_the_papers_model_is_finite_on_flat_ground() -> None:
    model = papers_model()

    def cost(height: jax.Array, action: jax.Array) -> jax.Array:
        return ((height + model(local(height), action, jnp.zeros(()), height)) ** 2).sum()

    gradient = jax.jit(jax.grad(cost, (0, 1)))
    for height in (jnp.zeros((52, 52)), jnp.asarray(slopes(1)[0][0])):
        slope = gradient(height, ACTION)
        assert all(np.isfinite(s).all() for s in slope)
    assert float(jnp.abs(slope[1]).max()) > 0.0


def test_the_papers_model_predicts_a_change_that_fades_along_the_edges_or_not() -> None:
    height = jnp.asarray(slopes(1)[0][0])

    @jax.jit
    def change(model: VaePileStateModel) -> jax.Array:
        return model(local(height), ACTION, jnp.ones(()), jnp.zeros((52, 52)))

    blending, plain = (
        change(model) for model in (papers_model(), papers_model().replace(blend=False))
    )
    np.testing.assert_array_equal(blending, blended(plain))
    np.testing.assert_array_equal(blending[0], 0.0)
    assert np.any(plain[0] != 0.0)


def test_which_predictor_conserves_the_volume_is_said() -> None:
    assert HeightChangeModel.conserves_volume
    assert not VaePileStateModel.conserves_volume


# --- training, worlds


@pytest.fixture(scope="module")
def data() -> Dataset:
    before, after = slopes(240)
    n = len(before)
    columns = {name: np.zeros((n, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    volume = (before - after).sum(axis=(1, 2)) * 0.01
    columns |= {
        "h52": before,
        "h52_after": after,
        "mass": (volume * 1.727).astype(np.float32),
        "rollout": np.repeat(np.arange(24, dtype=np.int32), 10),
        "valid": np.ones(n, bool),
    }
    return Dataset(**columns, attributes={"soil": {"density": 1727.0}})


def test_training_learns_the_change_and_a_model_comes_back(data: Dataset, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"hidden": (32,), "batch": 32, "dropout": 0.0, "learning_rate": 1e-2}
    model, errors = train(PhiSettings(epochs=30, **settings), data, out=tmp_path / "phi")
    assert isinstance(errors, PileStateErrors)
    unchanged = np.abs(data.h52 - data.h52_after).sum(axis=(1, 2)).mean() * 0.01
    assert errors.mean_absolute < 0.2 * unchanged
    assert abs(errors.total_volume) < 1e-4
    loaded = load_model(tmp_path / "phi", "phi")
    for got, want in zip(jax.tree.leaves(loaded), jax.tree.leaves(model), strict=True):
        np.testing.assert_array_equal(got, want)
    assert [path.name for path in tmp_path.iterdir()] == ["phi"]


def test_the_errors_are_those_of_the_papers_formulas(data: Dataset) -> None:
    model = model_of()
    errors = evaluate_pile_state(model, data)
    volume = jnp.asarray(data.mass / 1.727)

    @jax.jit
    def one(height: jax.Array, volume: jax.Array) -> jax.Array:
        floor = jnp.full((52, 52), height.min())
        return height + model(local(height), jnp.zeros(4), volume, floor)

    after = [one(*each) for each in zip(jnp.asarray(data.h52[:20]), volume[:20], strict=True)]
    wrong = np.abs(np.stack(after) - data.h52_after[:20]).sum(axis=(1, 2)) * 0.01
    under = np.abs(data.h52_after[:20]).sum(axis=(1, 2)) * 0.01
    few = evaluate_pile_state(model, data.select(np.arange(20)))
    assert few.mean_absolute == pytest.approx(wrong.mean(), rel=1e-4)
    assert few.mean_relative == pytest.approx((wrong / under).mean(), rel=1e-4)
    assert errors.cycles == 240


def test_what_a_code_holds_of_a_map_moves_with_it(data: Dataset) -> None:
    phi = nnx.jit(lambda: PhiVae((8,), rngs=nnx.Rngs(0)))()
    phi.mean[...] = jnp.asarray(data.h52.mean(axis=0))
    graph, params = nnx.split(phi)
    model = VaePileStateModel(params, graph)
    reconstruction = jax.jit(lambda model, height: model.reconstruction(local(height)))
    height = jnp.asarray(data.h52[3])
    held = reconstruction(model, height)
    assert held.shape == height.shape
    np.testing.assert_allclose(reconstruction(model, height + 0.5), held + 0.5, atol=1e-4)
    # The decoder alone tells what comes out: one that always says 0 leaves the least height.
    for layer in phi.vae.up:
        layer.kernel[...] = jnp.zeros_like(layer.kernel)
        assert layer.bias is not None
        layer.bias[...] = jnp.zeros_like(layer.bias)
    empty = reconstruction(VaePileStateModel(nnx.split(phi)[1], graph), height)
    np.testing.assert_allclose(empty - phi.mean[...], (height - phi.mean[...]).min(), atol=1e-5)


@pytest.mark.slow
def test_both_stages_of_the_paper_are_trained(data: Dataset, tmp_path: Path) -> None:
    done = []
    settings = PhiVaeSettings(epochs=2, hidden=(16,))
    _, errors = train(settings, data, out=tmp_path / "vae", progress=lambda *n: done.append(n))
    assert isinstance(errors, PileStateErrors)
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert np.isfinite(errors.mean_absolute)
    load_model(tmp_path / "vae", "phi_vae")
    assert [path.name for path in tmp_path.iterdir()] == ["vae"]


@pytest.fixture(scope="module")
def psi_high() -> HighPerformanceModel:
    psi = nnx.jit(lambda: PsiHigh((16,), encoder="principal", rngs=nnx.Rngs(0)))()
    # A load of about a tonne, and some that hangs on the inputs.
    assert psi.head.output.bias is not None
    psi.head.output.bias[...] = jnp.full(3, 0.15)
    psi.head.output.kernel[...] = 0.05 * psi.head.output.kernel[...]
    graph, params = nnx.split(psi)
    ranges = {
        "maps": np.array([[0.0], [2.5]]),
        "inputs": np.stack([np.zeros(8), np.ones(8)]),
        "outputs": np.array([[0.5, 6.0, 100.0], [4.0, 20.0, 900.0]]),
    }
    normalisers = {name: Normaliser.of(rows.astype(np.float32)) for name, rows in ranges.items()}
    return HighPerformanceModel(params=params, graph=graph, **normalisers)


def first_loading(pile: Pile) -> Pose:
    pose: Pose = jax.tree.map(lambda leaf: leaf[0], edge_poses(toe_contour(pile), 1))
    return pose


def removed(pile: Pile, after: Pile) -> float:
    volume = float(np.asarray(pile.height - after.height, np.float64).sum()) * pile.cell_size**2
    return volume * GRAVEL.density / 1000.0


@pytest.mark.slow
@pytest.mark.parametrize("settle", [True, False])
def test_the_high_world_removes_the_mass_that_it_reports(
    psi_high: HighPerformanceModel, settle: bool
) -> None:
    world = LearnedWorld(psi_high, model_of(), settle=settle)
    pile = relax(seed_pile("conical", slope=np.radians(30.0), height=2.0))
    pose = first_loading(pile)

    def cost(heading: jax.Array) -> tuple[jax.Array, tuple[Pile, Performance]]:
        after, p = world(pile, pose.replace(heading=heading), action_from(ACTION))
        return p.work / p.mass + after.height.mean(), (after, p)

    (_, (after, p)), slope = jax.jit(jax.value_and_grad(cost, has_aux=True))(pose.heading)
    assert float(p.mass) > 0.1
    assert removed(pile, after) == pytest.approx(float(p.mass), rel=1e-4)
    assert float(after.height.min()) >= float(pile.height.min()) - 1e-5
    assert np.isfinite(slope)


def test_a_pile_that_holds_less_than_the_load_gives_what_it_has(
    psi_high: HighPerformanceModel,
) -> None:
    # Two tenths of a tonne in all where about a tonne is predicted.
    pile = seed_pile("conical", slope=np.radians(30.0), height=2.0)
    pose = first_loading(pile)
    thin = pile.replace(height=0.005 * pile.height)
    _, whole = LearnedWorld(psi_high, model_of())(pile, pose, action_from(ACTION))
    after, p = LearnedWorld(psi_high, model_of())(thin, pose, action_from(ACTION))
    assert 0.0 <= float(p.mass) < 0.3 * float(whole.mass)
    assert removed(thin, after) == pytest.approx(float(p.mass), abs=1e-4)
    assert float(after.height.min()) >= -1e-6


def test_only_a_map_that_the_automaton_was_asked_for_is_never_too_steep(
    psi_high: HighPerformanceModel,
) -> None:
    pile = relax(seed_pile("conical", slope=np.radians(30.0), height=2.0))
    pose = first_loading(pile)
    limit = np.radians(1.0) + GRAVEL.repose_angle + 1e-3
    settled, _ = LearnedWorld(psi_high, model_of())(pile, pose, action_from(ACTION))
    left, _ = LearnedWorld(psi_high, model_of(), settle=False)(pile, pose, action_from(ACTION))
    assert float(steepest_slope(settled)) <= limit < float(steepest_slope(left))
    assert float(settled.height.sum()) == pytest.approx(float(left.height.sum()), rel=1e-6)
