"""Functions that can be exported, by name.

One file here for each, with `portable(asked)`, which makes a `PortableFunction` of what is asked
for, or says in one line why there is none. They are imported when they are asked for.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from wlplan.actions import latin_hypercube
from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.errors import InputError
from wlplan.portable import FUNCTIONS
from wlplan.portable.function import Port, PortableFunction
from wlplan.site.site import Site
from wlplan.terrain.toe import ToeContour, edge_poses
from wlplan.types import Pile, Pose, World


@dataclasses.dataclass(frozen=True)
class Asked:
    """What a function is to be made of.

    Attributes:
        world: The world, or the one whose models are meant.
        pile: A pile: what has a grid gets that of this pile, and it is checked along its toe.
        contour: Toe of the pile.
        site: Machine and soil.
        origin: What export.json says of all these, as JSON has it.
        count: Cases that the function is checked on.
        seed: Of their actions.
    """

    world: World
    pile: Pile
    contour: ToeContour
    site: Site
    origin: Mapping[str, Any]
    count: int = 8
    seed: int = 0


def portable(name: str, asked: Asked) -> PortableFunction:
    """A function by name.

    Args:
        name: Of `wlplan.portable.FUNCTIONS`.
        asked: What it is made of.

    Raises:
        InputError: If there is none of that name, or the world has no such part.
    """
    if name not in FUNCTIONS:
        raise InputError(f"unknown function {name!r}: choose one of {', '.join(FUNCTIONS)}.")
    module = importlib.import_module(f"{__name__}.{name.replace('-', '_')}")
    made: PortableFunction = module.portable(asked)
    return made


ACTION = Port(
    "action",
    "parameters of the bucket-filling controller: delta_bm (boom force threshold, 0 to 0.7), k_bm "
    "(boom velocity gain, 0 to 5), delta_bk (bucket force threshold, 0 to 0.7), k_bk (bucket "
    "velocity gain, 0 to 5)",
    "1",
    shape=(4,),
)
"""The input that all functions share."""

PERFORMANCE = (
    Port("mass", "load in the bucket", "t"),
    Port("time", "from the start of the loading to its end", "s"),
    Port("work", "of the loading", "kJ"),
)
"""What a loading yields and costs."""


def over_grid(name: str, meaning: str, pile: Pile, unit: str = "m") -> Port:
    """A map with the grid of a pile."""
    cell = (
        f"cell [i, j] is centred at x = origin[0] + i * {pile.cell_size:g} m, "
        f"y = origin[1] + j * {pile.cell_size:g} m"
    )
    return Port(name, f"{meaning}: {cell}", unit, "world", pile.height.shape)


ORIGIN = Port("origin", "x and y of the centre of cell [0, 0]", "m", "world", (2,))
"""Where the grid of a pile lies."""


def for_each(asked: Asked, values: Any) -> np.ndarray:
    """The same value for each case."""
    return np.repeat(np.asarray(values, np.float32)[None], asked.count, axis=0)


def local_map(name: str, cells: int, displacement: float) -> Port:
    """A local heightmap as an input."""
    return Port(
        name,
        f"local heightmap: cell [i, j] lies i * 0.1 m - {displacement:g} m ahead of the dig pose "
        f"and (j - {(cells - 1) / 2:g}) * 0.1 m to its left; heights over that of the centre line "
        f"at its first row",
        "m",
        "local",
        (cells, cells),
    )


def poses(asked: Asked) -> Pose:
    """Poses all around the toe, leaves (n,): the cases."""
    found = edge_poses(asked.contour, asked.count)
    as_given: Pose = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), found)
    return as_given


def actions(asked: Asked) -> Float[np.ndarray, "n 4"]:
    """Actions that fill their box evenly: the cases."""
    low, high = np.asarray(ACTION_LOW), np.asarray(ACTION_HIGH)
    parts = latin_hypercube(asked.count, 4, np.random.default_rng(asked.seed))
    values: np.ndarray = (low + parts * (high - low)).astype(np.float32)
    return values
