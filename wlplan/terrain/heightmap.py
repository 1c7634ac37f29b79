"""Local heightmaps: the pile as seen from a dig pose, sampled and written back.

Sampling is bilinear, so it is differentiable in the pose (with a kink where a sample crosses the
line between two cell centres). Outside the grid the border value is repeated. Cubic sampling has no
such kinks, costs more, and is there for who asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from wlplan.constants import CELL_SIZE
from wlplan.types import LocalHeightmap, Pile, Pose
from wlplan.xla import materialize

# Paper, section 6.3: 3.6 m for the performance predictor, which leaves 0.5 m on either side of the
# bucket; 5.2 m displaced by 1.0 m towards the approach for the pile state predictor.
PERFORMANCE_CELLS, PERFORMANCE_DISPLACEMENT = 36, 0.0
STATE_CELLS, STATE_DISPLACEMENT = 52, 1.0


def local_axes(cells: int, displacement: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the rows along e_x and of the columns along e_y of a local heightmap [m]."""
    return (
        np.arange(cells) * CELL_SIZE - displacement,
        (np.arange(cells) - (cells - 1) / 2) * CELL_SIZE,
    )


def sample(
    field: Float[Array, "nx ny"], pile: Pile, x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Bilinear interpolation of a field on the pile's grid at world positions [m]."""
    nx, ny = field.shape
    u = jnp.clip((x - pile.origin[0]) / pile.cell_size, 0.0, nx - 1.0)
    v = jnp.clip((y - pile.origin[1]) / pile.cell_size, 0.0, ny - 1.0)
    i = jnp.clip(jnp.floor(u), 0, nx - 2).astype(jnp.int32)
    j = jnp.clip(jnp.floor(v), 0, ny - 2).astype(jnp.int32)
    a, b = u - i, v - j
    flat = field.reshape(-1)
    corner = i * ny + j
    h00, h01, h10, h11 = (flat[corner + step] for step in (0, 1, ny, ny + 1))
    return (1 - a) * ((1 - b) * h00 + b * h01) + a * ((1 - b) * h10 + b * h11)


def sample_cubic(
    field: Float[Array, "nx ny"], pile: Pile, x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Cubic interpolation of a field on the pile's grid at world positions [m].

    Catmull and Rom's: it keeps the values at the cells, and parabolas, and has a continuous
    derivative. Beside an edge it may leave the range of the cells around, by an eighth of a step
    between two levels. Bilinear sampling stays within, and blurs what lies half way between cells.
    """
    nx, ny = field.shape
    u = jnp.clip((x - pile.origin[0]) / pile.cell_size, 0.0, nx - 1.0)
    v = jnp.clip((y - pile.origin[1]) / pile.cell_size, 0.0, ny - 1.0)
    i = jnp.clip(jnp.floor(u), 0, nx - 2).astype(jnp.int32)
    j = jnp.clip(jnp.floor(v), 0, ny - 2).astype(jnp.int32)
    # Two cells of border all around, which continue the line of the last two: so planes are kept.
    # The cell before [i, j] is [i + 1, j + 1] there.
    flat = jnp.pad(field, 2, mode="reflect", reflect_type="odd").reshape(-1)
    corner = (i + 1) * (ny + 4) + j + 1
    rows = [
        _catmull_rom([flat[corner + k * (ny + 4) + n] for n in range(4)], v - j) for k in range(4)
    ]
    return _catmull_rom(rows, u - i)


def _catmull_rom(points: Sequence[Array], t: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The curve through four points in a row, a part t of the way from the second to the third."""
    before, here, there, beyond = points
    return here + 0.5 * t * (
        there
        - before
        + t
        * (
            2.0 * before
            - 5.0 * here
            + 4.0 * there
            - beyond
            + t * (3.0 * (here - there) + beyond - before)
        )
    )


Sampling = Callable[..., Array]
"""`sampling(field, pile, x, y)`: `sample` or `sample_cubic`."""


def to_world(
    pose: Pose, along: Float[Array, "*n"], left: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """World position of points given in the local frame of a pose [m]."""
    c, s = jnp.cos(pose.heading), jnp.sin(pose.heading)
    return pose.x + c * along - s * left, pose.y + s * along + c * left


def to_local(
    pose: Pose, x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Position along e_x and e_y of points given in the world frame [m]."""
    c, s = jnp.cos(pose.heading), jnp.sin(pose.heading)
    dx, dy = x - pose.x, y - pose.y
    return c * dx + s * dy, c * dy - s * dx


def cell_centres(pile: Pile) -> tuple[Float[Array, "nx ny"], Float[Array, "nx ny"]]:
    """World positions x and y of the cells of a pile [m]."""
    nx, ny = pile.height.shape
    dtype = pile.height.dtype
    x = pile.origin[0] + pile.cell_size * jnp.arange(nx, dtype=dtype)
    y = pile.origin[1] + pile.cell_size * jnp.arange(ny, dtype=dtype)
    return jnp.broadcast_to(x[:, None], (nx, ny)), jnp.broadcast_to(y[None, :], (nx, ny))


def local_points(
    pose: Pose, cells: int, displacement: float, dtype: np.dtype
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """World positions x and y of the cells of a local map [m]; arguments as for `sample_local`."""
    along, left = (jnp.asarray(a, dtype) for a in local_axes(cells, displacement))
    return to_world(pose, *jnp.meshgrid(along, left, indexing="ij"))


def sample_local(
    pile: Pile,
    pose: Pose,
    *,
    cells: int = PERFORMANCE_CELLS,
    displacement: float = PERFORMANCE_DISPLACEMENT,
    sampling: Sampling = sample,
) -> LocalHeightmap:
    """The local heightmap of the paper's section 4.2 at one dig pose.

    Args:
        pile: The pile; its own spacing may differ from the 0.1 m of the map.
        pose: Dig location and heading.
        cells: Cells a side: 36 for the performance predictor, 52 for the pile state predictor.
        displacement: How far the map begins before the dig location [m].
        sampling: How heights between the cells are found.
    """
    points = local_points(pose, cells, displacement, pile.height.dtype)
    height = materialize(sampling(pile.height, pile, *points), pile.height[0, 0])
    first = sampling(
        pile.height, pile, *to_world(pose, jnp.asarray(-displacement), jnp.asarray(0.0))
    )
    return LocalHeightmap(height - first, CELL_SIZE, displacement)


def cut_out(pile: Pile, start: tuple[Array, ...] | Array, sizes: tuple[int, ...]) -> Pile:
    """A part of the grid, its origin left as it was.

    Args:
        pile: One pile.
        start: First cell of the part.
        sizes: Its cells along x and y.
    """

    def cut(field: Array | None) -> Array | None:
        return None if field is None else lax.dynamic_slice(field, start, sizes)

    return pile.replace(height=cut(pile.height), ground=cut(pile.ground), valid=cut(pile.valid))


def part_around(
    pile: Pile, x: Float[Array, ""], y: Float[Array, ""], cells: int
) -> tuple[Pile, tuple[Int[Array, ""], Int[Array, ""]]]:
    """The square part of a grid around a point of the world, and its first cell.

    It lies inside the grid. A side of the grid with fewer cells is kept whole.

    Args:
        pile: One pile.
        x: Middle of the part [m].
        y: Likewise.
        cells: Cells a side.
    """
    sizes = tuple(min(cells, n) for n in pile.height.shape)
    middle = ((x - pile.origin[0]) / pile.cell_size, (y - pile.origin[1]) / pile.cell_size)
    start = tuple(
        jnp.clip(jnp.round(lax.stop_gradient(position)).astype(jnp.int32) - size // 2, 0, n - size)
        for position, size, n in zip(middle, sizes, pile.height.shape, strict=True)
    )
    part = cut_out(pile, start, sizes)
    corner = jnp.stack([s.astype(pile.height.dtype) for s in start])
    origin = jnp.asarray(pile.origin) + pile.cell_size * corner
    return part.replace(origin=origin), (start[0], start[1])


def add_local_change(
    height: Float[Array, "nx ny"],
    window: Pile,
    pose: Pose,
    change: Float[Array, "n n"],
    displacement: float,
) -> tuple[Float[Array, "nx ny"], Float[Array, ""]]:
    """Writes a change of the local heightmap back to the grid, mass exact.

    The change is interpolated at the cells of the grid. Losses and gains are scaled, each by a
    factor close to one, so that both move exactly the volume that they move in the local frame;
    no cell is dug below the floor, and nothing changes behind what stands there. Where less can be
    taken than is to be lost, as on a pile that is used up or beyond the edge of the map, less is
    laid down too, down to nothing: no soil comes from nowhere. What would be laid down beyond the
    edge stays where it was.

    Args:
        height: Surface to change [m].
        window: Pile on the same grid, for geometry and floor.
        pose: Pose of the local frame.
        change: Change of the local heightmap [m].
        displacement: How far the local map begins before the dig location [m].

    Returns:
        The surface after [m], and what was to be lost and is not, for want of soil [m^3].
    """
    n = change.shape[0]
    # A batch of changes at one pose: compiled for a CPU, sums over the grid are off by some percent
    # unless the pose belongs to the batch too.
    pose = jax.tree.map(lambda value: value + 0.0 * lax.stop_gradient(change[0, 0]), pose)
    # The map reaches half a diagonal on either side of its middle, wherever it is turned to.
    middle = to_world(pose, jnp.asarray(0.5 * (n - 1) * CELL_SIZE - displacement), jnp.asarray(0.0))
    reach = math.sqrt(2.0) * (n + 1) * CELL_SIZE / window.cell_size
    near, start = part_around(window, *middle, math.ceil(reach) + 2)
    along, left = to_local(pose, *cell_centres(near))
    # A border of zeros lets the change fade to nothing outside the local map.
    free = 1.0 if window.ground is None else _within_reach(window, pose, n, displacement)
    padded = jnp.pad(free * change, 1)
    corner = (-displacement - CELL_SIZE, -(n + 1) / 2 * CELL_SIZE)
    frame = Pile(padded, CELL_SIZE, jnp.asarray(corner, change.dtype))
    inside = (jnp.abs(left) < (n + 1) / 2 * CELL_SIZE) & (
        jnp.abs(along - (n - 1) / 2 * CELL_SIZE + displacement) < (n + 1) / 2 * CELL_SIZE
    )
    on_grid = jnp.where(inside, sample(padded, frame, along, left), 0.0)
    on_grid = materialize(on_grid, change[0, 0])
    surface = lax.dynamic_slice(height, start, on_grid.shape)
    available = jnp.maximum(surface - near.floor, 0.0)
    area_ratio = (CELL_SIZE / window.cell_size) ** 2
    lost = area_ratio * jnp.maximum(-change, 0.0).sum()
    gained = area_ratio * jnp.maximum(change, 0.0).sum()
    loss = take(jnp.maximum(-on_grid, 0.0), available, lost)
    found = loss.sum()
    short = lax.stop_gradient(lost - found)
    # What could not be taken is not laid down either.
    spared = jnp.clip(short, 0.0, lax.stop_gradient(gained))
    gained, short = gained - spared, short - spared
    gain = jnp.maximum(on_grid, 0.0)
    total = gain.sum()
    # A few cells at the edge of the map do not take what many beyond it would.
    kept = jnp.maximum(gained - _LARGEST_GAIN * total, 0.0)
    whole = jnp.where(kept > 0.0, jnp.maximum(found, kept), 1.0)
    less = jnp.where(kept > 0.0, jnp.maximum(found - kept, 0.0) / whole, 1.0)
    scale = jnp.where(total > 0.0, (gained - kept) / jnp.where(total > 0.0, total, 1.0), 0.0)
    missing = short * window.cell_size**2
    return lax.dynamic_update_slice(height, surface - less * loss + scale * gain, start), missing


def _within_reach(
    window: Pile, pose: Pose, cells: int, displacement: float
) -> Float[Array, "cells cells"]:
    """Cells of a local map that a bucket and its soil can come to: 1, and 0 behind what stands.

    Ahead along the middle, and from there to the sides, as far as nothing stands in between.
    """
    points = local_points(pose, cells, displacement, window.height.dtype)
    ground = lax.stop_gradient(sample(window.floor, window, *points))
    stands = jnp.zeros((cells, cells), bool)
    for axis in (0, 1):
        steps = jnp.abs(jnp.diff(ground, axis=axis)) > _STANDS * CELL_SIZE
        for before in ((1, 0), (0, 1)):
            widths = [before if k == axis else (0, 0) for k in (0, 1)]
            stands = stands | jnp.pad(steps, widths)
    clear = 1.0 - stands.astype(ground.dtype)
    middle = cells // 2
    ahead = jnp.cumprod(clear[:, middle - 1 : middle + 1].min(axis=1))
    right = jnp.cumprod(clear[:, middle - 1 :: -1], axis=1)[:, ::-1]
    left = jnp.cumprod(clear[:, middle:], axis=1)
    return ahead[:, None] * jnp.concatenate([right, left], axis=1)


def take(
    wanted: Float[Array, "nx ny"], available: Float[Array, "nx ny"], total: Float[Array, ""]
) -> Float[Array, "nx ny"]:
    """Scales what is wanted of each cell so that `total` is taken in all, as far as it is there.

    The scale s solves sum(min(s * wanted, available)) = total, by Newton's method on a concave
    piecewise linear function; the last, differentiable step carries the implicit gradient.
    """

    def newton(scale: Array, wanted: Array, available: Array, total: Array) -> tuple[Array, Array]:
        """The next scale, and which cells follow it; the others give all they have."""
        amount = scale * wanted
        short = jnp.minimum(amount, available).sum() < total
        # A cell that is just used up follows the scale down, not up. Rate and result have to agree
        # on that: or a cell with next to nothing in it makes a rate that others multiply.
        follows = jnp.where(short, amount < available, amount <= available)
        rate = lax.stop_gradient(jnp.where(follows, wanted, 0.0).sum())
        missing = total - jnp.where(follows, amount, available).sum()
        step = jnp.where(rate > 0.0, missing / jnp.where(rate > 0.0, rate, 1.0), 0.0)
        return jnp.clip(scale + step, 0.0, _LARGEST_SCALE), follows

    frozen = lax.stop_gradient((wanted, available, total))

    def unsettled(state: tuple[Array, Array, Array]) -> Array:
        before, scale, steps = state
        return (scale != before) & (steps < _MOST_STEPS)

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        _, scale, steps = state
        return scale, newton(scale, *frozen)[0], steps + 1

    one = jnp.ones_like(frozen[2])
    _, scale, _ = lax.while_loop(unsettled, step, (0.0 * one, one, jnp.zeros((), jnp.int32)))
    scale, follows = newton(scale, wanted, available, total)
    return jnp.minimum(jnp.where(follows, scale * wanted, available), available)


# Ground that rises more steeply than this stands: no soil lies so [1]. 60 degrees.
_STANDS = math.tan(math.radians(60.0))
_MOST_STEPS = 4
# Most that a gain is scaled by: by more, soil would pile up at the edge of a map.
_LARGEST_GAIN = 2.0
# Where nothing is left to take, the scale would grow without bound.
_LARGEST_SCALE = 1e3
