"""The bed that piles are cut from: spheres poured onto a floor and settled, the same every time."""

from __future__ import annotations

import numpy as np

from wlplan.engines.dem.engine import Engine
from wlplan.engines.dem.grains import Grains
from wlplan.engines.dem.packing import Bed

# Periods along x and y, and depth aimed at, of the settled bed [m]: deep enough for a slope of 30
# degrees over the reach of a loading.
LENGTHS, DEPTH = (7.0, 6.6), 3.0
# Density of a sphere's material [kg/m^3]; the bed's shape hardly depends on it.
_SOLID_DENSITY = 2700.0
# Packing fraction expected of the bed, to tell how many spheres make the depth.
_EXPECTED = 0.64
# Spacing of the lattice that the spheres fall from, in mean diameters, and by which part of a
# radius they are moved at random.
_SPACING, _DISORDER = 1.12, 0.5
# Time of settling with drag [s], the drag [N s/m], and time to come to rest under full friction.
_SETTLING, _DRAG, _RESTING = 2.5, 3.0, 0.2


def make_bed(grains: Grains, step: float) -> Bed:
    """Pours and settles a bed.

    Args:
        grains: Its spheres.
        step: Time step [s].

    Raises:
        InputError: If the engine is missing.
    """
    centre, radius, height = _lattice(grains)
    lengths = np.array(LENGTHS)
    box = np.array([[0.0, lengths[0]], [0.0, lengths[1]], [-0.2, height + 0.5]])
    with Engine(
        centre,
        radius,
        density=_SOLID_DENSITY,
        grains=grains,
        box=box,
        periodic=True,
        step=step,
    ) as engine:
        # Little friction packs densely; it is all there before the bed is used.
        engine.rub(grains.settling_friction, 0.0)
        engine.run(_SETTLING, drag=_DRAG)
        engine.rub(grains.friction, grains.rolling)
        engine.run(_RESTING, drag=_DRAG)
        engine.run(_RESTING)
        centre, radius, _ = engine.grains_now()
    centre[:, :2] %= lengths
    return Bed(centre, radius, lengths, packing_fraction(centre, radius, lengths))


def packing_fraction(centre: np.ndarray, radius: np.ndarray, lengths: np.ndarray) -> float:
    """Solid part of a bed's volume, away from its floor and its top.

    Args:
        centre: Centres [m], shape [n, 3].
        radius: Radii [m], shape [n].
        lengths: Periods of the bed [m], shape [2].
    """
    z = centre[:, 2]
    low, high = 0.4, float(np.percentile(z, 97.0)) - 0.4
    solid = 4.0 / 3.0 * np.pi * (radius[(z > low) & (z < high)] ** 3).sum()
    return float(solid / (lengths.prod() * (high - low)))


def _lattice(grains: Grains) -> tuple[np.ndarray, np.ndarray, float]:
    """Spheres of all sizes on a lattice, a little out of place: centres, radii, height [m]."""
    rng = np.random.default_rng(1)
    spacing = 2.0 * grains.radius * _SPACING
    low, high = grains.smallest * grains.radius, grains.largest * grains.radius
    nx, ny = (int(length / spacing) for length in LENGTHS)
    # Mean of the cube of a radius that is uniform between low and high.
    cube = (high**4 - low**4) / (4.0 * (high - low))
    layer = nx * ny * 4.0 / 3.0 * np.pi * cube / (LENGTHS[0] * LENGTHS[1])
    nz = int(np.ceil(_EXPECTED * DEPTH / layer))
    axes = (
        np.arange(nx) * LENGTHS[0] / nx,
        np.arange(ny) * LENGTHS[1] / ny,
        (np.arange(nz) + 0.5) * spacing,
    )
    centre = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    centre[:, :2] += _DISORDER * grains.radius * rng.uniform(-0.2, 0.2, (len(centre), 2))
    radius = rng.uniform(low, high, len(centre))
    return centre, radius, nz * spacing
