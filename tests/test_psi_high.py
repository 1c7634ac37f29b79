"""Laws of ψ_high: encoders, finite gradients on flat ground, training, its worlds."""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from precision import in_float64
from trainings import check_that_a_killed_one_ends_alike

from wlplan.dataset import VARIABLES, Dataset
from wlplan.errors import InputError
from wlplan.models.architecture import ACTIVATIONS, ENCODERS
from wlplan.models.components import PrincipalComponents
from wlplan.models.layers import max_pool, patches, resize
from wlplan.models.normaliser import Normaliser
from wlplan.models.psi_high import HighPerformanceModel, PsiHigh
from wlplan.models.storage import load_model, read_description
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton import relax
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.training import EvaluationReport, PsiHighSettings, train
from wlplan.types import LocalHeightmap, action_from
from wlplan.worlds.shipped import load_world

LOW = np.array([0.1, 0.0, -0.25, -0.25, 0.0, 0.0, 0.0, 0.0], np.float32)
HIGH = np.array([0.6, 1.8, 0.4, 0.45, 0.7, 5.0, 0.7, 5.0], np.float32)
OUT = np.array([[0.1, 6.0, 110.0], [4.8, 21.0, 1390.0]], np.float32)
ACTION = jnp.array([0.3, 2.0, 0.2, 3.0])


@functools.cache
def model_of(encoder: str = "principal", activation: str = "swish") -> HighPerformanceModel:
    maps = jnp.stack([surface(k, 0.2 + 0.05 * k) for k in range(8)])
    random = np.random.default_rng(0)
    inputs, outputs = (jnp.asarray(random.uniform(size=(8, n)), jnp.float32) for n in (8, 3))

    @nnx.jit
    def network() -> PsiHigh:
        made = PsiHigh((32, 32), encoder=encoder, activation=activation, rngs=nnx.Rngs(0))
        made.fit_scales(maps, inputs, outputs)
        return made

    graph, params = nnx.split(network())
    ranges = {
        "maps": np.array([[-0.2], [2.7]], np.float32),
        "inputs": np.stack([LOW, HIGH]),
        "outputs": OUT,
    }
    normalisers = {name: Normaliser.of(rows) for name, rows in ranges.items()}
    return HighPerformanceModel(params=params, graph=graph, **normalisers)


def surface(seed: int = 0, slope: float = 0.6) -> jax.Array:
    x = np.linspace(0.0, 3.5, 36)
    rough = np.random.default_rng(seed).normal(0.0, 0.05, (36, 36))
    return jnp.asarray((slope * x[:, None] + rough).astype(np.float32))


@jax.jit
def performance(
    model: HighPerformanceModel, height: jax.Array, action: jax.Array = ACTION
) -> jax.Array:
    p = model(LocalHeightmap(height, 0.1, 0.0), action)
    return jnp.stack([p.mass, p.time, p.work])


# --- layers


