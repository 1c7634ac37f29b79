"""Where the piles are in a scan that is too large to be read whole."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from wlplan.terrain.floor import estimate_ground, fill_unseen

# Cells of an overview, at least [m], and most along a side.
_CELL, _MOST_CELLS = 1.0, 800
# A pile is what rises this far above the ground around it [m] and holds so much [m^3], a few
# buckets. At most so many are named, the largest ones.
_RISE, _VOLUME, _NAMED = 0.5, 10.0, 3
# Ground that is taken along on every side of a pile [m]: a loader needs some to start from.
_AROUND = 10.0
# Widest cells in which a pile can be told from its surroundings [m].
_WIDEST = 10.0


def coarse_cell(extent: Float[np.ndarray, "2"]) -> float:
    """Side of the cells of an overview of a site of some extent [m]."""
    return max(_CELL, float(np.max(extent)) / _MOST_CELLS)


def where_piles_are(
    height: Float[np.ndarray, "nx ny"],
    seen: Bool[np.ndarray, "nx ny"],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
    *,
    unit: float = 1.0,
) -> str:
    """Name the largest piles of an overview, each with a rectangle for `--crop`.

    Args:
        height: Heights [m], of cells of a metre or so; anything where none were seen.
        seen: Cells that were seen.
        cell_size: Side of a cell [m].
        origin: x and y of the centre of cell [0, 0] [m].
        unit: Length of the unit of x and y in the file [m].

    Returns:
        The end of a sentence, in the coordinates of the file; empty if there is no pile to be seen.
    """
    if cell_size > _WIDEST or not seen.any() or min(height.shape) < 3:
        return ""
    height = fill_unseen(height, seen)
    rise = np.where(seen, height - estimate_ground(height, cell_size, seen), 0.0)
    piles, count = ndimage.label(rise > _RISE, np.ones((3, 3)))
    if not count:
        return ""
    numbers = np.arange(1, count + 1)
    volumes = ndimage.sum_labels(rise, piles, numbers) * cell_size**2
    boxes = ndimage.find_objects(piles)
    last = origin + (np.array(height.shape) - 0.5) * cell_size
    words = []
    for k in np.argsort(-volumes)[:_NAMED]:
        if volumes[k] < _VOLUME:
            break
        low = origin + (np.array([axis.start for axis in boxes[k]]) - 0.5) * cell_size
        high = origin + (np.array([axis.stop for axis in boxes[k]]) - 0.5) * cell_size
        middle = 0.5 * (low + high) / unit
        low = np.maximum(low - _AROUND, origin - 0.5 * cell_size) / unit
        high = np.minimum(high + _AROUND, last) / unit
        corners = [*(math.floor(v) for v in low), *(math.ceil(v) for v in high)]
        words.append(
            f"{middle[0]:.0f},{middle[1]:.0f} (--crop={','.join(f'{v:d}' for v in corners)})"
        )
    if not words:
        return ""
    return f"; there is a pile around {', one around '.join(words)}"


def averaged(
    height: Float[np.ndarray, "nx ny"], seen: Bool[np.ndarray, "nx ny"], times: int
) -> tuple[Float[np.ndarray, "mx my"], Bool[np.ndarray, "mx my"]]:
    """Means over squares of so many cells a side, and which of them hold a cell that was seen."""
    nx, ny = (n // times for n in height.shape)

    def total(cells: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "mx my"]:
        sums: np.ndarray = (
            cells[: nx * times, : ny * times].reshape(nx, times, ny, times).sum(axis=(1, 3))
        )
        return sums

    count = total(seen.astype(float))
    return total(np.where(seen, height, 0.0)) / np.maximum(count, 1.0), count > 0
