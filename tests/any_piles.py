"""Piles and plans of every sort: with walls, kerbs, unseen cells, at edges, and used up.

A sort is a few names, and what is random in it follows from a seed. All piles have a floor and a
mask of seen cells, so that all of one size are one program to XLA.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.io import bundled_pile_path, read_pile
from wlplan.types import Action, LoadingPlan, Pile, Pose

CELL = 0.1

BASES = ("level", "layer", "cone", "ridge", "rough", "crop")
FLOORS = ("level", "slope", "bumps", "kerb", "wall", "box")
MASKS = ("seen", "corner", "spots", "half")
PLACES = ("toe", "on it", "edge", "line", "far")


class Sort(NamedTuple):
    """What sort of pile it is."""

    base: str = "cone"
    floor: str = "level"
    mask: str = "seen"
    left: float = 1.0  # part of the soil that is still there
    seed: int = 0


def pile_of(sort: Sort, cells: int, dtype: type = np.float32) -> Pile:
    """A pile of so many cells a side whose middle is at the origin.

    Args:
        sort: Which.
        cells: Cells a side.
        dtype: Of its heights.
    """
    random = np.random.default_rng(sort.seed)
    side = CELL * (np.arange(cells) - cells // 2)
    x, y = np.meshgrid(side, side, indexing="ij")
    reach = 0.5 * CELL * cells
    floor = _floor(sort.floor, x, y, reach, random)
    soil = sort.left * np.maximum(_soil(sort.base, x, y, reach, random), 0.0)
    valid = _seen(sort.mask, x, y, reach, random)
    return Pile(
        jnp.asarray((floor + soil).astype(dtype)),
        CELL,
        jnp.asarray(side[[0, 0]].astype(dtype)),
        jnp.asarray(floor.astype(dtype)),
        jnp.asarray(valid),
    )


def _soil(
    base: str, x: np.ndarray, y: np.ndarray, reach: float, random: np.random.Generator
) -> np.ndarray:
    """Depth of the soil above the floor [m]."""
    bumps = 0.05 * random.normal(size=x.shape)
    if base == "level":
        return 0.0 * x
    if base == "layer":
        return np.asarray(random.uniform(0.001, 0.2) * (np.hypot(x, y) < 0.6 * reach))
    if base == "cone":
        return np.asarray(0.35 * reach - random.uniform(0.4, 0.9) * np.hypot(x, y) + bumps)
    if base == "ridge":  # as far as the border
        return 0.3 * reach - 0.5 * np.abs(x * math.cos(0.3) + y * math.sin(0.3))
    if base == "rough":  # far too steep: most of it slides
        return random.uniform(0.0, 0.25 * reach, x.shape)
    heights = _bundled()
    corner = [random.integers(0, n - len(x) + 1) for n in heights.shape]
    return heights[tuple(slice(k, k + len(x)) for k in corner)]


@functools.cache
def _bundled() -> np.ndarray:
    """Depth of the soil of the bundled pile [m]."""
    pile = read_pile(bundled_pile_path())
    return np.asarray(pile.height, np.float64) - np.asarray(pile.floor, np.float64)


def _floor(
    kind: str, x: np.ndarray, y: np.ndarray, reach: float, random: np.random.Generator
) -> np.ndarray:
    """Height of the floor [m]."""
    if kind == "slope":
        return 0.03 * x - 0.02 * y
    if kind == "bumps":
        return 0.01 * random.normal(size=x.shape)
    if kind == "kerb":
        return np.where(x > 0.3 * reach, 0.12, 0.0)
    if kind == "wall":
        return np.where(np.abs(x - 0.5 * reach) < 0.2, 2.5, 0.0)
    if kind == "box":  # a container in the middle of the soil
        return np.where((np.abs(x) < 0.2 * reach) & (np.abs(y) < 0.4 * reach), 1.2, 0.0)
    return 0.0 * x


def _seen(
    kind: str, x: np.ndarray, y: np.ndarray, reach: float, random: np.random.Generator
) -> np.ndarray:
    """Cells that the scan saw."""
    if kind == "corner":
        return np.asarray(x + y > -0.8 * reach)
    if kind == "spots":
        return random.uniform(size=x.shape) > 0.05
    if kind == "half":
        return y < 0.1 * reach
    return np.ones_like(x, bool)


def plan_of(
    places: tuple[str, ...], seed: int, cells: int, dtype: type = np.float32
) -> LoadingPlan:
    """A plan with a load at a place of each sort, headings and actions anywhere in their range.

    Args:
        places: Sorts of places, of `PLACES`.
        seed: Of what is random.
        cells: Cells a side of the pile.
        dtype: Of its numbers.
    """
    random = np.random.default_rng(seed)
    rows = [_load(place, 0.5 * CELL * cells, random) for place in places]
    columns = [jnp.asarray(column.astype(dtype)) for column in np.array(rows).T]
    return LoadingPlan(Pose(*columns[:3]), Action(*columns[3:]))


def _load(place: str, reach: float, random: np.random.Generator) -> list[float]:
    heading = random.uniform(-math.pi, math.pi)
    if place == "toe":  # towards the middle
        x, y = (-0.5 * reach * part for part in (math.cos(heading), math.sin(heading)))
    elif place == "edge":
        x, y = random.permutation([random.choice([-reach, reach - CELL]), random.uniform(-1, 1)])
    elif place == "line":  # where samples lie on cells, and headings along their lines
        x, y = CELL * random.integers(-int(reach / CELL), int(reach / CELL), 2)
        heading = 0.25 * math.pi * random.integers(-4, 5)
    else:
        x, y = random.uniform(-1.0, 1.0, 2) * (reach if place == "on it" else 10.0 * reach)
    action = random.uniform(ACTION_LOW, ACTION_HIGH)
    ends = np.where(random.uniform(size=4) < 0.5, ACTION_LOW, ACTION_HIGH)
    action = np.where(random.uniform(size=4) < 0.1, ends, action)
    return [x, y, heading, *action]


def random_sort(random: np.random.Generator) -> Sort:
    """One of all sorts; few of them are empty."""
    left = random.choice([1.0, random.uniform(0.0, 0.1), 0.0], p=[0.8, 0.15, 0.05])
    base, floor, mask = (str(random.choice(names)) for names in (BASES[1:], FLOORS, MASKS))
    return Sort(base, floor, mask, float(left), int(random.integers(2**31)))
