"""The floor under a pile from a scan of its own, of the empty yard or of its design."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from wlplan.errors import InputError
from wlplan.io.scans import Heightmap
from wlplan.terrain.floor import fill_unseen

# Part of the cells in which a floor may lie this far above the surface [m]: what was dug out. More
# are heights of another kind. Below the surface everywhere by more than this [m] is worth a note.
_MOST_ABOVE, _ABOVE, _BELOW = 0.5, 0.3, 2.0


def floor_of(
    ground: Heightmap,
    height: Float[np.ndarray, "nx ny"],
    valid: Bool[np.ndarray, "nx ny"],
    cell_size: float,
    origin: Float[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "nx ny"], tuple[str, ...]]:
    """A floor on the grid of a pile: bilinear between the cells of its scan.

    Args:
        ground: Scan of the floor, in the coordinates of the pile.
        height: Surface of the pile [m].
        valid: Its cells that were seen.
        cell_size: Side of its cells [m].
        origin: x and y of the centre of its cell [0, 0] [m].

    Returns:
        The floor [m], NaN where its scan saw nothing, and notes.

    Raises:
        InputError: If it has nothing under the pile, or heights that are none of this pile.
    """
    seen = np.ones(ground.height.shape, bool) if ground.valid is None else ground.valid
    levels = fill_unseen(ground.height, seen)
    ends = np.asarray(ground.origin, np.float64)
    places = [
        (origin[k] + cell_size * np.arange(height.shape[k]) - ends[k]) / ground.cell_size
        for k in (0, 1)
    ]
    inside = [(at >= -0.5) & (at <= n - 0.5) for at, n in zip(places, levels.shape, strict=True)]
    nearest = [
        np.clip(np.rint(at), 0, n - 1).astype(int)
        for at, n in zip(places, levels.shape, strict=True)
    ]
    known = inside[0][:, np.newaxis] & inside[1] & seen[np.ix_(*nearest)]
    if not (known & valid).any():
        far = ends + ground.cell_size * (np.array(levels.shape) - 1)
        raise InputError(
            f"has nothing under the pile: its x runs from {ends[0]:.10g} to {far[0]:.10g}, its y "
            f"from {ends[1]:.10g} to {far[1]:.10g}; give a scan of the same place."
        )
    floor = ndimage.map_coordinates(
        levels, np.meshgrid(*places, indexing="ij"), order=1, mode="nearest"
    )
    over = height[known & valid] - floor[known & valid]
    if np.mean(over < -_ABOVE) > _MOST_ABOVE:
        raise InputError(
            f"lies above the pile, by {-np.median(over):.3g} m in the middle: check that both "
            f"count heights from the same level."
        )
    notes = []
    share = known[valid].mean()
    if share < 1.0:
        notes.append(
            f"the floor is known under {100.0 * share:.0f} % of the scan, and estimated elsewhere"
        )
    if (lowest := float(np.quantile(over, 0.02))) > _BELOW:
        notes.append(
            f"the floor lies {lowest:.3g} m or more below the scan everywhere: check that both "
            f"count heights from the same level"
        )
    return np.where(known, floor, np.nan), tuple(notes)
