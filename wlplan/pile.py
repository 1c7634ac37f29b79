"""Piles on a grid: seed piles with noise, volume, resampling, and the toe a loader drives up to.

Only `ground_height` and `volume` are JAX functions; the rest prepares piles on the host in numpy.
"""

from __future__ import annotations

import dataclasses
import math

import contourpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int
from scipy import ndimage

from wlplan.errors import InputError
from wlplan.machine import GRAVEL, WA320
from wlplan.types import Pile
from wlplan.units import CELL_SIZE

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
# Wavelength of the coarsest octave of the noise [m], just over a bucket width, and the number of
# octaves, each of half the wavelength and half the amplitude of the one before.
_NOISE_WAVELENGTH = 4.0
_NOISE_OCTAVES = 3

# Spacing of the points of a toe contour [m], and the step along it over which a heading is taken.
_CONTOUR_SPACING = 0.1
# Smallest pile that is worth a bucket [m^3], a third of a heaped one.
_SMALLEST_VOLUME = 1.0
# Distance ahead of the toe at which there must still be pile for a point to count [m]: the length
# of the bucket floor.
_AHEAD = WA320.bucket_depth


def ground_height(pile: Pile) -> Float[Array, "*batch nx ny"]:
    """Floor under the pile [m], world frame; level 0 where the pile carries no ground map."""
    return jnp.zeros_like(pile.height) if pile.ground is None else pile.ground


def volume(pile: Pile) -> Float[Array, "*batch"]:
    """Volume between the surface and the ground [m^3].

    Signed and linear in the height, so its gradient is one cell area everywhere and a volume
    ledger closes. Works under `jit`, `vmap` and in float64.
    """
    return jnp.sum(pile.height - ground_height(pile), axis=(-2, -1)) * pile.cell_size**2


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
    surface = surface + fade * _gradient_noise(x, y, noise, seed)
    return Pile(
        height=jnp.asarray(np.maximum(surface, 0.0).astype(_float_dtype())),
        cell_size=float(cell_size),
        origin=jnp.asarray(np.array([x[0], y[0]], dtype=_float_dtype())),
    )


def _float_dtype() -> np.dtype:
    """float32, or float64 under `jax_enable_x64`, without a warning from the conversion."""
    return np.dtype(jnp.zeros(()).dtype)


def _gradient_noise(
    x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"], amplitude: float, seed: int
) -> Float[np.ndarray, "nx ny"]:
    """Sum of octaves of gradient noise at the nodes of a grid [m], zero on each lattice point.

    A lattice of random slopes, blended with a quintic weight whose first two derivatives vanish
    at the lattice points, so that the surface has continuous curvature.
    """
    random = np.random.default_rng(seed)
    total = np.zeros((x.size, y.size))
    period = 64  # lattice points a side, far more than a pile spans
    for octave in range(_NOISE_OCTAVES):
        wavelength = _NOISE_WAVELENGTH / 2**octave
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
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)


def resample(pile: Pile, cell_size: float) -> Pile:
    """Put a pile on a grid of another spacing that covers the same area.

    The surface between the cells is bilinear. A finer grid takes its value at the new cell centres,
    a coarser one its mean over each new cell, which keeps the volume. Affine surfaces come out
    exactly. A new cell is valid if every cell that contributes to it is.

    Args:
        pile: Pile with at least 2 x 2 cells, no NaN.
        cell_size: New grid spacing [m].

    Raises:
        InputError: If the spacing is not positive or leaves fewer than 2 x 2 cells.
    """
    if not 0.0 < cell_size < math.inf:
        raise InputError(f"The cell size is {cell_size:g} m: it has to be positive.")
    ratio = cell_size / pile.cell_size
    if math.isclose(ratio, 1.0, rel_tol=1e-6):
        return pile
    old = np.asarray(pile.height).shape
    # The small allowance keeps 95 cells of 0.2 m at 190, not 189, of 0.1 m.
    new = tuple(math.floor(n / ratio + 1e-6) for n in old)
    if min(*old, *new) < 2:
        raise InputError(
            f"A grid of {old[0]} x {old[1]} cells of {pile.cell_size:g} m cannot be resampled to "
            f"{cell_size:g} m: both grids need at least 2 x 2 cells."
        )
    # New cell centres in units of old cells, from the first old cell; what does not fit a whole
    # new cell is left off on both sides alike.
    centres = [
        (np.arange(m) - 0.5 * (m - 1)) * ratio + 0.5 * (n - 1)
        for n, m in zip(old, new, strict=True)
    ]

    def regrid(values):
        values = np.asarray(values, dtype=np.float64)
        return _regrid_rows(_regrid_rows(values, centres[0], ratio).T, centres[1], ratio).T

    def as_jax(values):
        return jnp.asarray(values.astype(_float_dtype()))

    height = regrid(pile.height)
    ground = valid = None
    if pile.ground is not None:
        # Continuing a line past the outermost centres could lift the ground through the surface.
        ground = as_jax(np.minimum(regrid(pile.ground), height))
    if pile.valid is not None:
        unseen = ~np.asarray(pile.valid)
        unseen = _any_in_rows(_any_in_rows(unseen, centres[0], ratio).T, centres[1], ratio).T
        valid = jnp.asarray(~unseen)
    first = np.array([centres[0][0], centres[1][0]]) * pile.cell_size
    return Pile(
        height=as_jax(height),
        cell_size=float(cell_size),
        origin=as_jax(np.asarray(pile.origin, dtype=np.float64) + first),
        ground=ground,
        valid=valid,
    )


