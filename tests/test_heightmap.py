"""Local heightmaps: sampling, frames, write-back."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike
from laws import assert_gradient

from wlplan.terrain import heightmap
from wlplan.terrain.heightmap import (
    local_axes,
    sample,
    sample_cubic,
    take,
    to_local,
    to_world,
)
from wlplan.types import Pile, Pose

add_local_change = jax.jit(heightmap.add_local_change, static_argnums=4)
sample_local = jax.jit(heightmap.sample_local, static_argnames=("cells", "displacement"))


def plane(
    ax: float,
    ay: float,
    b: float = 0.3,
    shape: tuple[int, int] = (80, 70),
    origin: tuple[float, float] = (-3.0, -2.0),
    dtype: DTypeLike = jnp.float32,
) -> Pile:
    x = origin[0] + 0.1 * np.arange(shape[0])
    y = origin[1] + 0.1 * np.arange(shape[1])
    return Pile(jnp.asarray(ax * x[:, None] + ay * y[None, :] + b, dtype), 0.1, origin)


def pose(x: float, y: float, heading: float, dtype: DTypeLike = jnp.float32) -> Pose:
    return Pose(*(jnp.asarray(v, dtype) for v in (x, y, heading)))


def bumpy(
    shape: tuple[int, int] = (120, 110), seed: int = 0, dtype: DTypeLike = jnp.float32
) -> Pile:
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(0.1 * np.arange(shape[0]), 0.1 * np.arange(shape[1]), indexing="ij")
    height = 1.0 + 0.1 * x
    for _ in range(4):
        k, phase = rng.normal(0, 1.0, 2), rng.uniform(0, 6.0)
        height = height + 0.1 * np.cos(k[0] * x + k[1] * y + phase)
    return Pile(jnp.asarray(height, dtype), 0.1)


def test_sampling_reproduces_a_plane_and_repeats_the_border() -> None:
    pile = plane(0.3, -0.2)
    x, y = jnp.asarray([0.123, 2.77, -2.95]), jnp.asarray([1.01, -1.93, 4.0])
    np.testing.assert_allclose(sample(pile.height, pile, x, y), 0.3 * x - 0.2 * y + 0.3, atol=1e-5)
    far = sample(pile.height, pile, jnp.asarray([-50.0]), jnp.asarray([-2.0]))
    np.testing.assert_allclose(far, pile.height[0, 0], atol=1e-6)


def test_cubic_sampling_keeps_parabolas_inside_planes_at_the_border_and_values_at_cells() -> None:
    with jax.enable_x64(True):
        pile = plane(0.3, -0.2, dtype=jnp.float64)
        x, y = jnp.asarray([-2.98, 0.123, 4.87]), jnp.asarray([4.88, 1.01, -1.97])
        flat = 0.3 * x - 0.2 * y + 0.3
        np.testing.assert_allclose(sample_cubic(pile.height, pile, x, y), flat, atol=1e-12)
        far = sample_cubic(pile.height, pile, jnp.asarray([-50.0]), jnp.asarray([-2.0]))
        np.testing.assert_allclose(far, pile.height[0, 0], atol=1e-12)
        cells = jnp.asarray(np.random.default_rng(2).normal(size=pile.height.shape))
        at = (jnp.asarray([-2.0, 1.5]), jnp.asarray([0.7, 3.0]))
        wanted = cells[np.array([10, 45]), np.array([27, 50])]
        np.testing.assert_allclose(sample_cubic(cells, pile, *at), wanted, atol=1e-10)
        curved = jnp.asarray((np.arange(80.0) ** 2)[:, None] + np.arange(70.0) * 3.0)
        u, v = jnp.asarray([20.37]), jnp.asarray([11.81])
        found = sample_cubic(curved, pile, 0.1 * u - 3.0, 0.1 * v - 2.0)
        np.testing.assert_allclose(found, u**2 + 3.0 * v, rtol=1e-12)


def test_cubic_sampling_has_no_kink_where_bilinear_sampling_has_one() -> None:
    with jax.enable_x64(True):
        pile = bumpy(dtype=jnp.float64)
        either = jnp.asarray([5.0 - 1e-9, 5.0 + 1e-9])
        beside = jnp.full(2, 4.03)

        def slopes(sampling: heightmap.Sampling) -> jax.Array:
            found: jax.Array
            found = jax.grad(lambda x: sampling(pile.height, pile, x, beside).sum())(either)
            return found

        left, right = slopes(sample_cubic)
        np.testing.assert_allclose(left, right, atol=1e-6)
        left, right = slopes(sample)
        assert abs(left - right) > 1e-3


def test_a_local_heightmap_is_sampled_as_is_asked() -> None:
    pile, at = bumpy(), pose(3.0, 4.0, 0.7)
    cubic = heightmap.sample_local(pile, at, sampling=sample_cubic).height
    difference = np.abs(cubic - heightmap.sample_local(pile, at).height)
    assert 1e-5 < difference.max() < 1e-2


@pytest.mark.parametrize(("cells", "displacement"), [(36, 0.0), (52, 1.0)])
@pytest.mark.parametrize("heading", [0.0, 0.7, math.pi / 2, -2.5])
def test_a_local_heightmap_of_a_plane(cells: int, displacement: float, heading: float) -> None:
    pile = plane(0.3, -0.2)
    local = sample_local(pile, pose(0.6, 0.9, heading), cells=cells, displacement=displacement)
    along, left = local_axes(cells, displacement)
    rise_x = 0.3 * math.cos(heading) - 0.2 * math.sin(heading)
    rise_y = -0.3 * math.sin(heading) - 0.2 * math.cos(heading)
    expected = rise_x * (along[:, None] + displacement) + rise_y * left[None, :]
    inside = np.abs(along[:, None]) + np.abs(left[None, :]) < 2.0
    np.testing.assert_allclose(np.asarray(local.height)[inside], expected[inside], atol=1e-5)


def test_the_map_is_symmetric_about_the_bucket_centre_line() -> None:
    _, left = local_axes(36, 0.0)
    np.testing.assert_allclose(left, -left[::-1])
    # 3.6 m leave half a metre either side of a 2.6 m bucket.
    assert left[-1] + 0.05 == pytest.approx(1.8)


def test_frames_are_inverse_to_each_other() -> None:
    p = pose(1.2, -0.7, 2.1)
    along, left = jnp.asarray([0.3, 2.0]), jnp.asarray([-1.0, 0.4])
    back = to_local(p, *to_world(p, along, left))
    np.testing.assert_allclose(back[0], along, atol=1e-6)
    np.testing.assert_allclose(back[1], left, atol=1e-6)
    # e_y is to the left of the heading.
    x, y = to_world(pose(0.0, 0.0, 0.0), jnp.asarray(0.0), jnp.asarray(1.0))
    assert (float(x), float(y)) == (0.0, 1.0)


def test_sampling_is_differentiable_in_the_pose() -> None:
    with jax.enable_x64(True):
        pile = bumpy(dtype=jnp.float64)
        weight = jnp.asarray(np.random.default_rng(0).normal(size=(36, 36)))
        assert_gradient(
            lambda p: (weight * sample_local(pile, p).height).sum(),
            pose(4.03, 5.07, 0.31, jnp.float64),
            step=1e-7,
        )


@pytest.mark.parametrize("heading", [0.0, 0.4, 1.9, -2.8])
def test_writing_back_keeps_the_volume_of_losses_and_gains(heading: float) -> None:
    pile = bumpy()
    rng = np.random.default_rng(1)
    along, left = np.meshgrid(*local_axes(52, 1.0), indexing="ij")
    hole = -0.5 * np.exp(-((along - 1.0) ** 2 + left**2))
    heap = 0.2 * np.exp(-((along - 2.0) ** 2 + (left - 1.2) ** 2) / 0.2)
    change = jnp.asarray(hole + heap + 0.01 * rng.normal(size=hole.shape), jnp.float32)
    after, _ = add_local_change(pile.height, pile, pose(5.5, 5.2, heading), change, 1.0)
    moved = np.asarray(after - pile.height, np.float64)
    assert moved.sum() == pytest.approx(float(np.asarray(change, np.float64).sum()), rel=2e-5)
    assert moved[moved < 0].sum() == pytest.approx(
        float(np.minimum(np.asarray(change, np.float64), 0).sum()), rel=1e-4
    )


def test_a_batch_of_changes_at_one_pose_keeps_the_volume_of_each() -> None:
    pile = Pile(jnp.ones((96, 96)), 0.1)
    p = pose(5.0, 5.0, 0.0)
    changes = jnp.abs(jnp.asarray(np.random.default_rng(0).normal(size=(4, 52, 52)), jnp.float32))
    many = jax.jit(jax.vmap(lambda change: add_local_change(pile.height, pile, p, change, 1.0)[0]))
    for sign in (-0.01, 0.1):
        moved = np.asarray(many(sign * changes) - 1.0, np.float64).sum(axis=(1, 2))
        wanted = np.asarray(sign * changes, np.float64).sum(axis=(1, 2))
        np.testing.assert_allclose(moved, wanted, rtol=1e-4)


def test_writing_back_a_change_puts_it_where_it_belongs() -> None:
    pile = Pile(jnp.ones((120, 110)), 0.1)
    p = pose(5.5, 5.2, 0.6)
    along, left = np.meshgrid(*local_axes(52, 1.0), indexing="ij")
    change = jnp.asarray(-0.5 * np.exp(-2.0 * ((along - 1.0) ** 2 + left**2)), jnp.float32)
    after = pile.replace(height=add_local_change(pile.height, pile, p, change, 1.0)[0])
    seen = sample_local(after, p, cells=52, displacement=1.0).height + 1.0
    seen = seen - seen[0, 0] + 1.0 + change[0, 0]
    assert jnp.abs(seen - (1.0 + change)).max() < 0.01


def test_writing_back_does_not_dig_below_the_floor() -> None:
    ground = jnp.full((120, 110), 0.9)
    pile = Pile(jnp.ones((120, 110)), 0.1, ground=ground)
    along, left = np.meshgrid(*local_axes(52, 1.0), indexing="ij")
    change = jnp.asarray(-0.15 * np.exp(-(along**2 + left**2)), jnp.float32)
    after, _ = add_local_change(pile.height, pile, pose(5.5, 5.2, 0.6), change, 1.0)
    assert (after - ground).min() >= -1e-6
    lost = float((pile.height - after).sum())
    assert lost == pytest.approx(-float(change.sum()), rel=1e-4)


def test_take_meets_its_total_and_respects_what_is_there() -> None:
    rng = np.random.default_rng(0)
    wanted = jnp.asarray(rng.random((8, 8)), jnp.float32)
    available = jnp.asarray(0.6 * rng.random((8, 8)), jnp.float32)
    taken = take(wanted, available, jnp.asarray(12.0))
    assert float(taken.sum()) == pytest.approx(12.0, rel=1e-5)
    assert (taken <= available).all()
    everything = take(wanted, available, jnp.asarray(1e3))
    np.testing.assert_allclose(everything, available, rtol=1e-5)
    assert float(take(wanted, available, jnp.asarray(0.0)).sum()) == 0.0


def test_cells_with_next_to_nothing_do_not_blow_up_the_gradient_of_take() -> None:
    """All but a few cells are just used up; what those few hold is below the rounding."""
    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=(6, 5)), jnp.float32)
    gradient = jax.jit(
        jax.grad(lambda w, a: (weight * take(w, a, a.sum())).sum(), argnums=(0, 1)),
    )
    for _ in range(50):
        available = rng.random((6, 5)).astype(np.float32)
        available[0] *= 1e-7
        wanted = available.copy()
        wanted[0] *= 0.5
        for part in gradient(jnp.asarray(wanted), jnp.asarray(available)):
            assert jnp.abs(part).max() < 10.0


def test_take_is_differentiable() -> None:
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        wanted, weight = jnp.asarray(rng.random((5, 5))), jnp.asarray(rng.normal(size=(5, 5)))
        available = jnp.asarray(0.7 * rng.random((5, 5)))
        assert_gradient(
            lambda a: (weight * take(a[0], a[1], a[2])).sum(),
            (wanted, available, jnp.asarray(5.0)),
        )
