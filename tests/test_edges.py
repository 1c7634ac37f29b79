"""Loads at and beyond the edge of a map, and on piles that are used up: no soil comes from nowhere.

Crops of the bundled pile run over their edges. Poses lie anywhere on them, actions anywhere in
their box, and a third of the crops has next to nothing left.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import assert_no_soil_from_nowhere

import wlplan
from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.io import bundled_pile_path, read_pile
from wlplan.types import Action, Pile, Pose

CELLS, BATCH = 100, 64
DENSITY = 1.727


def loads(count: int, with_ground: bool) -> tuple[Pile, Pose, Action]:
    """Piles, poses and actions, leaves [count, ...]."""
    random = np.random.default_rng(0)
    pile = read_pile(bundled_pile_path())
    ground = np.asarray(pile.floor, np.float64)
    above = np.asarray(pile.height, np.float64) - ground
    corners = [random.integers(0, n - CELLS + 1, count) for n in above.shape]
    parts = [tuple(slice(k, k + CELLS) for k in corner) for corner in zip(*corners, strict=True)]
    soil, floor = (np.stack([field[part] for part in parts]) for field in (above, ground))
    left = np.where(np.arange(count) % 3 == 2, random.uniform(0.0, 0.1, count), 1.0)
    soil *= left[:, None, None]
    side = pile.cell_size * (CELLS - 1)
    x, y = random.uniform(-0.5, side + 0.5, (2, count))
    # Every third one starts at an edge.
    at_edge = np.arange(count) % 3 == 1
    x = np.where(at_edge & (random.uniform(size=count) < 0.5), side * (x > 0.5 * side), x)
    y = np.where(at_edge & (random.uniform(size=count) < 0.5), side * (y > 0.5 * side), y)
    heading = random.uniform(-np.pi, np.pi, count)
    action = random.uniform(ACTION_LOW, ACTION_HIGH, (count, 4))
    floor = floor if with_ground else 0.0 * floor

    def numbers(values: np.ndarray) -> jax.Array:
        return jnp.asarray(values, jnp.float32)

    piles = Pile(
        numbers(floor + soil),
        pile.cell_size,
        jnp.zeros((count, 2), jnp.float32),
        ground=numbers(floor) if with_ground else None,
    )
    pose = Pose(numbers(x), numbers(y), numbers(heading))
    return piles, pose, Action(*numbers(action.T))


def check(world: Any, count: int, with_ground: bool) -> None:
    """Plays loads, each on a pile of its own, and looks at what is left."""
    given = loads(count, with_ground)
    play = jax.jit(lambda *rows: jax.lax.map(lambda row: world(*row), rows))
    for start in range(0, count, BATCH):
        rows = jax.tree.map(lambda leaf, k=start: leaf[k : k + BATCH], given)
        after, performance = play(*rows)
        for n in range(BATCH):
            pile, left, mass = jax.tree.map(lambda v, k=n: v[k], (rows[0], after, performance.mass))
            assert_no_soil_from_nowhere(pile, left, float(mass), density=DENSITY)


LATER = pytest.mark.slow
WORLDS = ["hybrid", *(pytest.param(name, marks=LATER) for name in ("high", "simulator"))]


@pytest.mark.parametrize("with_ground", [pytest.param(False, marks=LATER), True])
@pytest.mark.parametrize("name", WORLDS)
def test_a_load_at_an_edge_takes_what_is_there(name: str, with_ground: bool) -> None:
    check(wlplan.load_world(name), 256, with_ground)


@pytest.mark.slow
@pytest.mark.parametrize("with_ground", [False, True])
@pytest.mark.parametrize("name", ["low", "high", "hybrid", "simulator"])
def test_many_loads_at_edges_take_what_is_there(name: str, with_ground: bool) -> None:
    check(wlplan.load_world(name), 4096, with_ground)