def _regrid_rows(
    values: Float[np.ndarray, "n k"], centres: Float[np.ndarray, " m"], ratio: float
) -> Float[np.ndarray, "m k"]:
    """Sample (ratio < 1) or average (ratio > 1) the piecewise linear surface along axis 0.

    The half cell outside the first and the last centre continues their line.
    """

    def piece(position):
        left = np.clip(np.floor(position).astype(int), 0, len(values) - 2)
        return left, (position - left)[:, np.newaxis]

    if ratio < 1.0:
        left, t = piece(centres)
        return (1.0 - t) * values[left] + t * values[left + 1]
    area = np.zeros_like(values)  # integral from the first centre to each other one
    np.cumsum(0.5 * (values[1:] + values[:-1]), axis=0, out=area[1:])

    def integral(position):
        left, t = piece(position)
        return area[left] + values[left] * t + (values[left + 1] - values[left]) * (0.5 * t * t)

    return (integral(centres + 0.5 * ratio) - integral(centres - 0.5 * ratio)) / ratio


def _any_in_rows(
    flags: Bool[np.ndarray, "n k"], centres: Float[np.ndarray, " m"], ratio: float
) -> Bool[np.ndarray, "m k"]:
    """Whether any row that contributes to the new one, as in `_regrid_rows`, has its flag set."""
    half = 0.5 * ratio if ratio > 1.0 else 0.0
    # The allowance leaves out rows whose weight is zero but for rounding.
    first = np.clip(np.floor(centres - half + 1e-6).astype(int), 0, len(flags) - 2)
    last = np.clip(np.ceil(centres + half - 1e-6).astype(int), 1, len(flags) - 1)
    count = np.concatenate([np.zeros_like(flags[:1], dtype=int), np.cumsum(flags, axis=0)])
    return count[last + 1] > count[np.minimum(first, last)]


@dataclasses.dataclass(frozen=True)
class ToeContour:
    """The edge of a pile, world frame, as points a fixed step apart with the pile on their left."""

    points: Float[np.ndarray, "n 2"]  # [m]
    heading: Float[np.ndarray, " n"]  # into the pile [rad], counter-clockwise from +x
    length: float  # [m]
    closed: bool  # False where the pile runs over the edge of the map
    accessible: Bool[np.ndarray, " n"]  # a bucket can start here on ground that the scan saw


