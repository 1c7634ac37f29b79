"""The line around the largest pile of a map under a trace: `outlines` for `jit` and `vmap`.

Level lines are chains of crossings of grid edges. Each crossing has one that follows it, so a chain
is put in order by pointer jumping (Wyllie 1979): after k rounds each crossing knows the one 2^k
further on and the way there. Everything has a fixed size; what is beyond it is cut off.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

# Most crossings that are followed: 400 m of lines on cells of 0.1 m, noise included.
_CROSSINGS = 4096


class Line(NamedTuple):
    """A line in order, the pile on its left; its last point is repeated to a fixed size.

    One that is closed ends where it begins.
    """

    points: Float[Array, "n 2"]  # in cells
    length: Float[Array, ""]  # in cells
    closed: Bool[Array, ""]
    exists: Bool[Array, ""]


def labels_of(flags: Bool[Array, "nx ny"]) -> Int[Array, "nx ny"]:
    """A number for each cell, the same for all that hang together by sides; -1 where no flag is."""
    nx, ny = flags.shape
    count = nx * ny
    own = jnp.where(flags, jnp.arange(count, dtype=jnp.int32).reshape(nx, ny), count)

    def spread(state: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = state
        padded = jnp.pad(labels, 1, constant_values=count)
        near = [padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2]]
        least = jnp.where(flags, jnp.minimum(labels, jnp.stack(near).min(axis=0)), count)
        # What a label's own cell has become goes for all that have it.
        for _ in range(2):
            known = jnp.append(least.reshape(-1), count)
            least = jnp.minimum(least, known[least])
        return least, (least != labels).any()

    labels, _ = lax.while_loop(lambda state: state[1], spread, (own, jnp.array(True)))
    return jnp.where(flags, labels, -1)


def outline_of_largest(above: Float[Array, "nx ny"], *, rise: float) -> Line:
    """The longest line around the largest pile by volume, its hollows left out.

    Args:
        above: Height of the surface above the ground [m].
        rise: Height above the ground that counts as pile [m].
    """
    nx, ny = above.shape
    higher = above > rise
    labels = labels_of(higher)
    volumes = (
        jnp.zeros(nx * ny, above.dtype)
        .at[labels.reshape(-1)]
        .add(jnp.where(higher, above, 0.0).reshape(-1), mode="drop")
    )
    largest = higher & (labels == volumes.argmax())
    alone = jnp.where(largest, above, jnp.minimum(above, rise - 1e-6))
    crossings = _crossings(alone, largest, rise)
    return _longest(crossings, above.dtype)


class _Crossings(NamedTuple):
    """Where level lines cross the edges of the grid."""

    place: Float[Array, "n 2"]  # in cells
    after: Int[Array, " n"]  # row of the next one; its own where a line ends
    exists: Bool[Array, " n"]


def _crossings(alone: Array, high: Array, rise: float) -> _Crossings:
    """The crossings of a level, in rows of a fixed number."""
    nx, ny = alone.shape
    # Edges along x, from [i, j] to [i + 1, j], and then those along y.
    split, total = (nx - 1) * ny, (nx - 1) * ny + nx * (ny - 1)
    across, up = high[:-1] != high[1:], high[:, :-1] != high[:, 1:]
    crossed = jnp.concatenate([across.reshape(-1), up.reshape(-1)])
    (edges,) = jnp.nonzero(crossed, size=_CROSSINGS, fill_value=total)
    exists = edges < total
    along_x = edges < split
    inner = jnp.where(along_x, edges, edges - split)
    i, j = (
        jnp.where(along_x, inner // ny, inner // (ny - 1)),
        jnp.where(along_x, inner % ny, inner % (ny - 1)),
    )
    i, j = jnp.where(exists, i, 0), jnp.where(exists, j, 0)
    one = alone[i, j]
    other = alone[jnp.minimum(i + along_x, nx - 1), jnp.minimum(j + ~along_x, ny - 1)]
    part = jnp.clip((rise - one) / jnp.where(other == one, 1.0, other - one), 0.0, 1.0)
    place = jnp.stack([i + jnp.where(along_x, part, 0.0), j + jnp.where(along_x, 0.0, part)], -1)
    after = _successor(alone, high, rise, (i, j, along_x), split)
    # By rows, as edges are in order.
    row = jnp.searchsorted(edges, after).astype(jnp.int32)
    found = (after >= 0) & (row < _CROSSINGS) & (edges[jnp.minimum(row, _CROSSINGS - 1)] == after)
    own = jnp.arange(_CROSSINGS, dtype=jnp.int32)
    return _Crossings(place.astype(alone.dtype), jnp.where(found & exists, row, own), exists)


def _successor(
    alone: Array, high: Array, rise: float, edge: tuple[Array, Array, Array], split: int
) -> Array:
    """The edge by which a line leaves the square that it enters by an edge; -1 off the map.

    A line has what is high on its left, so it enters a square where, counter-clockwise around it,
    high is followed by low, and leaves it where low is followed by high.
    """
    nx, ny = alone.shape
    i, j, along_x = edge
    first_high = high[i, j]
    # The square above an edge along x runs over it from [i, j], the one below back to it; that to
    # the right of an edge along y runs back to [i, j], the one to the left from it.
    x0 = jnp.where(along_x, i, jnp.where(first_high, i - 1, i))
    y0 = jnp.where(along_x, jnp.where(first_high, j, j - 1), j)
    inside = (x0 >= 0) & (y0 >= 0) & (x0 < nx - 1) & (y0 < ny - 1)
    x0, y0 = jnp.clip(x0, 0, nx - 2), jnp.clip(y0, 0, ny - 2)
    corners = [(x0, y0), (x0 + 1, y0), (x0 + 1, y0 + 1), (x0, y0 + 1)]
    is_high = jnp.stack([high[at] for at in corners])
    leaves = ~is_high & jnp.roll(is_high, -1, axis=0)
    entered = jnp.where(along_x, jnp.where(first_high, 0, 2), jnp.where(first_high, 1, 3))
    # Where a line may go two ways, corners that are high hang together if the middle is high.
    middle = sum(alone[at] for at in corners) / 4.0 > rise
    turn = jnp.where(middle, 1, 3)
    both = leaves.sum(axis=0) == 2
    left = jnp.where(both, (entered + turn) % 4, leaves.argmax(axis=0))
    numbers = jnp.stack(
        [
            x0 * ny + y0,
            split + (x0 + 1) * (ny - 1) + y0,
            x0 * ny + y0 + 1,
            split + x0 * (ny - 1) + y0,
        ]
    )
    out = jnp.take_along_axis(numbers, left[None], axis=0)[0]
    return jnp.where(inside, out, -1)


def _longest(crossings: _Crossings, dtype: np.dtype) -> Line:
    """The longest of the lines in order; one that runs around a hollow is none."""
    place, after, exists = crossings
    count = len(after)
    own = jnp.arange(count, dtype=jnp.int32)
    rounds = math.ceil(math.log2(count))

    def meet(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        far, least = state
        return far[far], jnp.minimum(least, least[far])

    end, least = lax.fori_loop(0, rounds, meet, (after, own))
    closed = after[end] != end
    # A closed line is opened before its first row; what closes it is kept.
    first = closed & (own == least)
    opened = jnp.where(closed & (after == least), own, after)
    step = jnp.where(opened == own, 0.0, jnp.hypot(*(place[opened] - place).T))

    def measure(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        far, way = state
        return far[far], way + jnp.where(far == own, 0.0, way[far])

    last, ahead = lax.fori_loop(0, rounds, measure, (opened, step.astype(dtype)))
    closing = jnp.where(closed, jnp.hypot(*(place[least] - place[last]).T), 0.0)
    lengths = jnp.where(exists, ahead + closing, -1.0)
    x, y = place.T
    swept = x * y[after] - x[after] * y
    areas = jnp.zeros(count, dtype).at[last].add(jnp.where(exists, swept, 0.0))[last]
    starts = exists & jnp.where(closed, first & (areas > 0.0), True)
    best = jnp.where(starts, lengths, -1.0).argmax()
    mine = exists & (last == last[best])
    order = jnp.argsort(jnp.where(mine, -ahead, jnp.inf))
    number = mine.sum()
    rows = order[jnp.minimum(own, jnp.maximum(number - 1, 0))]
    # One point more: where a closed line closes.
    points = jnp.concatenate([place[rows], place[rows[-1:]]])
    back = closed[best] & (jnp.arange(count + 1) >= number)
    points = jnp.where(back[:, None], place[rows[0]], points)
    return Line(points, lengths[best], closed[best], starts.any())
