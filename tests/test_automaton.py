"""The avalanche automaton: laws, then values, then gradients."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_gradient, assert_volume_kept

from wlplan.automaton import (
    FLOW_FRACTION,
    Schedule,
    Terrain,
    pad_pile,
    relax,
    settle,
    settle_window,
    steepest_slope,
    sweep,
    sweeps,
    terrain_of,
    window_of,
)
from wlplan.types import Pile, Pose

REPOSE = math.radians(32.0)
DROP = 0.1 * math.tan(REPOSE)


def rough(seed=0, shape=(48, 40), amplitude=0.3):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    cone = np.maximum(1.5 - 0.08 * np.hypot(x - shape[0] / 2, y - shape[1] / 2), 0.0)
    return jnp.asarray(cone + amplitude * rng.random(shape), jnp.float32)


def dug_cone(shape=(96, 96)):
    """A 31 degree cone with a bucket-sized hole in its side."""
    x, y = np.meshgrid(0.1 * np.arange(shape[0]), 0.1 * np.arange(shape[1]), indexing="ij")
    slope = math.tan(math.radians(31.0))
    height = np.maximum(3.5 - slope * np.hypot(x - 7.0, y - 4.8), 0.0)
    hole = (np.abs(y - 4.8) < 1.35) & (x > 1.2) & (x < 3.5)
    return jnp.asarray(np.where(hole, np.minimum(height, 0.1), height), jnp.float32)


@pytest.mark.parametrize("seed", range(3))
def test_sweeps_and_settling_keep_the_volume(seed):
    height = rough(seed)
    assert_volume_kept(height, sweeps(height, DROP, None, 100))
    assert_volume_kept(height, settle(height, cell_size=0.1, repose_angle=REPOSE))


def test_a_sweep_moves_one_edge_by_hand():
    height = jnp.asarray([[1.0, 0.0]])
    flow = FLOW_FRACTION * (1.0 - DROP)
    # The mirrored border repeats the pair at its diagonals.
    diagonal = FLOW_FRACTION * (1.0 - math.sqrt(2.0) * DROP)
    moved = flow + 2 * diagonal
    np.testing.assert_allclose(sweep(height, DROP), [[1.0 - moved, moved]], rtol=1e-6)


def test_a_settled_pile_stays_settled():
    x, y = np.meshgrid(np.arange(48), np.arange(40), indexing="ij")
    noise = 0.01 * np.random.default_rng(0).random((48, 40))
    gentle = jnp.asarray(np.maximum(1.0 - 0.04 * np.hypot(x - 24, y - 20), 0.0) + noise)
    pile = Pile(gentle.astype(jnp.float32), 0.1)
    assert steepest_slope(pile) < REPOSE
    np.testing.assert_array_equal(
        settle(pile.height, cell_size=0.1, repose_angle=REPOSE), pile.height
    )
    np.testing.assert_array_equal(relax(pile).height, pile.height)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_rotating_commutes_with_settling(turns):
    height = rough(shape=(48, 48))
    straight = settle(height, cell_size=0.1, repose_angle=REPOSE)
    turned = settle(jnp.rot90(height, turns), cell_size=0.1, repose_angle=REPOSE)
    np.testing.assert_allclose(jnp.rot90(straight, turns), turned, atol=1e-6)


def test_reflecting_commutes_with_settling():
    height = rough(shape=(48, 48))
    straight = settle(height, cell_size=0.1, repose_angle=REPOSE)
    np.testing.assert_allclose(
        straight[:, ::-1],
        settle(height[:, ::-1], cell_size=0.1, repose_angle=REPOSE),
        atol=1e-6,
    )


def test_a_sweep_is_not_expansive():
    """Non-expansive in the 1-norm and the 2-norm, as a symmetric stochastic Jacobian must be."""
    rng = np.random.default_rng(0)
    for seed in range(10):
        a = rough(seed, amplitude=1.0)
        b = a + jnp.asarray(rng.normal(size=a.shape) * 0.2, a.dtype)
        for order in (1, 2):
            before = jnp.linalg.norm((a - b).ravel(), order)
            after = jnp.linalg.norm((sweep(a, DROP) - sweep(b, DROP)).ravel(), order)
            assert after <= before * (1 + 1e-6)


def test_a_sweep_is_monotone():
    a = rough(1, amplitude=1.0)
    b = a + jnp.asarray(np.random.default_rng(0).random(a.shape) * 0.3, a.dtype)
    assert (sweep(b, DROP) - sweep(a, DROP)).min() >= -1e-6


def test_a_batch_equals_its_members():
    heights = jnp.stack([rough(seed) for seed in range(3)])

    def run(height):
        return settle(height, cell_size=0.1, repose_angle=REPOSE)

    np.testing.assert_allclose(jax.vmap(run)(heights), [run(h) for h in heights], atol=2e-6)


def test_the_reference_converges_to_the_angle_of_repose():
    relaxed = sweeps(dug_cone(), DROP, None, 8000)
    assert math.degrees(steepest_slope(Pile(relaxed, 0.1))) < 33.0


def test_settling_a_dig_is_close_to_the_reference():
    """The default schedule, against the converged reference, where the surface has moved."""
    height = dug_cone()
    reference = sweeps(height, DROP, None, 8000)
    fast = settle(height, cell_size=0.1, repose_angle=REPOSE)
    moved = (jnp.abs(reference - height) > 0.005) | (jnp.abs(fast - height) > 0.005)
    error = (jnp.abs(fast - reference) * moved).sum() / moved.sum()
    assert error < 0.03
    assert math.degrees(steepest_slope(Pile(fast, 0.1))) < 34.0


def test_relax_reaches_its_tolerance_on_a_cliff():
    height = jnp.zeros((101, 83)).at[20:60, 20:60].set(4.0)
    relaxed = relax(Pile(height, 0.1))
    assert math.degrees(steepest_slope(relaxed)) <= 33.0 + 1e-3
    assert_volume_kept(height, relaxed.height)
    assert relaxed.height.min() >= 0.0


def test_nothing_slides_below_an_uneven_floor_or_into_unseen_cells():
    x, y = np.meshgrid(np.arange(64), np.arange(64), indexing="ij")
    # A hollow with walls at 20 degrees, and a step that no soil could stand on.
    ground = 0.1 * math.tan(math.radians(20.0)) * np.hypot(x - 32, y - 32) + 1.0 * (x > 50)
    soil = np.where(np.hypot(x - 20, y - 32) < 8, 1.5, 0.0)
    valid = np.ones((64, 64), bool)
    valid[:, :6] = False
    pile = Pile(
        jnp.asarray(ground + soil, jnp.float32),
        0.1,
        ground=jnp.asarray(ground, jnp.float32),
        valid=jnp.asarray(valid),
    )
    relaxed = relax(pile)
    assert_volume_kept(pile.height, relaxed.height)
    assert (relaxed.height - pile.ground).min() >= -1e-5
    np.testing.assert_array_equal(relaxed.height[:, :6], pile.height[:, :6])
    active = terrain_of(pile, REPOSE).active
    assert math.degrees(steepest_slope(relaxed.replace(valid=active))) <= 33.0 + 1e-3


def test_any_size_of_grid_can_be_settled():
    pile = Pile(rough(shape=(47, 41)), 0.1)
    settled = settle_window(pile, repose_angle=REPOSE)
    assert settled.shape == (47, 41)
    assert_volume_kept(pile.height, settled)
    with pytest.raises(ValueError, match="multiple of 8"):
        settle(pile.height, cell_size=0.1, repose_angle=REPOSE)


def test_padding_takes_no_part():
    pile = Pile(rough(shape=(40, 40)), 0.1)
    padded = pad_pile(pile, (44, 48))
    assert not padded.valid[40:].any()
    assert padded.valid[:40, :40].all()


def test_the_window_stays_inside_the_grid_and_holds_the_dig():
    pile = Pile(jnp.zeros((150, 120)), 0.1, (-5.0, 2.0))
    for x, y in ((-5.0, 2.0), (2.0, 8.0), (9.8, 13.8)):
        window, (i, j) = window_of(pile, Pose(*map(jnp.float32, (x, y, 0.3))))
        assert window.height.shape == (96, 96)
        assert 0 <= i <= 150 - 96
        assert 0 <= j <= 120 - 96
        np.testing.assert_allclose(window.origin, [-5.0 + 0.1 * i, 2.0 + 0.1 * j], atol=1e-5)


def test_gradient_of_sweeps_against_finite_differences():
    with jax.enable_x64(True):
        height = jnp.asarray(np.asarray(rough(shape=(10, 9))), jnp.float64)
        weight = jnp.asarray(np.random.default_rng(0).normal(size=height.shape))
        assert_gradient(lambda h: (weight * sweeps(h, DROP, None, 30)).sum(), height, relative=1e-5)


def test_gradient_of_settling_against_finite_differences_with_mask_and_floor():
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        height = jnp.asarray(np.asarray(rough(2, shape=(12, 8))), jnp.float64) + 0.2
        weight = jnp.asarray(rng.normal(size=height.shape))
        active = jnp.asarray(rng.random(height.shape) > 0.05)
        terrain = Terrain(jnp.full(height.shape, 0.1), active)

        def cost(h):
            settled = settle(
                h,
                cell_size=0.1,
                repose_angle=REPOSE,
                terrain=terrain,
                schedule=Schedule(cycles=2, sweeps=(10, 10, 10)),
            )
            return (weight * settled).sum()

        assert_gradient(cost, height, relative=1e-5, skip=4)


def test_gradient_stays_bounded_over_many_sweeps():
    """Unit row sums and symmetry: the cotangent never grows in the largest component."""
    height = rough(3, amplitude=1.0)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=height.shape), height.dtype)
    for count in (1, 100, 2000):
        gradient = jax.grad(lambda h, n=count: (weight * sweeps(h, DROP, None, n)).sum())(height)
        assert jnp.abs(gradient).max() <= jnp.abs(weight).max() * (1 + 1e-5)


def test_gradient_is_finite_on_flat_ground():
    for height in (jnp.zeros((16, 16)), jnp.full((16, 16), 2.0)):
        gradient = jax.grad(lambda h: (settle(h, cell_size=0.1, repose_angle=REPOSE) ** 2).sum())(
            height
        )
        assert jnp.isfinite(gradient).all()
