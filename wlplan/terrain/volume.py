"""How well the volume of a scanned pile is known.

Three things make it uncertain, and they have little to do with each other:

* the noise of the heights. Its intensity, variance times the area over which it is correlated, is
  taken from second differences along both axes at once of the means of blocks of 1 to 8 cells, on
  the ground where there is enough of it. They leave nothing of planes and ramps but at their edges;
  their median deviation passes over those. How they fall with the size of the block tells how much
  of the noise is correlated, and over which length, up to 0.5 m: two parts, one white, are fitted.
* what was not seen. Each hole is filled in three ways: smoothly, as the pile is read; flat, at the
  height of the nearest seen cell; and on along the slope there. Half of their range counts.
* the floor, which no scan sees. A plane is fitted to the ground around the pile; what the ground
  deviates from it goes through the edge of the footprint into the floor, more so where the ground
  lies on one side only, and the ground under the pile is taken to be as uneven as that around it.

The first and the last follow the way in which `xdem` treats differences of elevation models:
stable ground, robust variances, correlation, numbers of independent samples. Reference: Hugonnet
et al., Uncertainty analysis of digital elevation models by spatial inference from stable terrain,
IEEE J. Sel. Top. Appl. Earth Obs. Remote Sens. 15 (2022).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float
from scipy import linalg, ndimage, optimize

# Sides of the blocks of the noise [cells], and the least differences that tell a variance.
_BLOCKS = (1, 2, 4, 8)
_FEWEST = 30
# Lengths of the correlation of noise that are tried [m]; what is longer counts as relief.
_LENGTHS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
# Relative error of the variances that the model has at best, and the gain in chi square for which
# a correlation, with two more numbers, is believed in.
_MODEL_ERROR, _PLAIN = 0.03, 9.0
# A normal deviate's standard deviation over its median absolute deviation.
_NORMAL = 1.4826
# Width of the ring of ground around a pile that is looked at [m], the least of its seen cells that
# tell of a floor, and blocks of its roughness [m].
_RING, _LEAST_RING = 3.0, 50
_ROUGH_BLOCKS, _ROUGH_FEWEST = (0.1, 0.2, 0.4, 0.8, 1.6), 12
# Width by which the edge of what was seen is kept clear of when slopes are taken [m].
_CLEAR = 0.3
# Part of the mean height above a floor that nothing tells of, which counts as its deviation.
_UNKNOWN_FLOOR = 0.25


@dataclasses.dataclass(frozen=True)
class Deviation:
    """Standard deviation of a volume, in parts that are independent of each other [m^3]."""

    noise: float
    unseen: float
    floor: float

    @property
    def total(self) -> float:
        """All of them together [m^3]."""
        return math.hypot(self.noise, self.unseen, self.floor)


def noise_intensity(
    height: Float[np.ndarray, "nx ny"],
    seen: Bool[np.ndarray, "nx ny"],
    soil: Bool[np.ndarray, "nx ny"],
    cell: float,
    source: float,
) -> float:
    """Variance of the noise times the area over which it is correlated [m^2 m^2].

    The variance of a volume is this times the area of its footprint.

    Args:
        height: Surface [m].
        seen: Cells that the scan saw.
        soil: Cells of any pile. The ground alone is looked at where there is enough of it.
        cell: Grid spacing [m].
        source: That of the file [m]: between its cells heights are interpolated.
    """
    unit = max(math.ceil(source / cell - 1e-6), 1)
    blocks = [unit * n for n in _BLOCKS]
    beside = ndimage.distance_transform_edt(~soil) * cell > _CLEAR if soil.any() else seen
    found = _differences(np.where(seen & beside, height, np.nan), blocks)
    if len(found) < len(blocks):
        found = _differences(np.where(seen, height, np.nan), blocks)
    if not found or min(variance for variance, _ in found) == 0.0:
        return 0.0
    measured, counts = np.array(found).T
    # A variance from median deviations has 0.37 of the samples of one from squares, and of those
    # windows that overlap about every third counts.
    weights = 1.0 / (measured * np.maximum(np.sqrt(2.0 / (0.37 * counts / 3.0)), _MODEL_ERROR))
    fits = []
    for length in (0.0, *_LENGTHS):
        lengths = (0.0, length) if length > 0.0 else (0.0,)
        model = np.array([[_share(n, one, cell) for one in lengths] for n in blocks[: len(found)]])
        amounts, misfit = optimize.nnls(model * weights[:, None], measured * weights)
        areas = np.array([cell**2, 4.0 * math.pi * length**2][: len(lengths)])
        fits.append((float(misfit) ** 2, float(amounts @ areas)))
    # White noise, unless a correlation is plain to see.
    best = min(fits)
    return fits[0][1] if fits[0][0] <= best[0] + _PLAIN else best[1]


def _differences(height: Float[np.ndarray, "nx ny"], blocks: list[int]) -> list[tuple[float, int]]:
    """Robust variances of second differences in both directions of means of blocks [m^2].

    Each with the number of differences, for each size of block that has enough of them; cells that
    do not count hold NaN.
    """
    found: list[tuple[float, int]] = []
    for block in blocks:
        if min(height.shape) < 3 * block:
            break
        means = _block_means(height, block)
        across = means[2:] - 2.0 * means[1:-1] + means[:-2]
        both = across[:, 2:] - 2.0 * across[:, 1:-1] + across[:, :-2]
        both = both[np.isfinite(both)]
        if both.size < _FEWEST:
            break
        found.append(((_NORMAL * float(np.median(np.abs(both)))) ** 2, both.size))
    return found


def _share(block: int, length: float, cell: float) -> float:
    """Variance of the differences of `_differences` for noise of variance 1.

    Args:
        block: Cells along a side of the blocks.
        length: Of the correlation, exp(-(d / 2 length)^2) at a distance d [m]; 0: none.
        cell: Grid spacing [m].
    """
    weights = np.repeat([1.0, -2.0, 1.0], block) / block
    lags = np.arange(weights.size) * cell
    correlation = np.exp(-((lags / (2.0 * length)) ** 2)) if length > 0.0 else (lags == 0.0) * 1.0
    # Both directions alike, and independent of each other.
    return float(weights @ linalg.toeplitz(correlation) @ weights) ** 2


def volume_deviation(
    height: Float[np.ndarray, "nx ny"],
    floor: Float[np.ndarray, "nx ny"],
    seen: Bool[np.ndarray, "nx ny"],
    inside: Bool[np.ndarray, "nx ny"],
    soil: Bool[np.ndarray, "nx ny"],
    *,
    cell: float,
    intensity: float,
) -> Deviation:
    """How uncertain the volume between a surface and a floor is.

    Args:
        height: Surface [m], filled where it was not seen.
        floor: Floor [m]; where it is the surface itself, the surface is ground.
        seen: Cells that the scan saw.
        inside: The footprint.
        soil: Cells of any pile: they tell nothing of the ground.
        cell: Grid spacing [m].
        intensity: Of the noise, from `noise_intensity`.
    """
    area = float(inside.sum()) * cell**2
    if area == 0.0:
        return Deviation(0.0, 0.0, 0.0)
    margin = math.ceil(_RING / cell) + 1
    i, j = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    part = (
        slice(max(int(i[0]) - margin, 0), int(i[-1]) + margin + 1),
        slice(max(int(j[0]) - margin, 0), int(j[-1]) + margin + 1),
    )
    near = height[part], floor[part], seen[part], inside[part]
    return Deviation(
        noise=math.sqrt(intensity * float((inside & seen).sum()) * cell**2),
        unseen=_unseen(*near, cell),
        floor=area * _floor_level(*near, soil[part], cell, intensity),
    )


def _unseen(
    height: Float[np.ndarray, "nx ny"],
    floor: Float[np.ndarray, "nx ny"],
    seen: Bool[np.ndarray, "nx ny"],
    inside: Bool[np.ndarray, "nx ny"],
    cell: float,
) -> float:
    """Deviation of the volume under what was not seen [m^3]."""
    hidden = inside & ~seen
    if not hidden.any() or not seen.any():
        return 0.0
    holes, count = ndimage.label(~seen)
    clear = ndimage.distance_transform_edt(seen) * cell > _CLEAR
    nearest = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    flat = height[tuple(nearest)]
    along = flat
    if clear.any():
        smooth = ndimage.gaussian_filter(height, 0.5 * _CLEAR / cell, mode="nearest")
        slopes = np.gradient(smooth, cell)
        k, m = ndimage.distance_transform_edt(~clear, return_distances=False, return_indices=True)
        own_i, own_j = np.indices(height.shape)
        along = height[k, m] + cell * (
            slopes[0][k, m] * (own_i - k) + slopes[1][k, m] * (own_j - m)
        )
        along = np.clip(along, floor, floor + 1.5 * max(float((height - floor).max()), 0.0))
    fills = [
        np.bincount(holes[hidden], weights=(fill - floor)[hidden], minlength=count + 1)
        for fill in (height, np.maximum(flat, floor), along)
    ]
    half = 0.5 * np.ptp(np.stack(fills), axis=0) * cell**2
    return float(np.sqrt((half**2).sum()))


def _floor_level(
    height: Float[np.ndarray, "nx ny"],
    floor: Float[np.ndarray, "nx ny"],
    seen: Bool[np.ndarray, "nx ny"],
    inside: Bool[np.ndarray, "nx ny"],
    soil: Bool[np.ndarray, "nx ny"],
    cell: float,
    intensity: float,
) -> float:
    """Deviation of the mean floor under a footprint [m]; 0 for a floor that is given."""
    distance = ndimage.distance_transform_edt(~inside) * cell
    ring = (distance > 0.0) & (distance <= _RING) & seen & ~soil
    ground = ring & (np.abs(height - floor) < 1e-6)
    if ring.sum() >= _LEAST_RING and 2 * ground.sum() < ring.sum():
        return 0.0
    if ground.sum() < _LEAST_RING:
        return _UNKNOWN_FLOOR * float(np.mean((height - floor)[inside]))
    points = np.argwhere(ground) * cell
    middle = np.argwhere(inside).mean(axis=0) * cell
    basis = np.column_stack([np.ones(len(points)), points - middle])
    plane, *_ = np.linalg.lstsq(basis, height[ground], rcond=None)
    rest = np.full(height.shape, np.nan)
    rest[ground] = height[ground] - basis @ plane
    variance = float(np.var(rest[ground]))
    # What the ground around lies on one side only adds to the variance at the middle, over that of
    # a mean of as many cells.
    leverage = len(points) * float(np.linalg.inv(basis.T @ basis)[0, 0])
    # Variance times area of correlation, as for the noise, but with what is uneven over metres.
    roughness = variance * cell**2
    for side in _ROUGH_BLOCKS:
        block = max(round(side / cell), 1)
        means = _block_means(rest, block, 0.5)
        means = means[np.isfinite(means)]
        if means.size >= _ROUGH_FEWEST:
            roughness = max(roughness, float(np.var(means)) * (block * cell) ** 2)
    length = math.sqrt(roughness / variance) if variance > 0.0 else cell
    # Cells at which the floor joins the ground, spaced a cell apart along the edge.
    edge = float((ground & (distance <= 1.5 * cell)).sum()) * cell
    joined = variance * length / max(edge, length) * leverage
    under = max(roughness - intensity, 0.0) / (float(inside.sum()) * cell**2)
    return math.sqrt(joined + under)


def _block_means(
    values: Float[np.ndarray, "nx ny"], block: int, least: float = 1.0
) -> Float[np.ndarray, "mx my"]:
    """Means of blocks of so many cells a side; NaN where too small a part of them is no NaN."""
    nx, ny = (n // block for n in values.shape)
    cut = values[: nx * block, : ny * block].reshape(nx, block, ny, block)
    known = np.isfinite(cut)
    count = known.sum(axis=(1, 3))
    total = np.where(known, cut, 0.0).sum(axis=(1, 3))
    return np.where(count >= least * block**2, total / np.maximum(count, 1), np.nan)