def toe_contour(pile: Pile, *, rise: float = 0.15) -> ToeContour:
    """Trace the toe of the largest pile, by volume, on the grid.

    The toe is where the surface stands `rise` above the ground. Hollows inside the pile are not
    part of it. Where the pile runs over the edge of the map, the longest part inside is kept.

    A heading is the inward normal of the chord over one bucket width. A point is accessible if the
    cutting edge of a bucket there lies inside the map, the scan saw its cell, and the surface a
    bucket length ahead is still higher than `rise` above the ground.

    Args:
        pile: One pile, not a batch.
        rise: Height above the ground that counts as pile [m].

    Raises:
        InputError: If there is nothing to dig: no cell higher than `rise`, less than 1 m^3, or a
            footprint narrower than the bucket in every direction.
    """
    if not 0.0 < rise < math.inf:
        raise InputError(f"The rise is {rise:g} m: it has to be positive.")
    cell = pile.cell_size
    above = np.asarray(pile.height, np.float64)
    if pile.ground is not None:
        above = above - np.asarray(pile.ground, np.float64)
    # Only the part of the map that holds what is higher, with a border of what is not.
    higher = above > rise
    part = _bounds(higher)
    near, higher = above[part], higher[part]
    if higher.size == 0:
        raise InputError(
            f"Nothing to dig: no cell lies more than {rise:g} m above the ground; check the units "
            f"and the ground of the scan."
        )
    origin = np.asarray(pile.origin, np.float64)
    x, y = (origin[k] + cell * np.arange(part[k].start, part[k].stop) for k in (0, 1))
    lines = _level_lines(near, x, y, rise)
    if not _is_one_pile(lines, near, higher, cell):
        # Most piles are one, and to see that takes less time than to look for the largest.
        lines = _level_lines(_largest_alone(near, higher, rise, cell), x, y, rise)
    line = max(lines, key=lambda line: _distances(line)[-1])
    closed = bool(line[0] == line[-1]) and len(line) > 2

    marks = _distances(line)
    length = float(marks[-1])
    count = max(round(length / _CONTOUR_SPACING), 8)

    def along(distance: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Points at distances along the line [m]; a closed one wraps round, an open one ends."""
        inside = distance % length if closed else np.clip(distance, 0.0, length)
        return np.interp(inside, marks, line)

    at = np.linspace(0.0, length, count, endpoint=not closed)
    points = along(at)
    # Chords over one bucket width smooth out ripples.
    half = 0.5 * min(WA320.bucket_width, 0.5 * length)
    chord = along(at + half) - along(at - half)
    normal = 1j * chord / np.maximum(np.abs(chord), 1e-9)
    if closed:
        # A closed line has the pile inside: the pile is on the left if it runs round to the left.
        left = float(np.sum(line[:-1].real * line[1:].imag - line[:-1].imag * line[1:].real)) > 0.0
    else:
        sides = (_sample(above, points + d * normal, origin, cell).mean() for d in (0.2, -0.2))
        left = next(sides) >= next(sides)
    if not left:
        points, normal = points[::-1], -normal[::-1]

    edge = 0.5j * WA320.bucket_width * normal
    accessible = (
        _inside(points - edge, pile.height.shape, origin, cell)
        & _inside(points + edge, pile.height.shape, origin, cell)
        & (_sample(above, points + _AHEAD * normal, origin, cell) > rise)
    )
    if pile.valid is not None:
        seen = np.asarray(pile.valid, np.float64)
        accessible &= _sample(seen, points, origin, cell) > 1.0 - 1e-6
    pairs = np.stack([points.real, points.imag], axis=-1)
    return ToeContour(pairs, np.angle(normal), length, closed, accessible)


def _bounds(flags: Bool[np.ndarray, "nx ny"]) -> tuple[slice, slice]:
    """The part of a grid that holds all flags set, with a border of one cell inside the grid."""

    def span(indices: Int[np.ndarray, " n"], count: int) -> slice:
        if not len(indices):
            return slice(0, 0)
        return slice(max(int(indices[0]) - 1, 0), min(int(indices[-1]) + 2, count))

    nx, ny = flags.shape
    i, j = np.flatnonzero(flags.any(axis=1)), np.flatnonzero(flags.any(axis=0))
    return span(i, nx), span(j, ny)


def evenly_spaced(contour: ToeContour, n: int) -> Int[np.ndarray, " n"]:
    """Indices of `n` accessible points of a contour, evenly spaced along its accessible part.

    Raises:
        InputError: If the contour has fewer than `n` accessible points.
    """
    candidates = np.flatnonzero(contour.accessible)
    if not 1 <= n <= candidates.size:
        raise InputError(
            f"{n} dig locations asked for, but the toe has {candidates.size} accessible points: "
            f"ask for 1 to {candidates.size}."
        )
    return candidates[((np.arange(n) + 0.5) * candidates.size / n).astype(int)]


# In what follows points of the plane are complex numbers x + iy [m], which numpy handles at once.


def _level_lines(
    height: Float[np.ndarray, "n m"],
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " m"],
    level: float,
) -> list[Complex[np.ndarray, " _"]]:
    """The lines on which a surface has a height; closed ones end where they begin."""
    # contourpy's own function for this looks for masked cells, which takes as long again.
    across, up = np.meshgrid(x, y)
    generator = contourpy.SerialContourGenerator(
        across,
        up,
        height.T,
        np.asarray(False),  # no mask
        corner_mask=False,
        line_type=contourpy.LineType.Separate,
        fill_type=contourpy.FillType.OuterCode,
        quad_as_tri=False,
        z_interp=contourpy.ZInterp.Linear,
    )
    return [np.ascontiguousarray(line).view(np.complex128)[:, 0] for line in generator.lines(level)]


def _is_one_pile(
    lines: list[Complex[np.ndarray, " _"]],
    above: Float[np.ndarray, "n m"],
    higher: Bool[np.ndarray, "n m"],
    cell: float,
) -> bool:
    """Whether level lines are for certain the edge of a single pile that is worth digging."""
    if len(lines) != 1 or lines[0][0] != lines[0][-1] or higher[0, 0]:
        return False
    # Where cells meet at a corner only, the line does not tell whether they are one pile.
    one, other = higher[:-1] ^ higher[1:], higher[:, :-1] ^ higher[:, 1:]
    if (one[:, :-1] & one[:, 1:] & other[:-1] & other[1:]).any():
        return False
    size = cell * (max(higher.shape) - 2)
    return size >= WA320.bucket_width and bool(above[higher].sum() * cell**2 >= _SMALLEST_VOLUME)


def _largest_alone(
    above: Float[np.ndarray, "n m"], higher: Bool[np.ndarray, "n m"], rise: float, cell: float
) -> Float[np.ndarray, "n m"]:
    """The surface with all piles but the largest sunk, and its hollows filled, to about the level.

    Raises:
        InputError: If the largest is not worth digging.
    """
    labels, _ = ndimage.label(higher)
    volumes = np.bincount(labels.ravel(), weights=above.ravel())[1:] * cell**2
    largest = labels == 1 + int(np.argmax(volumes))
    extent = cell * max(side.stop - side.start - 2 for side in _bounds(largest))
    if extent < WA320.bucket_width:
        extent = _largest_extent(np.argwhere(largest) * cell) + cell
    if volumes.max() < _SMALLEST_VOLUME or extent < WA320.bucket_width:
        raise InputError(
            f"Nothing to dig: the largest pile holds {volumes.max():.2g} m^3 and is {extent:.2g} m "
            f"long; a bucket needs {_SMALLEST_VOLUME:g} m^3 and {WA320.bucket_width:g} m."
        )
    # What is outside is in one piece, unless there are hollows or the pile runs over the edge.
    solid = largest if ndimage.label(~largest)[1] == 1 else ndimage.binary_fill_holes(largest)
    alone = np.where(solid, above, np.minimum(above, rise - 1e-6))
    return np.where(solid & ~largest, np.maximum(alone, rise + 1e-6), alone)


def _largest_extent(points: Float[np.ndarray, "n 2"]) -> float:
    """Longest side of the bounding boxes of a cloud over all directions, to 2 %."""
    angle = np.linspace(0.0, math.pi, 16, endpoint=False)
    along = points @ np.stack([np.cos(angle), np.sin(angle)])
    return float(np.max(along.max(axis=0) - along.min(axis=0)))


def _distances(line: Complex[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """How far along a line each of its points lies [m]."""
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(line)))])


def _inside(
    points: Complex[np.ndarray, " n"],
    shape: tuple[int, ...],
    origin: Float[np.ndarray, "2"],
    cell: float,
) -> Bool[np.ndarray, " n"]:
    cells = (points - complex(*origin)) / cell
    i, j, last = cells.real, cells.imag, np.array(shape) - 1 + 1e-6
    return (i >= -1e-6) & (i <= last[0]) & (j >= -1e-6) & (j <= last[1])


def _sample(
    values: Float[np.ndarray, "nx ny"],
    points: Complex[np.ndarray, " n"],
    origin: Float[np.ndarray, "2"],
    cell: float,
) -> Float[np.ndarray, " n"]:
    """Bilinear values at points of the world; outside the map those of its edge."""
    cells = (points - complex(*origin)) / cell
    at = np.stack([cells.real, cells.imag])
    return ndimage.map_coordinates(values, at, order=1, mode="nearest")
