"""Gradient noise: the bumps of seed piles."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

# Wavelength of the coarsest octave of the noise [m], just over a bucket width, and the number of
# octaves, each of half the wavelength and half the amplitude of the one before.
_WAVELENGTH = 4.0
_OCTAVES = 3


def gradient_noise(
    x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"], amplitude: float, seed: int
) -> Float[np.ndarray, "nx ny"]:
    """Sum of octaves of gradient noise at the nodes of a grid [m], zero on each lattice point.

    A lattice of random slopes, blended with a quintic weight whose first two derivatives vanish
    at the lattice points, so that the surface has continuous curvature.

    Args:
        x: Coordinates of the nodes [m].
        y: Likewise, along the other axis.
        amplitude: Bound of the coarsest octave [m].
        seed: Of slopes and lattices.
    """
    random = np.random.default_rng(seed)
    total = np.zeros((x.size, y.size))
    period = 64  # lattice points a side, far more than a pile spans
    for octave in range(_OCTAVES):
        wavelength = _WAVELENGTH / 2**octave
        shift = random.uniform(0.0, period, 2)
        angle = random.uniform(0.0, 2.0 * math.pi, (period, period))
        u, v = x / wavelength + shift[0], y / wavelength + shift[1]
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        u, v = u - i, v - j
        # The weight of a lattice point is a product of one along each axis. So the points are
        # summed along y first, for each line of the lattice, then along x.
        on_x, on_y = np.zeros((period, y.size)), np.zeros((period, y.size))
        for dj in (0, 1):
            weight, column = _quintic(1.0 - np.abs(v - dj)), (j + dj) % period
            on_x += weight * np.cos(angle)[:, column]
            on_y += weight * (v - dj) * np.sin(angle)[:, column]
        octave_sum = np.zeros_like(total)
        for di in (0, 1):
            weight, row = _quintic(1.0 - np.abs(u - di))[:, np.newaxis], (i + di) % period
            octave_sum += weight * (u - di)[:, np.newaxis] * on_x[row] + weight * on_y[row]
        # One octave of unit slopes lies within +-1/sqrt(2).
        total += math.sqrt(2.0) * amplitude / 2**octave * octave_sum
    return total


def _quintic(t: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    blend: np.ndarray = t * t * t * (t * (6.0 * t - 15.0) + 10.0)
    return blend
