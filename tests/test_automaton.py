"""The avalanche automaton: laws, then values, then gradients."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_gradient, assert_volume_kept

from wlplan.site.machine import WA320
from wlplan.studies.bench.digs import Dig, random_digs
from wlplan.terrain.automaton import (
    FLOW_FRACTION,
    Schedule,
    converged,
    movable,
    relax,
    settle,
    settle_dug,
    steepest_slope,
    sweep,
    sweeps,
    window_of,
)
from wlplan.terrain.automaton.flow import slide
from wlplan.terrain.automaton.neighbours import links_of
from wlplan.terrain.automaton.rounds import _add_change
from wlplan.terrain.automaton.windows import pad_pile
from wlplan.terrain.excavation import excavate
from wlplan.types import Pile, Pose

REPOSE = math.radians(32.0)
DROP = 0.1 * math.tan(REPOSE)


def rough(seed: int = 0, shape: tuple[int, int] = (48, 48), amplitude: float = 0.3) -> jax.Array:
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    cone = np.maximum(1.5 - 0.08 * np.hypot(x - shape[0] / 2, y - shape[1] / 2), 0.0)
    return jnp.asarray(cone + amplitude * rng.random(shape), jnp.float32)


def dug_cone(shape: tuple[int, int] = (96, 96)) -> jax.Array:
    """A 31 degree cone with a bucket-sized hole in its side."""
    x, y = np.meshgrid(0.1 * np.arange(shape[0]), 0.1 * np.arange(shape[1]), indexing="ij")
    slope = math.tan(math.radians(31.0))
    height = np.maximum(3.5 - slope * np.hypot(x - 7.0, y - 4.8), 0.0)
    hole = (np.abs(y - 4.8) < 1.35) & (x > 1.2) & (x < 3.5)
    return jnp.asarray(np.where(hole, np.minimum(height, 0.1), height), jnp.float32)


@pytest.mark.parametrize("seed", range(3))
def test_sweeps_and_settling_keep_the_volume(seed: int) -> None:
    height = rough(seed)
    assert_volume_kept(height, sweeps(height, DROP, None, 100))
    assert_volume_kept(height, settle(Pile(height, 0.1)).pile.height)


def test_a_sweep_moves_one_edge_by_hand() -> None:
    height = jnp.asarray([[1.0, 0.0]])
    flow = FLOW_FRACTION * (1.0 - DROP)
    # The mirrored border repeats the pair at its diagonals.
    diagonal = FLOW_FRACTION * (1.0 - math.sqrt(2.0) * DROP)
    moved = flow + 2 * diagonal
    np.testing.assert_allclose(sweep(height, DROP), [[1.0 - moved, moved]], rtol=1e-6)


def test_a_settled_pile_stays_settled() -> None:
    x, y = np.meshgrid(np.arange(48), np.arange(48), indexing="ij")
    noise = 0.01 * np.random.default_rng(0).random((48, 48))
    gentle = jnp.asarray(np.maximum(1.0 - 0.04 * np.hypot(x - 24, y - 24), 0.0) + noise)
    pile = Pile(gentle.astype(jnp.float32), 0.1)
    assert steepest_slope(pile) < REPOSE
    np.testing.assert_array_equal(settle(pile).pile.height, pile.height)
    np.testing.assert_array_equal(relax(pile).height, pile.height)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_rotating_commutes_with_settling(turns: int) -> None:
    height = rough()
    straight = settle(Pile(height, 0.1)).pile.height
    turned = settle(Pile(jnp.rot90(height, turns), 0.1)).pile.height
    np.testing.assert_allclose(jnp.rot90(straight, turns), turned, atol=1e-6)


def test_reflecting_commutes_with_settling() -> None:
    height = rough()
    straight = settle(Pile(height, 0.1)).pile.height
    reflected = settle(Pile(height[:, ::-1], 0.1)).pile.height
    np.testing.assert_allclose(straight[:, ::-1], reflected, atol=1e-6)


def test_a_sweep_is_not_expansive() -> None:
    """Non-expansive in the 1-norm and the 2-norm, as a symmetric stochastic Jacobian must be."""
    rng = np.random.default_rng(0)
    for seed in range(10):
        a = rough(seed, amplitude=1.0)
        b = a + jnp.asarray(rng.normal(size=a.shape) * 0.2, a.dtype)
        for order in (1, 2):
            before = jnp.linalg.norm((a - b).ravel(), order)
            after = jnp.linalg.norm((sweep(a, DROP) - sweep(b, DROP)).ravel(), order)
            assert after <= before * (1 + 1e-6)


def test_a_sweep_is_monotone() -> None:
    a = rough(1, amplitude=1.0)
    b = a + jnp.asarray(np.random.default_rng(0).random(a.shape) * 0.3, a.dtype)
    assert (sweep(b, DROP) - sweep(a, DROP)).min() >= -1e-6


def settled_squares(height: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    """The sum of the squares of the settled heights, those heights, and the gradient."""

    def squares(height: jax.Array) -> tuple[jax.Array, jax.Array]:
        settled = settle(Pile(height, 0.1)).pile.height
        return (settled**2).sum(), settled

    return jax.value_and_grad(squares, has_aux=True)(height)


one_settled = jax.jit(settled_squares)


def test_a_batch_equals_its_members() -> None:
    heights = jnp.stack([rough(seed) for seed in range(3)])
    (_, settled), gradient = jax.jit(jax.vmap(settled_squares))(heights)
    each = [one_settled(height) for height in heights]
    np.testing.assert_allclose(settled, [height for (_, height), _ in each], atol=2e-6)
    np.testing.assert_allclose(gradient, [slope for _, slope in each], rtol=1e-4, atol=1e-5)


def test_the_reference_comes_to_rest_at_the_angle_of_repose() -> None:
    # In float32 ten thousand sweeps round the volume off by some 1e-5.
    with jax.enable_x64(True):
        dug = jnp.asarray(dug_cone(), jnp.float64)
        reference = converged(Pile(dug, 0.1), tolerance=math.radians(0.1))
        assert math.degrees(steepest_slope(reference)) <= 32.1
        assert_volume_kept(dug, reference.height, relative=1e-12)


@pytest.fixture(scope="module")
def digs() -> list[Dig]:
    """A hundred random digs on all seed piles, each pile as the digs before left it."""
    return random_digs(100, seed=0)


def test_after_a_load_no_slope_anywhere_is_more_than_a_degree_too_steep(digs: list[Dig]) -> None:
    """Of the whole pile, not only of the window, load after load."""
    slope = jax.jit(steepest_slope)
    steepest = [math.degrees(slope(dig.after)) for dig in digs]
    assert max(steepest) <= 33.0 + 1e-3


def test_a_load_leaves_the_volume_and_the_ground(digs: list[Dig]) -> None:
    settled = jax.jit(settle)
    for dig in digs[::5]:
        assert_volume_kept(dig.dug.height, settled(dig.dug).pile.height)
        hole = jax.lax.dynamic_update_slice(dig.pile.height, dig.dug.height, dig.start)
        assert_volume_kept(hole, dig.after.height)
        assert dig.after.height.min() >= 0.0
        assert dig.dug.height.sum() < dig.before.height.sum()


def test_settling_a_dig_is_close_to_the_converged_automaton(digs: list[Dig]) -> None:
    """Within 2 cm on average over the disturbed area."""
    settled, reference = jax.jit(settle), jax.jit(converged)
    for dig in digs[:: 100 // 12]:
        fast, slow = settled(dig.dug).pile.height, reference(dig.dug).height
        changes = [jnp.abs(h - dig.dug.height) for h in (dig.before.height, fast, slow)]
        disturbed = jnp.max(jnp.stack(changes), axis=0) > 1e-3
        assert jnp.abs(fast - slow)[disturbed].mean() <= 0.02


def test_an_avalanche_that_leaves_the_window_goes_on_beyond() -> None:
    """A slope at the angle of repose that is longer than the window, undercut at its foot."""
    x = 0.1 * np.arange(160)
    height = np.broadcast_to(math.tan(math.radians(31.9)) * x[:, None], (160, 120))
    pile = Pile(jnp.asarray(height, jnp.float32), 0.1)
    pose = Pose(*(jnp.float32(v) for v in (3.0, 6.0, 0.0)))
    window, start = window_of(pile, pose)
    take = jax.jit(excavate, static_argnames="width")
    dug = take(window, pose, jnp.float32(3.0), width=WA320.bucket_width).pile
    alone = jax.lax.dynamic_update_slice(pile.height, settle(dug).pile.height, start)
    assert math.degrees(steepest_slope(pile.replace(height=alone))) > 33.0
    after = settle_dug(pile, dug.height, start).pile
    assert math.degrees(steepest_slope(after)) <= 33.0 + 1e-3
    end = int(start[0]) + window.height.shape[0]
    assert (after.height != pile.height)[end:].any()
    assert_volume_kept(jax.lax.dynamic_update_slice(pile.height, dug.height, start), after.height)


def test_a_pile_steeper_than_its_soil_slides_without_steps_at_windows() -> None:
    """What is beside a window is not left standing over it."""
    x, y = np.meshgrid(*(0.1 * np.arange(160) - 8.0,) * 2, indexing="ij")
    pile = Pile(jnp.asarray(np.maximum(5.0 - np.hypot(x, y), 0.0), jnp.float32), 0.1, (-8.0, -8.0))
    pose = Pose(*(jnp.float32(v) for v in (-4.8, 0.0, 0.0)))
    window, start = window_of(pile, pose)
    take = jax.jit(excavate, static_argnames="width")
    dug = take(window, pose, jnp.float32(3.0), width=WA320.bucket_width).pile
    settled = settle_dug(pile, dug.height, start)
    assert bool(settled.at_rest)
    # 45 degrees before; and where it slid, it is at rest but for a few places.
    after = np.asarray(settled.pile.height, np.float64)
    steps = np.concatenate([np.abs(np.diff(after, axis=axis)).ravel() for axis in (0, 1)])
    assert steps.max() < 0.1
    assert (steps > 0.1 * math.tan(math.radians(33.1))).mean() < 0.01
    assert (after != np.asarray(pile.height)).mean() > 0.4


def test_a_tighter_tolerance_is_met() -> None:
    for degrees in (0.2, 0.5, 3.0):
        schedule = Schedule(tolerance=math.radians(degrees), most_rounds=50)
        settled = settle(Pile(dug_cone(), 0.1), schedule=schedule).pile
        assert math.degrees(steepest_slope(settled)) <= 32.0 + degrees + 1e-3


def test_relax_reaches_its_tolerance_on_a_cliff() -> None:
    height = jnp.zeros((101, 83)).at[20:60, 20:60].set(4.0)
    relaxed = relax(Pile(height, 0.1))
    assert math.degrees(steepest_slope(relaxed)) <= 33.0 + 1e-3
    assert_volume_kept(height, relaxed.height)
    assert relaxed.height.min() >= 0.0


def test_nothing_slides_below_an_uneven_floor_or_into_unseen_cells() -> None:
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
    assert pile.ground is not None
    assert (relaxed.height - pile.ground).min() >= -1e-5
    np.testing.assert_array_equal(relaxed.height[:, :6], pile.height[:, :6])
    active = movable(pile, REPOSE)
    assert math.degrees(steepest_slope(relaxed.replace(valid=active))) <= 33.0 + 1e-3


def test_any_size_of_grid_can_be_settled() -> None:
    pile = Pile(rough(shape=(47, 41)), 0.1)
    settled = settle(pile).pile
    assert settled.height.shape == (47, 41)
    assert_volume_kept(pile.height, settled.height)


def test_padding_takes_no_part() -> None:
    pile = Pile(rough(shape=(41, 42)), 0.1)
    padded = pad_pile(pile, 4)
    assert padded.height.shape == (44, 44)
    assert padded.valid is not None
    assert not padded.valid[41:].any()
    assert not padded.valid[:, 42:].any()
    assert padded.valid[:41, :42].all()


def test_the_window_stays_inside_the_grid_and_holds_the_dig() -> None:
    pile = Pile(jnp.zeros((150, 120)), 0.1, (-5.0, 2.0))
    for x, y in ((-5.0, 2.0), (2.0, 8.0), (9.8, 13.8)):
        window, (i, j) = window_of(pile, Pose(*map(jnp.float32, (x, y, 0.3))))
        assert window.height.shape == (96, 96)
        assert 0 <= i <= 150 - 96
        assert 0 <= j <= 120 - 96
        np.testing.assert_allclose(window.origin, [-5.0 + 0.1 * i, 2.0 + 0.1 * j], atol=1e-5)


def test_gradient_of_sweeps_against_finite_differences() -> None:
    with jax.enable_x64(True):
        height = jnp.asarray(np.asarray(rough(shape=(10, 9))), jnp.float64)
        weight = jnp.asarray(np.random.default_rng(0).normal(size=height.shape))
        assert_gradient(lambda h: (weight * sweeps(h, DROP, None, 30)).sum(), height, relative=1e-5)


@pytest.mark.parametrize("count", [70, 300])
def test_gradient_of_more_sweeps_than_are_kept(count: int) -> None:
    with jax.enable_x64(True):
        height = jnp.asarray(np.asarray(rough(4, shape=(6, 5))), jnp.float64)
        weight = jnp.asarray(np.random.default_rng(0).normal(size=height.shape))
        assert_gradient(
            lambda h: (weight * sweeps(h, DROP, None, count)).sum(), height, relative=1e-5
        )


def uneven(rng: np.random.Generator, shape: tuple[int, int] = (14, 11)) -> Pile:
    """Noise on a sloping floor, some cells unseen, sides that are no multiple of 4."""
    height = np.asarray(rough(2, shape=shape), np.float64)
    ground = 0.03 * np.arange(shape[0])[:, None] + 0.01 * rng.random(shape)
    return Pile(
        jnp.asarray(np.maximum(height, ground)),
        0.1,
        ground=jnp.asarray(ground),
        valid=jnp.asarray(rng.random(shape) > 0.05),
    )


def test_gradient_of_settling_against_finite_differences_with_mask_and_floor() -> None:
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        pile = uneven(rng)
        weight = jnp.asarray(rng.normal(size=pile.height.shape))

        def cost(h: jax.Array) -> jax.Array:
            return (weight * settle(pile.replace(height=h), repose_angle=REPOSE).pile.height).sum()

        assert jnp.abs(settle(pile).pile.height - pile.height).max() > 0.1
        assert_gradient(cost, pile.height, relative=1e-5, skip=8)


def test_gradient_of_a_bare_floor() -> None:
    """Cells on which nothing lies count as any other."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(2)
        cone = 0.6 - 0.1 * np.hypot(*np.indices((14, 11)) - np.array([5.5, 4.0])[:, None, None])
        height = jnp.asarray(np.maximum(cone, 0.0))
        assert (height == 0.0).sum() > 30
        weight = jnp.asarray(rng.normal(size=height.shape))
        assert_gradient(
            lambda h: (weight * settle(Pile(h, 0.1)).pile.height).sum(), height, relative=1e-5
        )


