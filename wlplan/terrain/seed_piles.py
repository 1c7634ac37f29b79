"""Seed piles: simple shapes with noise. Paper, section 6.2."""

from __future__ import annotations

import math

import numpy as np

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.site.soil import GRAVEL
from wlplan.terrain.noise import gradient_noise
from wlplan.types import Pile
from wlplan.xla import floats

# The seed piles of the paper, as (kind, slope [rad]). Paper, section 6.2: two triangular, two
# conical and two wedged, at 20 and 30 degrees.
SEED_PILES: tuple[tuple[str, float], ...] = tuple(
    (kind, math.radians(degrees))
    for kind in ("triangular", "conical", "wedge")
    for degrees in (20.0, 30.0)
)

# Height of each kind [m]. The prism: follow-up, its benchmark pile. The others are our choice: the
# paper gives no sizes, and these hold 160 to 230 m^3, three times what 30 loadings take.
_HEIGHT = {"triangular": 3.5, "conical": 4.0, "wedge": 3.5, "prism": 1.8}
# Longest default footprint, level ground kept around it, and how far off the toe the noise may
# reach [m]. Together they keep a default grid at 22 m, 221 cells of 0.1 m, a side.
_FOOTPRINT = 15.2
_MARGIN = 3.4
_NOISE_REACH = 0.4
# Width of the level top of the prism and the length of its crest [m]. Our choice.
_PRISM_TOP = 4.0
_PRISM_LENGTH = 8.0


def seed_pile(
    kind: str,
    *,
    slope: float,
    height: float | None = None,
    length: float | None = None,
    noise: float = 0.2,
    seed: int = 0,
    cell_size: float = CELL_SIZE,
) -> Pile:
    """Build a pile of a simple shape with gradient noise, on level ground at 0.

    The footprint without noise is centred at the world origin, with at least 3 m of ground around
    it. The noise moves the surface and the toe, and steep spots are left as they are: relax the
    pile before use.

    Args:
        kind: "triangular", a ridge along y with rounded ends; "conical"; "wedge", a face that
            rises along +x to a crest along y and drops behind it; or "prism", the trapezoidal
            ridge along y of the follow-up's benchmark. Ends and back lie at the angle of repose
            of gravel.
        slope: Slope of the faces [rad].
        height: Height without noise [m]; by default 3.5 to 4 m at 30 degrees (1.8 m for the prism),
            less where the footprint would outgrow the default grid.
        length: Length of the crest along y [m]; not for a cone.
        noise: Amplitude of the coarsest octave of the noise [m]; 0 for none.
        seed: Seed of the noise. The same seed gives the same surface at every cell size.
        cell_size: Grid spacing [m].

    Raises:
        InputError: If a parameter is out of range.
    """
    if kind not in _HEIGHT:
        raise InputError(f"Unknown kind of pile {kind!r}: choose one of {', '.join(_HEIGHT)}.")
    if not 0.0 < slope < math.radians(60.0):
        raise InputError(f"The slope is {slope:g} rad: give radians between 0 and {math.pi / 3:g}.")
    if length is not None and kind == "conical":
        raise InputError("A conical pile has no crest: leave `length` out.")
    for name, value in (("height", height), ("length", length), ("cell_size", cell_size)):
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(f"The {name} is {value:g} m: it has to be positive.")
    if not 0.0 <= noise < math.inf:
        raise InputError(f"The noise amplitude is {noise:g} m: it has to be 0 or more.")

    face, repose = math.tan(slope), math.tan(GRAVEL.repose_angle)
    if height is None:
        height = min(_HEIGHT[kind], 0.5 * _FOOTPRINT * face)
    run, end = height / face, height / repose  # horizontal run of a face and of an end
    if kind == "conical":
        length, end = 0.0, run
    elif length is None:
        length = _PRISM_LENGTH if kind == "prism" else max(_FOOTPRINT - 2.0 * end, 2.0)
    half_x = {"wedge": 0.5 * (run + end), "prism": run + 0.5 * _PRISM_TOP}.get(kind, run)
    half_y = 0.5 * length + end

    x, y = (
        cell_size * np.arange(-n, n + 1)
        for n in (math.ceil((half + _MARGIN) / cell_size) for half in (half_x, half_y))
    )
    along_x, along_y = np.meshgrid(x, y, indexing="ij")
    past_crest = np.maximum(np.abs(along_y) - 0.5 * length, 0.0)
    # The faces run on below the ground, which tells how far off the pile a point is.
    if kind == "conical":
        surface = height - face * np.hypot(along_x, along_y)
    elif kind == "triangular":
        surface = height - np.hypot(face * along_x, repose * past_crest)
    elif kind == "wedge":
        past_x = along_x - (run - half_x)
        surface = height - np.maximum(np.maximum(-face * past_x, repose * past_x), 0.0)
        surface = np.minimum(surface, height - repose * past_crest)
    else:
        past_x = np.maximum(np.abs(along_x) - 0.5 * _PRISM_TOP, 0.0)
        surface = height - np.maximum(face * past_x, repose * past_crest)

    fade = np.clip(1.0 + surface / (_NOISE_REACH * face), 0.0, 1.0)
    surface = surface + fade * gradient_noise(x, y, noise, seed)
    return Pile(
        height=floats(np.maximum(surface, 0.0)),
        cell_size=float(cell_size),
        origin=floats(np.array([x[0], y[0]])),
    )
