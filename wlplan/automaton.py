"""The avalanche automaton: soil slides downhill until no slope exceeds the angle of repose.

One sweep moves, along every edge between neighbouring cells i and k at distance d, the height
f * max(h_i - h_k - d tan(repose), 0) from the higher to the lower cell (eight neighbours). The
flow is antisymmetric, so volume is kept by construction; with f = 1/8 the Jacobian of a sweep is
symmetric, has unit row sums and is non-expansive, so its gradient cannot explode. This is our
reading of the mass-preserving automaton of Pla-Castells et al. (2004), which the paper employs
(section 4.6), with eight neighbours in place of four.

Sweeps alone converge slowly over long distances, so `settle` runs them coarse to fine: heights are
averaged onto a grid of twice the spacing, relaxed there, and the change is interpolated back. A
relaxed surface is relaxed on every level, so `settle` does not move it.

Gradients: reverse mode with respect to the height, by a rule of our own that stores one height a
sweep; forward mode is not available, and the floor and the repose angle count as constants.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.machine import GRAVEL
from wlplan.types import Pile, Pose

# Part of the excess height that an edge moves in one sweep; 1 / (number of neighbours) is the
# largest value at which a sweep is non-expansive.
FLOW_FRACTION = 0.125

_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How hard `settle` works: `cycles` passes of `sweeps[k]` sweeps at spacing 2^k."""

    cycles: int = 3
    sweeps: tuple[int, ...] = (16, 24, 48, 48)

    @property
    def block(self) -> int:
        """Cells that a side of the grid must be a multiple of."""
        return int(2 ** (len(self.sweeps) - 1))


DEFAULT_SCHEDULE = Schedule()


class Terrain(NamedTuple):
    """What limits the flow: the floor [m] (None: level 0) and the cells that take part (None: all).

    A cell whose floor is itself steeper than the angle of repose (a kerb, a wall) must not take
    part; among the others nothing then slides below the floor, see `terrain_of`.
    """

    ground: Float[Array, "nx ny"] | None = None
    active: Bool[Array, "nx ny"] | None = None


OPEN_TERRAIN = Terrain()
"""A level floor at 0, and every cell takes part."""


def _neighbour(field: Array, i: int, j: int) -> Array:
    """The value of the neighbour at offset (i, j) of every cell; mirrored at the border."""
    for axis, step in ((0, i), (1, j)):
        n = field.shape[axis]
        if step == 1:
            parts = [
                lax.slice_in_dim(field, 1, n, axis=axis),
                lax.slice_in_dim(field, n - 1, n, axis=axis),
            ]
        elif step == -1:
            parts = [
                lax.slice_in_dim(field, 0, 1, axis=axis),
                lax.slice_in_dim(field, 0, n - 1, axis=axis),
            ]
        else:
            continue
        field = lax.concatenate(parts, axis)
    return field


def sweep(
    height: Float[Array, "nx ny"],
    drop: float,
    active: Bool[Array, "nx ny"] | None = None,
    *,
    largest: float | None = None,
    giving: Float[Array, "nx ny"] | None = None,
) -> Float[Array, "nx ny"]:
    """One sweep of the automaton.

    Args:
        height: Surface [m].
        drop: Largest stable height difference between two cells that share a side [m].
        active: Cells that take part; None: all.
        largest: Largest excess height that counts [m]; bounds the flow where a sweep stands for
            a span of time; None: no bound.
        giving: Part of its outflow that each cell lets go; None: all.
    """
    outflow = jnp.zeros_like(height)
    for i, j in _NEIGHBOURS:
        limit = drop * math.hypot(i, j)
        difference = height - _neighbour(height, i, j)
        flow = difference - jnp.clip(difference, -limit, limit)
        if largest is not None:
            flow = jnp.clip(flow, -largest, largest)
        if giving is not None:
            flow = flow * jnp.where(flow > 0.0, giving, _neighbour(giving, i, j))
        if active is not None:
            flow = jnp.where(active & _neighbour(active, i, j), flow, 0.0)
        outflow = outflow + flow
    return height - FLOW_FRACTION * outflow


def _sweep_jacobian(
    vector: Float[Array, "nx ny"],
    height: Float[Array, "nx ny"],
    drop: float,
    active: Bool[Array, "nx ny"] | None,
) -> Float[Array, "nx ny"]:
    """The Jacobian of `sweep` at `height`, which is symmetric, applied to a vector."""
    outflow = jnp.zeros_like(vector)
    for i, j in _NEIGHBOURS:
        limit = drop * math.hypot(i, j)
        slides = jnp.abs(height - _neighbour(height, i, j)) > limit
        if active is not None:
            slides = slides & active & _neighbour(active, i, j)
        outflow = outflow + jnp.where(slides, vector - _neighbour(vector, i, j), 0.0)
    return vector - FLOW_FRACTION * outflow


