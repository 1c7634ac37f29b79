"""Removing a load from the strip."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike
from laws import assert_gradient

from wlplan.terrain import excavation
from wlplan.terrain.excavation import STRIP_LENGTH
from wlplan.terrain.heightmap import cell_centres, to_local
from wlplan.types import Pile, Pose

WIDTH = 2.7
excavate: Callable[..., excavation.Excavation] = jax.jit(
    excavation.excavate, static_argnames="width"
)


def slope_pile(dtype: DTypeLike = jnp.float32, degrees: float = 30.0) -> Pile:
    x = 0.1 * np.arange(120)
    height = np.maximum((x - 3.0) * math.tan(math.radians(degrees)), 0.0)
    return Pile(jnp.asarray(np.broadcast_to(height[:, None], (120, 100)), dtype), 0.1)


def pose(
    x: float = 3.0, y: float = 5.0, heading: float = 0.0, dtype: DTypeLike = jnp.float32
) -> Pose:
    return Pose(*(jnp.asarray(v, dtype) for v in (x, y, heading)))


@pytest.mark.parametrize("heading", [0.0, 0.3, -0.7])
@pytest.mark.parametrize("volume", [0.3, 1.7, 3.0])
def test_exactly_the_volume_is_taken(heading: float, volume: float) -> None:
    pile = slope_pile()
    after, taken, _ = excavate(pile, pose(heading=heading), jnp.asarray(volume), width=WIDTH)
    assert float(taken) == pytest.approx(volume, rel=1e-6)
    lost = np.asarray(pile.height - after.height, np.float64).sum() * 0.01
    assert lost == pytest.approx(volume, rel=1e-5)
    assert after.height.min() >= 0.0


def test_only_the_strip_is_dug() -> None:
    pile, p = slope_pile(), pose(heading=0.3)
    after, *_ = excavate(pile, p, jnp.asarray(2.0), width=WIDTH)
    along, left = to_local(p, *cell_centres(pile))
    dug = pile.height - after.height > 1e-7
    assert not (dug & ((jnp.abs(left) > WIDTH / 2 + 0.06) | (along < -0.06))).any()
    assert not (dug & (along > STRIP_LENGTH + 0.06)).any()


def test_a_load_larger_than_the_strip_takes_what_is_there() -> None:
    pile = slope_pile()
    after, taken, _ = excavate(pile, pose(), jnp.asarray(50.0), width=WIDTH)
    lost = np.asarray(pile.height - after.height, np.float64).sum() * 0.01
    # A wedge of 30 degrees as long as the strip.
    assert float(taken) == pytest.approx(
        0.5 * STRIP_LENGTH**2 * math.tan(math.radians(30.0)) * WIDTH, rel=0.02
    )
    assert lost == pytest.approx(float(taken), rel=1e-5)


@pytest.mark.parametrize("cell", [0.1, 0.2])
@pytest.mark.parametrize("part", [0.3, 0.7, 2.0])
def test_a_thin_layer_gives_what_was_taken(cell: float, part: float) -> None:
    """The cut rises by more than the layer from one cell to the next."""
    cells = round(10.0 / cell)
    pile = Pile(jnp.full((cells, cells), 0.05), cell)
    volume = part * 0.05 * STRIP_LENGTH * WIDTH
    for x in np.linspace(2.0, 2.2, 7):
        after, taken, _ = excavate(pile, pose(x, 5.0, 0.1), jnp.asarray(volume), width=WIDTH)
        lost = np.asarray(pile.height - after.height, np.float64).sum() * cell**2
        assert lost == pytest.approx(float(taken), rel=1e-4)
        assert float(taken) == pytest.approx(volume / max(part, 1.0), rel=1e-2)


@pytest.mark.parametrize("where", [(-30.0, 0.0), (1.0, 5.0)])
def test_off_the_pile_nothing_is_taken_and_gradients_are_finite(where: tuple[float, float]) -> None:
    pile = Pile(jnp.zeros((60, 60)), 0.1)

    def taken(p: Pose) -> jax.Array:
        after, volume, _ = excavate(pile, p, jnp.asarray(2.0), width=WIDTH)
        return volume + (after.height**2).sum()

    assert float(taken(pose(*where))) == 0.0
    assert all(jnp.isfinite(g) for g in jax.tree.leaves(jax.grad(taken)(pose(*where))))


def test_the_floor_and_unseen_cells_are_not_dug() -> None:
    pile = slope_pile()
    ground = 0.5 * pile.height
    valid = jnp.ones(pile.height.shape, bool).at[:, :48].set(False)
    pile = pile.replace(ground=ground, valid=valid)
    after, taken, _ = excavate(pile, pose(), jnp.asarray(1.0), width=WIDTH)
    assert float(taken) == pytest.approx(1.0, rel=1e-6)
    assert (after.height - ground).min() >= -1e-6
    np.testing.assert_array_equal(after.height[:, :48], pile.height[:, :48])


def test_the_gradient_in_pose_and_volume_agrees_with_finite_differences() -> None:
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        pile = slope_pile(jnp.float64)
        pile = pile.replace(
            height=pile.height + 0.05 * jnp.asarray(rng.random((120, 100))) * (pile.height > 0)
        )
        weight = jnp.asarray(rng.normal(size=(120, 100)))

        def cost(inputs: tuple[Pose, jax.Array]) -> jax.Array:
            p, volume = inputs
            after, taken, _ = excavate(pile, p, volume, width=WIDTH)
            return (weight * after.height).sum() + taken

        point = (pose(3.013, 5.027, 0.21, jnp.float64), jnp.asarray(1.9))
        assert_gradient(cost, point, step=1e-7, relative=1e-4)
