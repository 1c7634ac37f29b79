"""The bucket: its section, scaled to the machine, and the spheres that its plates consist of."""

from __future__ import annotations

import math

import numpy as np

from wlplan.errors import InputError
from wlplan.site.machine import WheelLoader

# Section of the bucket from the cutting edge along the floor and up the back wall: forward and up
# from the cutting edge of a level bucket [m]. Estimate from side views of general-purpose buckets;
# for `_DEPTH` of floor [m] and, 2.70 m wide, 3.10 m^3 heaped.
_SECTION = np.array(
    [[0.0, 0.0], [-0.98, 0.0], [-1.22, 0.12], [-1.32, 0.38], [-1.30, 0.78], [-0.98, 1.17]]
)
_DEPTH = 1.10

# Distance between the spheres of the plates and their radius [m]: no gap lets a grain through.
SPACING, PLATE_RADIUS = 0.075, 0.05


def _area(section: np.ndarray) -> float:
    x, z = section.T
    return abs(0.5 * float(np.sum(x * np.roll(z, -1) - np.roll(x, -1) * z)))


def section_of(machine: WheelLoader) -> np.ndarray:
    """Section of a machine's bucket, in the frame of its cutting edge [m], shape [6, 2].

    The drawing is stretched along the floor to the machine's bucket depth, and in height until the
    heaped volume is the machine's: with a heap of slope 1:2 over the opening, as buckets are rated
    (ISO 7546).

    Raises:
        InputError: If no height gives that volume.
    """
    stretch = machine.bucket_depth / _DEPTH
    # The heap is a ridge of slope 1:2 along the middle of the opening, a quarter of it high:
    # heaped / width = area * s * h + ((length * s)^2 + (height * h)^2) / 8, solved for h.
    length, height = _SECTION[-1]
    a = height**2 / 8.0
    b = _area(_SECTION) * stretch
    c = (length * stretch) ** 2 / 8.0 - machine.bucket_heaped / machine.bucket_width
    rise = (-b + math.sqrt(max(b * b - 4.0 * a * c, 0.0))) / (2.0 * a)
    if not 0.3 <= rise <= 3.0:
        raise InputError(
            f"a bucket {machine.bucket_width:g} m wide and {machine.bucket_depth:g} m deep does "
            f"not hold {machine.bucket_heaped:g} m³ heaped at any sensible height: check "
            f"bucket_heaped, bucket_depth and bucket_width."
        )
    section: np.ndarray = _SECTION * np.array([stretch, rise])
    return section


def plate_spheres(machine: WheelLoader) -> np.ndarray:
    """Centres of the spheres of floor, back and side plates [m], shape [n, 3].

    In the frame of the cutting edge of a level bucket: x forward, y left, z up.
    """
    section = section_of(machine)
    half = machine.bucket_width / 2.0
    across = np.linspace(-half, half, math.ceil(machine.bucket_width / SPACING) + 1)
    line = _along(section)
    shell = np.insert(np.repeat(line, len(across), axis=0), 1, np.tile(across, len(line)), axis=1)
    side = _side(section)
    sides = [np.insert(side, 1, sign * half, axis=1) for sign in (-1.0, 1.0)]
    return np.concatenate([shell, *sides])


def _along(section: np.ndarray) -> np.ndarray:
    """Points along the section, at most `SPACING` apart."""
    lengths = np.linalg.norm(np.diff(section, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = np.linspace(0.0, reached[-1], math.ceil(reached[-1] / SPACING) + 1)
    return np.stack([np.interp(wanted, reached, section[:, k]) for k in (0, 1)], axis=1)


def _side(section: np.ndarray) -> np.ndarray:
    """Points of a side plate: a lattice inside the section, and its open edge."""
    low, high = section.min(axis=0), section.max(axis=0)
    axes = (np.arange(low[0], high[0], SPACING), np.arange(low[1], high[1], SPACING))
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    lattice = lattice[inside(section, lattice)]
    count = int(np.linalg.norm(section[-1]) / SPACING)
    edge = np.linspace(section[0], section[-1], count)[1:-1]
    return np.concatenate([lattice, edge])


def inside(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points lie inside a polygon, by counting crossings of a ray.

    Args:
        polygon: Corners in order [m], shape [n, 2].
        points: Points [m], shape [m, 2].
    """
    x, z = points[:, :1], points[:, 1:]
    x0, z0 = polygon.T
    x1, z1 = np.roll(polygon, -1, axis=0).T
    straddles = (z0 > z) != (z1 > z)
    rise = np.where(z1 == z0, 1.0, z1 - z0)
    crossing = x0 + (z - z0) * (x1 - x0) / rise
    odd: np.ndarray = (straddles & (x < crossing)).sum(axis=1) % 2
    return odd.astype(bool)
