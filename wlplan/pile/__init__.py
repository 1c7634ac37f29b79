"""Piles on a grid: seed piles with noise, volume, resampling, and the toe a loader drives up to.

Only `ground_height` and `volume` are JAX functions; the rest prepares piles on the host in numpy.
"""

from wlplan.pile.resampling import resample
from wlplan.pile.seeds import SEED_PILES, seed_pile
from wlplan.pile.toe import ToeContour, evenly_spaced, toe_contour
from wlplan.pile.volumes import ground_height, volume

__all__ = [
    "SEED_PILES",
    "ToeContour",
    "evenly_spaced",
    "ground_height",
    "resample",
    "seed_pile",
    "toe_contour",
    "volume",
]