def thin(shape: tuple[int, int] = (16, 12)) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Heaps of soil on a steep floor; heights, floor, and the cells that take part."""
    rng = np.random.default_rng(0)
    i, j = np.indices(shape)
    floor = 0.9 * DROP * np.hypot(i - 8.3, j - 5.2)
    soil = 0.8 * rng.random(shape) * (np.hypot(i - 4.1, j - 5.2) < 3.5)
    return jnp.asarray(floor + soil), jnp.asarray(floor), jnp.asarray(rng.random(shape) > 0.02)


def test_momentum_takes_no_more_from_a_cell_than_lies_there() -> None:
    with jax.enable_x64(True):
        height, floor, active = thin()
        links = links_of(active)

        def slid(height: jax.Array, floor: jax.Array = floor) -> jax.Array:
            return slide(height, floor, links, DROP, 0.95, 12)

        unlimited = slid(height, jnp.full_like(floor, -jnp.inf))
        assert (unlimited - floor).min() < -1e-3, "the floor is not in the way"
        after = slid(height)
        assert (after - floor).min() >= -1e-15
        assert jnp.abs(after - height).max() > 0.01
        assert_volume_kept(height, after, relative=1e-14)
        # Each member of a batch as it is alone, whether the floor is in its way or not.
        floors = jnp.stack([floor, floor - 1.0])
        both = jax.vmap(lambda f: slid(height, f))(floors)
        np.testing.assert_allclose(both[0], after, atol=1e-14)
        np.testing.assert_allclose(both[1], unlimited, atol=1e-14)
        weight = jnp.asarray(np.random.default_rng(1).normal(size=height.shape))
        assert_gradient(lambda h: (weight * slid(h)).sum(), height, relative=1e-5)


def test_a_coarse_change_takes_no_more_from_a_cell_than_lies_there() -> None:
    with jax.enable_x64(True):
        height, floor, active = thin()
        lies = jnp.where(active, height - floor, 0.0).reshape(8, 2, 6, 2)
        whole = active.reshape(8, 2, 6, 2).all(axis=(1, 3))
        # As much as coarse cells have, at most; what they give another one gets.
        loss = jnp.where(whole, lies.mean(axis=(1, 3)), 0.0) * jnp.asarray(
            np.random.default_rng(3).choice([0.0, 0.5, 1.0], (8, 6))
        )
        change = -loss + jnp.zeros_like(loss).at[1, 1].set(loss.sum() * whole[1, 1])
        assert whole[1, 1]

        def added(arguments: tuple[jax.Array, jax.Array], floor: jax.Array = floor) -> jax.Array:
            height, change = arguments
            return _add_change(height, jnp.where(whole, change, 0.0), floor, active)

        unlimited = added((height, change), jnp.full_like(floor, -jnp.inf))
        assert (unlimited - floor).min() < -1e-3, "the floor is not in the way"
        after = added((height, change))
        assert (after - floor).min() >= -1e-15
        for surface in (unlimited, after):
            assert_volume_kept(height, surface, relative=1e-14)
            np.testing.assert_array_equal(surface[~active], height[~active])
        # No change is zero, no cell is bare: there are the kinks.
        some = jnp.asarray(1e-3 + 1e-3 * np.random.default_rng(4).random(height.shape))
        point = (height + some, jnp.where(whole, 0.9 * change - 5e-4, 0.0))
        weight = jnp.asarray(np.random.default_rng(1).normal(size=height.shape))
        assert_gradient(lambda at: (weight * added(at)).sum(), point, relative=1e-5)


@pytest.mark.slow
def test_gradient_through_several_windows_against_finite_differences() -> None:
    """A small window on a long slope, so that the avalanche needs more than one."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(3)
        x = 0.1 * np.arange(26)
        height = math.tan(math.radians(31.8)) * x[:, None] + 0.01 * rng.random((26, 10))
        pile = Pile(jnp.asarray(height), 0.1)
        start = (jnp.int32(2), jnp.int32(1))
        dug = jax.lax.dynamic_slice(pile.height, start, (8, 8)).at[1:4, 2:6].add(-0.3)
        weight = jnp.asarray(rng.normal(size=height.shape))

        def cost(h: jax.Array) -> jax.Array:
            return (weight * settle_dug(pile, h, start).pile.height).sum()

        moved = settle_dug(pile, dug, start).pile.height != pile.height
        assert moved[10:].any(), "the avalanche stays in its first window"
        assert_gradient(cost, dug, relative=1e-5, skip=8)