@partial(jax.custom_vjp, nondiff_argnums=(1, 3))
def sweeps(
    height: Float[Array, "nx ny"],
    drop: float,
    active: Bool[Array, "nx ny"] | None,
    count: int,
) -> Float[Array, "nx ny"]:
    """`count` sweeps in a row: the automaton as the paper has it. Arguments as for `sweep`."""
    return lax.fori_loop(0, count, lambda _, h: sweep(h, drop, active), height)


def _sweeps_forward(height: Array, drop: float, active: Array | None, count: int):
    def step(h: Array, _: None):
        return sweep(h, drop, active), h

    height, history = lax.scan(step, height, None, length=count)
    return height, (history, active)


def _sweeps_backward(drop: float, count: int, residuals, cotangent: Array):
    history, active = residuals

    def step(c: Array, h: Array):
        return _sweep_jacobian(c, h, drop, active), None

    cotangent, _ = lax.scan(step, cotangent, history, reverse=True)
    return cotangent, None


sweeps.defvjp(_sweeps_forward, _sweeps_backward)


def _coarsen(field: Array) -> Array:
    n, m = field.shape
    return field.reshape(n // 2, 2, m // 2, 2).mean((1, 3))


def _refine(field: Array) -> Array:
    """Bilinear interpolation to half the spacing, cell-centred; keeps the volume exactly."""
    for axis in (0, 1):
        step = (1, 0) if axis == 0 else (0, 1)
        low = 0.75 * field + 0.25 * _neighbour(field, -step[0], -step[1])
        high = 0.75 * field + 0.25 * _neighbour(field, *step)
        shape = list(field.shape)
        shape[axis] *= 2
        field = jnp.stack([low, high], axis=axis + 1).reshape(shape)
    return field


def _add_change(height: Array, change: Array, terrain: Terrain) -> Array:
    """Adds a change of zero net volume, without digging under the floor or moving unseen cells."""
    ground, active = terrain
    floor = jnp.zeros_like(height) if ground is None else ground
    loss = jnp.minimum(jnp.maximum(-change, 0.0), jnp.maximum(height - floor, 0.0))
    gain = jnp.maximum(change, 0.0)
    if active is not None:
        loss, gain = jnp.where(active, loss, 0.0), jnp.where(active, gain, 0.0)
    lost, gained = loss.sum(), gain.sum()
    # What may not be taken here is not delivered there. The inner where keeps the gradient of
    # the quotient finite when nothing moves.
    moves = (gained > 0.0) & (lost > 0.0)
    scale = jnp.where(moves, lost / jnp.where(moves, gained, 1.0), 0.0)
    return height - jnp.where(moves, loss, 0.0) + scale * gain


def _cycle(height: Array, drop: float, terrain: Terrain, counts: tuple[int, ...]) -> Array:
    if len(counts) > 1:
        ground, active = terrain
        coarse = _coarsen(height)
        coarse_terrain = Terrain(
            None if ground is None else _coarsen(ground),
            # A coarse cell takes part when all of its cells do.
            None if active is None else _coarsen(active.astype(height.dtype)) == 1.0,
        )
        relaxed = _cycle(coarse, 2.0 * drop, coarse_terrain, counts[1:])
        height = _add_change(height, _refine(relaxed - coarse), terrain)
    return sweeps(height, drop, terrain.active, counts[0])


def settle(
    height: Float[Array, "nx ny"],
    *,
    cell_size: float,
    repose_angle: float,
    terrain: Terrain = OPEN_TERRAIN,
    schedule: Schedule = DEFAULT_SCHEDULE,
) -> Float[Array, "nx ny"]:
    """Relaxes a disturbed surface, coarse to fine, with a fixed amount of work.

    Args:
        height: Surface [m]; both sides a multiple of `schedule.block` cells.
        cell_size: Grid spacing [m].
        repose_angle: Angle of repose [rad].
        terrain: Floor and mask; the default floor is level 0, which needs no limit.
        schedule: Number of cycles and sweeps.

    Returns:
        A surface of the same volume. How far it is from the angle of repose, `steepest_slope`
        tells; after a bucket load the default schedule leaves it within about 2 degrees.

    Raises:
        ValueError: If a side is not a multiple of `schedule.block`.
    """
    if any(n % schedule.block for n in height.shape):
        raise ValueError(
            f"The grid of {height.shape[0]} x {height.shape[1]} cells must be a multiple of "
            f"{schedule.block} cells a side. Pad it, or use fewer levels in the schedule."
        )
    drop = cell_size * math.tan(repose_angle)

    # A scan, so that the cycles share one compiled body.
    def cycle(h: Array, _: None) -> tuple[Array, None]:
        return _cycle(h, drop, terrain, schedule.sweeps), None

    return lax.scan(cycle, height, None, length=schedule.cycles)[0]


def steepest_slope(pile: Pile) -> Float[Array, ""]:
    """Steepest slope between any two neighbouring cells that were seen [rad]."""
    steepest = jnp.zeros((), pile.height.dtype)
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        rise = jnp.abs(pile.height - _neighbour(pile.height, i, j)) / math.hypot(i, j)
        if pile.valid is not None:
            rise = jnp.where(pile.valid & _neighbour(pile.valid, i, j), rise, 0.0)
        # The mirrored border repeats a straight difference at a diagonal distance: no maximum.
        steepest = jnp.maximum(steepest, rise.max())
    return jnp.arctan(steepest / pile.cell_size)


# `relax` gives up after this many passes; a tall cliff across a 20 m grid needs about half.
_MAX_PASSES = 60


def relax(
    pile: Pile,
    *,
    repose_angle: float = GRAVEL.repose_angle,
    tolerance: float = math.radians(1.0),
) -> Pile:
    """Lets a pile slide until no slope exceeds the angle of repose; keeps its volume.

    Slopes of the floor itself, where no soil lies on it, are not changed, nor are unseen cells.

    Args:
        pile: Any pile.
        repose_angle: Angle of repose [rad].
        tolerance: How much steeper than `repose_angle` the result may be [rad].

    Returns:
        The relaxed pile. Differentiable in `pile.height` by reverse mode.
    """
    limit = math.tan(repose_angle + tolerance)
    once = Schedule(cycles=1, sweeps=DEFAULT_SCHEDULE.sweeps)
    movable = pile.replace(valid=terrain_of(pile, repose_angle).active)

    @jax.checkpoint
    def work(height: Array) -> Array:
        return settle_window(pile.replace(height=height), repose_angle=repose_angle, schedule=once)

    def one_pass(height: Array, _: None) -> tuple[Array, None]:
        steep = jnp.tan(steepest_slope(movable.replace(height=height))) > limit
        return lax.cond(steep, work, lambda h: h, height), None

    height, _ = lax.scan(one_pass, pile.height, None, length=_MAX_PASSES)
    return pile.replace(height=height)


def terrain_of(pile: Pile, repose_angle: float) -> Terrain:
    """The floor of a pile, and the cells that were seen and whose floor is not too steep."""
    if pile.ground is None:
        return Terrain(None, pile.valid)
    drop = pile.cell_size * math.tan(repose_angle)
    active = jnp.ones(pile.height.shape, bool) if pile.valid is None else pile.valid
    for i, j in _NEIGHBOURS:
        step = jnp.abs(pile.ground - _neighbour(pile.ground, i, j))
        active = active & (step <= drop * math.hypot(i, j))
    return Terrain(pile.ground, active)


def pad_pile(pile: Pile, shape: tuple[int, int]) -> Pile:
    """Extends a pile to `shape` with cells that take no part; unchanged if it has that shape."""
    nx, ny = pile.height.shape
    if (nx, ny) == shape:
        return pile
    widths = ((0, shape[0] - nx), (0, shape[1] - ny))
    valid = jnp.ones((nx, ny), bool) if pile.valid is None else pile.valid
    return pile.replace(
        height=jnp.pad(pile.height, widths),
        ground=None if pile.ground is None else jnp.pad(pile.ground, widths),
        valid=jnp.pad(valid, widths),
    )


# Side of the window that a loading disturbs [cells], and how far its centre lies ahead of the
# dig location along the heading [m]: the bucket reaches 3.2 m in, avalanches run up from there.
WINDOW = 96
_WINDOW_AHEAD = 2.0


def window_of(pile: Pile, pose: Pose) -> tuple[Pile, tuple[Array, Array]]:
    """The part of the grid around a dig pose that a loading disturbs, and its first cell.

    The window lies inside the grid. A grid that is smaller is returned whole.
    """
    centre = (
        (pose.x + _WINDOW_AHEAD * jnp.cos(pose.heading) - pile.origin[0]) / pile.cell_size,
        (pose.y + _WINDOW_AHEAD * jnp.sin(pose.heading) - pile.origin[1]) / pile.cell_size,
    )
    sizes = tuple(min(WINDOW, n) for n in pile.height.shape)
    start = tuple(
        jnp.clip(jnp.round(lax.stop_gradient(position)).astype(jnp.int32) - size // 2, 0, n - size)
        for position, size, n in zip(centre, sizes, pile.height.shape, strict=True)
    )

    def cut(field: Array | None) -> Array | None:
        return None if field is None else lax.dynamic_slice(field, start, sizes)

    corner = jnp.stack([s.astype(pile.height.dtype) for s in start])
    window = pile.replace(
        height=cut(pile.height),
        ground=cut(pile.ground),
        valid=cut(pile.valid),
        origin=jnp.asarray(pile.origin) + pile.cell_size * corner,
    )
    return window, (start[0], start[1])


def settle_window(
    window: Pile, *, repose_angle: float, schedule: Schedule = DEFAULT_SCHEDULE
) -> Float[Array, "nx ny"]:
    """The heights of a disturbed pile or window after `settle`, whatever its size [m]."""
    nx, ny = window.height.shape
    padded = pad_pile(window, (nx + -nx % schedule.block, ny + -ny % schedule.block))
    height = settle(
        padded.height,
        cell_size=window.cell_size,
        repose_angle=repose_angle,
        terrain=terrain_of(padded, repose_angle),
        schedule=schedule,
    )
    return height[:nx, :ny]