def test_patches_and_a_matrix_product_are_a_convolution() -> None:
    random = np.random.default_rng(0)
    maps = jnp.asarray(random.normal(size=(5, 8, 8, 3)), jnp.float32)
    kernel = jnp.asarray(random.normal(size=(3, 3, 3, 4)), jnp.float32)
    wanted = jax.lax.conv_general_dilated(
        maps, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    near = patches(jnp.moveaxis(jnp.moveaxis(maps, 0, -1), 2, 0))
    got = (kernel.reshape(27, 4).T @ near.reshape(27, -1)).reshape(4, 8, 8, 5)
    np.testing.assert_allclose(jnp.moveaxis(got, (0, 3), (3, 0)), wanted, atol=1e-4)


def test_pooling_takes_the_largest_and_shares_the_gradient_of_equals() -> None:
    maps = jnp.arange(16.0).reshape(1, 4, 4, 1)
    np.testing.assert_array_equal(max_pool(maps).ravel(), [5.0, 7.0, 13.0, 15.0])
    slope = jax.grad(lambda m: max_pool(m).sum())(jnp.zeros((1, 2, 2, 1)))
    np.testing.assert_allclose(slope.ravel(), 0.25)


def test_resizing_keeps_planes_and_corners() -> None:
    x, y = np.meshgrid(np.linspace(0, 1, 36), np.linspace(0, 1, 36), indexing="ij")
    small = resize(jnp.asarray(2.0 * x - y, jnp.float32), 32)
    x, y = np.meshgrid(np.linspace(0, 1, 32), np.linspace(0, 1, 32), indexing="ij")
    np.testing.assert_allclose(small, 2.0 * x - y, atol=1e-6)


def test_components_of_mirrored_maps_are_the_same_or_opposite() -> None:
    maps = jnp.stack([surface(seed, 0.3 + 0.02 * seed) for seed in range(20)])
    encoder = PrincipalComponents()
    encoder.fit(maps)
    basis = np.asarray(encoder.basis[...])
    np.testing.assert_allclose(basis.T @ basis, np.eye(24), atol=1e-3)
    # The others may mix within pairs of like variance.
    first = encoder(maps[3])[0], encoder(maps[3, :, ::-1])[0]
    assert float(abs(first[0])) == pytest.approx(float(abs(first[1])), rel=1e-3)
    assert float(abs(first[0])) > 0.1


# --- the network


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_special_model_of_the_paper_has_its_size(activation: str) -> None:
    network = nnx.eval_shape(lambda: PsiHigh((2048, 2048), activation=activation, rngs=nnx.Rngs(0)))
    count = sum(leaf.size for leaf in jax.tree.leaves(nnx.state(network, nnx.Param)))
    convolutions = (9 + 1) * 10 + 2 * (90 + 1) * 10 + 3 * 20
    head = (36 + 1) * 2048 + 2049 * 2048 + 2049 * 3
    assert count == convolutions + (160 + 1) * 32 + head


@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_batch_equals_its_members(encoder: str) -> None:
    model = model_of(encoder)
    heights = jnp.stack([surface(seed) for seed in range(4)])
    batch = jax.jit(jax.vmap(lambda h: performance(model, h)))(heights)
    single = jnp.stack([performance(model, h) for h in heights])
    np.testing.assert_allclose(batch, single, rtol=2e-4)


def test_norms_follow_the_batch_in_training_alone() -> None:
    network = nnx.jit(lambda: PsiHigh((8,), rngs=nnx.Rngs(0)))()
    maps, inputs = jnp.stack([surface(0), surface(1)]), jnp.full((2, 8), 0.5)
    before = jax.tree.leaves(nnx.state(network, nnx.BatchStat))
    nnx.jit(lambda n: n(maps, inputs))(network)
    same = jax.tree.leaves(nnx.state(network, nnx.BatchStat))
    assert all(np.array_equal(a, b) for a, b in zip(before, same, strict=True))
    nnx.jit(lambda n: n(maps, inputs, rngs=nnx.Rngs(0)))(network)
    after = jax.tree.leaves(nnx.state(network, nnx.BatchStat))
    assert not all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize(
    ("encoder", "activation"),
    [
        ("principal", "swish"),
        ("convolutional", "swish"),
        pytest.param("principal", "leaky_relu", marks=pytest.mark.slow),
        pytest.param("convolutional", "leaky_relu", marks=pytest.mark.slow),
    ],
)
def test_the_gradient_is_finite_on_flat_ground_and_finds_the_action(
    encoder: str, activation: str
) -> None:
    model = model_of(encoder, activation)
    jacobian = jax.jit(jax.jacrev(lambda h, a: performance(model, h, a), (0, 1)))
    for height in (jnp.zeros((36, 36)), jnp.full((36, 36), 1e6), surface()):
        by_height, by_action = jacobian(height, ACTION)
        assert np.isfinite(by_height).all()
        assert np.isfinite(by_action).all()
    assert np.abs(by_height).max() > 0.0
    assert np.abs(by_action).max() > 0.0


@pytest.mark.parametrize("encoder", ENCODERS)
def test_the_gradient_agrees_with_finite_differences(encoder: str) -> None:
    single = model_of(encoder)
    with jax.enable_x64(True):
        model = in_float64(single)
        height = jnp.asarray(surface(), jnp.float64)
        along = jnp.asarray(np.random.default_rng(3).normal(0.0, 0.1, (36, 36)))

        def mass(t: jax.Array) -> jax.Array:
            found: jax.Array = performance(model, height + t * along, ACTION.astype(jnp.float64))
            return found[0]

        slope = jax.grad(mass)(jnp.asarray(0.0))
        step = 1e-6
        wanted = (mass(jnp.asarray(step)) - mass(jnp.asarray(-step))) / (2.0 * step)
        assert float(slope) == pytest.approx(float(wanted), rel=1e-4)


def test_wrong_maps_and_architectures_are_refused() -> None:
    with pytest.raises(InputError, match="cells=36"):
        performance(model_of(), jnp.zeros((52, 52)))
    with pytest.raises(InputError, match="encoder"):
        PsiHigh(encoder="magic", rngs=nnx.Rngs(0))


# --- training and worlds


def cycles(rollouts: int = 40, loads: int = 8, seed: int = 0) -> Dataset:
    """Cycles whose mass follows from a part of the map that no mean of it tells."""
    n = rollouts * loads
    random = np.random.default_rng(seed)
    maps = np.stack([np.asarray(surface(k, s)) for k, s in enumerate(random.uniform(0.3, 0.8, n))])
    bump = random.uniform(0.0, 0.5, n).astype(np.float32)
    maps[:, 8:16, 12:24] += bump[:, None, None]
    columns = {name: np.zeros((n, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    columns |= {
        "h36": maps.astype(np.float32),
        "action": random.uniform(0.0, 0.7, (n, 4)).astype(np.float32),
        "characteristics": random.uniform(0.0, 0.3, (n, 4)).astype(np.float32),
        "mass": 2.0 + 3.0 * bump,
        "time": 8.0 + bump,
        "work": 300.0 + 100.0 * bump,
        "rollout": np.repeat(np.arange(rollouts, dtype=np.int32), loads),
        "valid": np.ones(n, bool),
    }
    return Dataset(**columns, attributes={})


SETTINGS: dict[str, Any] = {"hidden": (32,), "batch": 32, "dropout": 0.0, "learning_rate": 1e-2}


def test_training_reads_the_map_and_a_model_comes_back_bit_by_bit(tmp_path: Path) -> None:
    data = cycles()
    model, report = train(PsiHighSettings(epochs=20, **SETTINGS), data, out=tmp_path / "m")
    assert isinstance(report, EvaluationReport)
    # Without the map nothing is known: the mean would be 11 % off.
    assert report.every.mean_relative["mass"] < 0.06
    loaded = load_model(tmp_path / "m", "psi_high")
    assert jax.tree.structure(loaded) == jax.tree.structure(model)  # type: ignore[operator]
    for got, want in zip(jax.tree.leaves(loaded), jax.tree.leaves(model), strict=True):
        np.testing.assert_array_equal(got, want)
    assert [path.name for path in tmp_path.iterdir()] == ["m"]
    assert read_description(tmp_path / "m", "psi_high")["architecture"]["encoder"] == "principal"
    with pytest.raises(InputError, match="psi_low"):
        load_model(tmp_path / "m")

    world = load_world("hybrid", model=tmp_path / "m")
    pile = relax(seed_pile("conical", slope=np.radians(30.0), height=2.0))
    pose = jax.tree.map(lambda leaf: leaf[0], edge_poses(toe_contour(pile), 1))
    after, p = world(pile, pose, action_from(ACTION))
    lost = (pile.height - after.height).sum() * pile.cell_size**2
    assert float(lost * GRAVEL.density / 1000.0) == pytest.approx(float(p.mass), rel=1e-3)


@pytest.mark.parametrize(
    "encoder", ["principal", pytest.param("convolutional", marks=pytest.mark.slow)]
)
def test_a_killed_training_ends_with_the_same_weights(
    encoder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = PsiHighSettings(**(SETTINGS | {"encoder": encoder, "dropout": 0.1, "epochs": 4}))
    check_that_a_killed_one_ends_alike(cycles(rollouts=12), tmp_path, monkeypatch, settings, seed=1)
