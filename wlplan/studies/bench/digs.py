"""Random digs on the seed piles: the cases that the automaton is timed and judged on."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.site.machine import WA320
from wlplan.terrain.automaton import relax, settle_dug, window_of
from wlplan.terrain.excavation import excavate
from wlplan.terrain.seed_piles import SEED_PILES, seed_pile
from wlplan.terrain.toe import toe_contour
from wlplan.types import Pile, Pose

# Volume of a dig [m^3], and largest angle between its heading and the normal of the toe [rad].
_LEAST_VOLUME, _MOST_VOLUME = 0.5, 3.0
_HEADING_SPREAD = math.radians(10.0)


class Dig(NamedTuple):
    """A pile with a load taken out of it, before anything slides and after."""

    pile: Pile  # before, the whole grid
    pose: Pose
    before: Pile  # the window around the dig, before
    dug: Pile  # the window with the hole
    start: tuple[Array, Array]  # first cell of the window
    after: Pile  # the whole grid once it has slid


def relaxed_seed_piles(seed: int) -> list[Pile]:
    """The six seed piles of the paper, relaxed, all on a grid of the same size.

    Args:
        seed: Seed of the noise, another for each pile.
    """
    piles = [
        seed_pile(kind, slope=slope, seed=seed + k) for k, (kind, slope) in enumerate(SEED_PILES)
    ]
    sides = np.max([pile.height.shape for pile in piles], axis=0)
    slide = jax.jit(relax)
    relaxed = []
    for pile in piles:
        # Level ground behind the far sides, so that one compiled program serves all of them.
        rim = [(0, int(side) - n) for side, n in zip(sides, pile.height.shape, strict=True)]
        relaxed.append(slide(pile.replace(height=jnp.pad(pile.height, rim))))
    return relaxed


def random_pose(pile: Pile, rng: np.random.Generator) -> Pose:
    """A pose at a random accessible point of the toe, within 10 degrees of its normal."""
    contour = toe_contour(pile)
    point = rng.choice(np.flatnonzero(contour.accessible))
    heading = contour.heading[point] + rng.uniform(-_HEADING_SPREAD, _HEADING_SPREAD)
    return Pose(*(jnp.asarray(v, jnp.float32) for v in (*contour.points[point], heading)))


def random_digs(count: int, seed: int) -> list[Dig]:
    """Digs of 0.5 to 3 m^3 on all seed piles in turn, each pile as the digs before left it.

    Args:
        count: Number of digs.
        seed: Seed of piles, poses and volumes.
    """
    rng = np.random.default_rng(seed)
    piles = relaxed_seed_piles(seed)
    digs = []
    for k in range(count):
        pile = piles[k % len(piles)]
        pose = random_pose(pile, rng)
        volume = jnp.asarray(rng.uniform(_LEAST_VOLUME, _MOST_VOLUME), jnp.float32)
        digs.append(Dig(pile, pose, *_dig(pile, pose, volume)))
        piles[k % len(piles)] = digs[-1].after
    return digs


@jax.jit
def _dig(
    pile: Pile, pose: Pose, volume: Float[Array, ""]
) -> tuple[Pile, Pile, tuple[Array, Array], Pile]:
    """The window before and dug, its first cell, and the pile once it has slid."""
    before, start = window_of(pile, pose)
    dug = excavate(before, pose, volume, width=WA320.bucket_width).pile
    return before, dug, start, settle_dug(pile, dug.height, start).pile
