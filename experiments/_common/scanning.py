"""What a scanner makes of a pile: noise, cells that it misses, a map that is laid down askew."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from wlplan.terrain.floor import fill_unseen
from wlplan.types import Pile

# Width of the patches that are missed: the Gaussian under which they are drawn [m].
_PATCH = 0.4


@dataclasses.dataclass(frozen=True)
class Scanner:
    """How wrong scans are; by default not at all."""

    # Standard deviation of the heights, and the Gaussian under which their noise is smooth [m].
    deviation: float = 0.0
    smooth: float = 0.0
    # Parts of the cells that are missed in patches, and in whole rows.
    patches: float = 0.0
    rows: float = 0.0
    # By how much the map is off, in a direction that is another for each scan [m], and turned about
    # its middle, either way [rad].
    shift: float = 0.0
    turn: float = 0.0

    def scan(self, pile: Pile, random: np.random.Generator) -> Pile:
        """The pile as it is scanned, on its own grid, with its own floor.

        The floor was surveyed before the pile was there, and is right. Missed cells are filled as
        those of a scan that is read.

        Args:
            pile: As it is.
            random: Source of everything random.
        """
        height, seen = self._askew(pile, random)
        cell = pile.cell_size
        if self.deviation > 0.0:
            height = height + self.deviation * _noise(height.shape, self.smooth / cell, random)
        missed = np.zeros_like(seen)
        if self.patches > 0.0:
            field = _noise(height.shape, _PATCH / cell, random)
            missed |= field < np.quantile(field, self.patches)
        if self.rows > 0.0:
            lines = missed if random.random() < 0.5 else missed.T
            count = max(1, round(self.rows * len(lines)))
            lines[random.choice(len(lines), count, replace=False)] = True
        seen = seen & ~missed
        if not seen.all():
            height = fill_unseen(height, seen)
        return pile.replace(
            height=jnp.asarray(height, pile.height.dtype),
            valid=None if seen.all() else jnp.asarray(seen),
        )

    def _askew(
        self, pile: Pile, random: np.random.Generator
    ) -> tuple[Float[np.ndarray, "nx ny"], Bool[np.ndarray, "nx ny"]]:
        """Heights where the map has them, and which cells it has."""
        height = np.asarray(pile.height, np.float64)
        known = np.ones(height.shape, bool) if pile.valid is None else np.asarray(pile.valid)
        direction, turn = random.uniform(0.0, 2.0 * math.pi), random.choice((-1.0, 1.0)) * self.turn
        if self.shift == 0.0 and self.turn == 0.0:
            return height, known
        middle = 0.5 * (np.array(height.shape) - 1.0)[:, None, None]
        by = self.shift / pile.cell_size * np.array([math.cos(direction), math.sin(direction)])
        # Where in the pile that is which the map has in a cell.
        c, s = math.cos(turn), math.sin(turn)
        u, v = np.indices(height.shape) - middle - by[:, None, None]
        at = np.stack([c * u + s * v, c * v - s * u]) + middle
        moved = ndimage.map_coordinates(height, at, order=1, mode="nearest")
        seen = ndimage.map_coordinates(known.astype(float), at, order=1, cval=0.0) > 1.0 - 1e-6
        return moved, seen


def _noise(
    shape: tuple[int, ...], smooth: float, random: np.random.Generator
) -> Float[np.ndarray, "nx ny"]:
    """Noise of standard deviation 1, smooth over so many cells."""
    field = ndimage.gaussian_filter(random.normal(size=shape), smooth, mode="wrap")
    noise: np.ndarray = field / field.std()
    return noise