@pytest.mark.slow
def test_cells_outside_the_avalanche_keep_their_cotangent() -> None:
    pile = uneven(np.random.default_rng(5), shape=(24, 22))
    gradient = jax.jit(jax.grad(lambda h: settle(pile.replace(height=h)).pile.height.sum()))
    # The volume is kept, whatever slides.
    np.testing.assert_allclose(gradient(pile.height), 1.0, atol=1e-5)


def test_forward_mode_says_that_it_is_not_available() -> None:
    height = rough(shape=(8, 8))
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda h: settle(Pile(h, 0.1)).pile.height, (height,), (jnp.ones_like(height),))


def test_memory_of_the_gradient_does_not_grow_with_the_sweeps() -> None:
    height = rough(shape=(64, 64))

    def peak(function: Callable[[jax.Array], jax.Array]) -> Any:
        return jax.jit(jax.grad(function)).lower(height).compile().memory_analysis()

    def cost(count: int, h: jax.Array) -> jax.Array:
        return (sweeps(h, DROP, None, count) ** 2).sum()

    sizes = [peak(functools.partial(cost, count)).temp_size_in_bytes for count in (256, 4096)]
    assert sizes[1] <= 1.5 * sizes[0] + 64 * height.nbytes
    assert sizes[1] <= 200 * height.nbytes


def test_gradient_stays_bounded_over_many_sweeps() -> None:
    """Unit row sums and symmetry: the cotangent never grows in the largest component."""
    height = rough(3, amplitude=1.0)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=height.shape), height.dtype)
    for count in (1, 100, 2000):
        gradient = jax.grad(lambda h, n=count: (weight * sweeps(h, DROP, None, n)).sum())(height)
        assert jnp.abs(gradient).max() <= jnp.abs(weight).max() * (1 + 1e-5)


def test_gradient_is_finite_on_flat_ground() -> None:
    for height in (jnp.zeros((48, 48)), jnp.full((48, 48), 2.0)):
        assert jnp.isfinite(one_settled(height)[1]).all()
