"""The avalanche automaton: soil slides downhill until no slope exceeds the angle of repose.

One sweep moves, along every edge between neighbouring cells i and k at distance d, the height
f * max(h_i - h_k - d tan(repose), 0) from the higher to the lower cell (eight neighbours). The
flow is antisymmetric, so volume is kept by construction; with f = 1/8 the Jacobian of a sweep is
symmetric, not negative and has unit row sums, so a sweep is monotone, non-expansive in every
p-norm, and its gradient cannot explode. This is our reading of the mass-preserving automaton of
Pla-Castells et al. (2004), which the paper employs (section 4.6), with eight neighbours in place
of four. `sweeps` and `converged` are this automaton as it stands.

Sweeps alone take thousands to bring a bucket's hole to rest. `settle` gets there in dozens:

- Coarse to fine. Heights are averaged onto grids of twice and four times the spacing, relaxed
  there first, and the change is interpolated back with its volume kept. A surface that is relaxed
  is relaxed on every level, so `settle` does not move it.
- Momentum. A sweep is a step of gradient descent on the energy sum max(excess, 0)^2 / 2, and the
  heavy-ball method speeds that up. It starts anew as soon as its velocity points uphill, which
  keeps it from overshooting.
- Rounds of both are repeated until the steepest slope is within a tolerance, and no more.

Gradients: reverse mode with respect to the height, exact for the sweeps that were made, by rules
of our own. Forward mode is not available (JAX says so), and the floor and the angle of repose
count as constants.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, UInt8

from wlplan.machine import GRAVEL
from wlplan.types import Pile, Pose

# Part of the excess height that an edge moves in one sweep; 1 / (number of neighbours) is the
# largest value at which a sweep is non-expansive.
FLOW_FRACTION = 0.125

# Bit k of a cell's links stands for neighbour k.
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))
_BITS = tuple(np.uint8(1 << k) for k in range(len(_NEIGHBOURS)))


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How `settle` works: rounds of `sweeps[k]` sweeps at spacing 2^k, coarse to fine.

    The defaults are the quickest that were found for bucket loads, see docs/automaton.md.
    """

    sweeps: tuple[int, ...] = (6, 8, 10)
    # Part of the velocity that is kept from sweep to sweep.
    momentum: float = 0.9
    # How much steeper than the angle of repose the result may be [rad].
    tolerance: float = math.radians(1.0)
    # It gives up after this many rounds. Bucket loads take about four; 67 were seen on a slope
    # longer than the window.
    most_rounds: int = 100

    @property
    def block(self) -> int:
        """Cells that a side of the grid must be a multiple of."""
        return int(2 ** (len(self.sweeps) - 1))


DEFAULT_SCHEDULE = Schedule()


class _Terrain(NamedTuple):
    """What limits the flow: the floor [m] (None: level 0) and the cells that take part (None: all).

    A cell whose floor is itself steeper than the angle of repose (a kerb, a wall) must not take
    part; among the others nothing then slides below the floor.
    """

    ground: Array | None
    active: Array | None


# --- one sweep


def _rim(field: Array) -> Array:
    """The field with its border mirrored, one cell all around."""
    return jnp.pad(field, 1, mode="edge")


def _around(rimmed: Array, i: int, j: int) -> Array:
    """The value of the neighbour at offset (i, j) of every cell inside the rim."""
    n, m = rimmed.shape
    return lax.slice(rimmed, (1 + i, 1 + j), (n - 1 + i, m - 1 + j))


def sweep(
    height: Float[Array, "nx ny"],
    drop: float,
    active: Bool[Array, "nx ny"] | None = None,
) -> Float[Array, "nx ny"]:
    """One sweep of the automaton.

    Args:
        height: Surface [m].
        drop: Largest stable height difference between two cells that share a side [m].
        active: Cells that take part; None: all.
    """
    links = None if active is None else _links(active)
    return height - FLOW_FRACTION * _outflow(_rim(height), drop, links)


def _excess(height: Array, neighbour: Array, limit: float) -> Array:
    """How much of a height difference is more than is stable, with its sign."""
    difference = height - neighbour
    return difference - jnp.clip(difference, -limit, limit)


def _links(active: Array) -> UInt8[Array, "nx ny"]:
    """Which neighbours each cell can exchange soil with, as bits: both have to take part."""
    around = _rim(active)
    packed = jnp.zeros(active.shape, jnp.uint8)
    for (i, j), bit in zip(_NEIGHBOURS, _BITS, strict=True):
        packed = packed | jnp.where(active & _around(around, i, j), bit, np.uint8(0))
    return packed


def _outflow(rimmed: Array, drop: float, links: Array | None) -> Array:
    """Excess height towards all neighbours together; input with a rim, output without."""
    height = _around(rimmed, 0, 0)
    total = jnp.zeros_like(height)
    for (i, j), bit in zip(_NEIGHBOURS, _BITS, strict=True):
        flow = _excess(height, _around(rimmed, i, j), drop * math.hypot(i, j))
        total = total + (flow if links is None else jnp.where(links & bit != 0, flow, 0.0))
    return total


def _spread(vector: Array, rimmed: Array, drop: float, links: Array | None) -> Array:
    """The Jacobian of `_outflow` at a surface, which is symmetric, applied to a vector.

    Both inputs with a rim, the output without.
    """
    height, centre = _around(rimmed, 0, 0), _around(vector, 0, 0)
    total = jnp.zeros_like(centre)
    for (i, j), bit in zip(_NEIGHBOURS, _BITS, strict=True):
        slides = jnp.abs(height - _around(rimmed, i, j)) > drop * math.hypot(i, j)
        if links is not None:
            slides = slides & (links & bit != 0)
        total = total + jnp.where(slides, centre - _around(vector, i, j), 0.0)
    return total


# --- many sweeps


# Surfaces that reverse mode keeps at once.
_KEPT = 64


def sweeps(
    height: Float[Array, "nx ny"],
    drop: float,
    active: Bool[Array, "nx ny"] | None,
    count: int,
) -> Float[Array, "nx ny"]:
    """`count` sweeps in a row: the automaton as the paper has it. Arguments as for `sweep`.

    Reverse mode keeps at most 128 surfaces up to a count of 4,096, and 64 more with every further
    factor of 64; the sweeps in between it makes again.
    """
    return _many_sweeps(height, None if active is None else _links(active), drop, count)


def _many_sweeps(height: Array, links: Array | None, drop: float, count: int) -> Array:
    if count <= _KEPT:
        return _slide(height, links, drop, 0.0, count)
    part = 1
    while part * _KEPT < count:
        part *= _KEPT

    @jax.checkpoint
    def block(h: Array, _: None) -> tuple[Array, None]:
        return _many_sweeps(h, links, drop, part), None

    blocks, rest = divmod(count, part)
    height, _ = lax.scan(block, height, None, length=blocks)
    return _many_sweeps(height, links, drop, rest) if rest else height


@partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def _slide(
    height: Float[Array, "nx ny"],
    links: UInt8[Array, "nx ny"] | None,
    drop: float,
    momentum: float,
    count: int,
) -> Float[Array, "nx ny"]:
    """`count` sweeps from standstill, each as far as the last and further: the heavy-ball method.

    The velocity is dropped when it points uphill, against what the sweep itself would do.
    """

    def step(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        rimmed, velocity = state
        flow = -FLOW_FRACTION * _outflow(rimmed, drop, links)
        velocity = _kept_part(momentum, flow, velocity) * velocity + flow
        return _rim(_around(rimmed, 0, 0) + velocity), velocity

    def plain(_: Array, rimmed: Array) -> Array:
        return _rim(_around(rimmed, 0, 0) - FLOW_FRACTION * _outflow(rimmed, drop, links))

    if momentum == 0.0:
        return _around(lax.fori_loop(0, count, plain, _rim(height)), 0, 0)
    rimmed, _ = lax.fori_loop(0, count, step, (_rim(height), jnp.zeros_like(height)))
    return _around(rimmed, 0, 0)


def _kept_part(momentum: float, flow: Array, velocity: Array) -> Array:
    uphill = jnp.vdot(flow, velocity) < 0.0
    return jnp.where(uphill, jnp.zeros((), flow.dtype), jnp.asarray(momentum, flow.dtype))


def _slide_forward(height: Array, links: Array | None, drop: float, momentum: float, count: int):
    def step(state: tuple[Array, Array], _: None):
        rimmed, velocity = state
        flow = -FLOW_FRACTION * _outflow(rimmed, drop, links)
        kept = _kept_part(momentum, flow, velocity)
        velocity = kept * velocity + flow
        return (_rim(_around(rimmed, 0, 0) + velocity), velocity), (rimmed, kept)

    start = (_rim(height), jnp.zeros_like(height))
    (rimmed, _), record = lax.scan(step, start, None, length=count)
    return _around(rimmed, 0, 0), (*record, links)


def _slide_backward(drop: float, momentum: float, count: int, record, cotangent: Array):
    surfaces, kept, links = record

    # `both` is the cotangent of a sweep's velocity: that of the next velocity and of the surface.
    # Carried with its rim, as the flow is: XLA makes far slower code of the other ways tried.
    def step(state: tuple[Array, Array], recorded: tuple[Array, Array]):
        height, both = state
        surface, kept = recorded
        height = height - FLOW_FRACTION * _rim(_spread(both, surface, drop, links))
        return (height, kept * both + height), None

    start = (_rim(cotangent), _rim(cotangent))
    (height, _), _ = lax.scan(step, start, (surfaces, kept), reverse=True)
    return _around(height, 0, 0), None


_slide.defvjp(_slide_forward, _slide_backward)


def converged(
    pile: Pile,
    *,
    repose_angle: float = GRAVEL.repose_angle,
    tolerance: float = math.radians(0.01),
    most_sweeps: int = 100_000,
) -> Pile:
    """The paper's automaton, sweep after sweep until it rests: the slow reference of `relax`.

    Args:
        pile: Any pile.
        repose_angle: Angle of repose [rad].
        tolerance: How much steeper than `repose_angle` the result may be [rad].
        most_sweeps: It gives up after this many.

    Returns:
        The relaxed pile. Not differentiable.
    """
    active = movable(pile, repose_angle)
    limit = pile.cell_size * math.tan(repose_angle + tolerance)
    drop = pile.cell_size * math.tan(repose_angle)
    every = 100

    def steep(state: tuple[Array, Array]) -> Array:
        height, count = state
        return (count < most_sweeps) & _steeper_than(limit, height, active)

    def more(state: tuple[Array, Array]) -> tuple[Array, Array]:
        height, count = state
        return sweeps(height, drop, active, every), count + every

    height, _ = lax.while_loop(steep, more, (pile.height, jnp.zeros((), jnp.int32)))
    return pile.replace(height=height)


# --- coarse to fine


def _coarsen(field: Array) -> Array:
    # Strided slices: XLA's reduction over the same cells takes five times as long on a CPU.
    rows = field[::2] + field[1::2]
    return 0.25 * (rows[:, ::2] + rows[:, 1::2])


def _refine(field: Array) -> Array:
    """Bilinear interpolation to half the spacing, cell-centred; keeps the volume exactly."""
    for axis in (0, 1):
        widths = [(1, 1) if k == axis else (0, 0) for k in (0, 1)]
        around = jnp.pad(field, widths, mode="edge")
        n = field.shape[axis]
        low = 0.75 * field + 0.25 * lax.slice_in_dim(around, 0, n, axis=axis)
        high = 0.75 * field + 0.25 * lax.slice_in_dim(around, 2, n + 2, axis=axis)
        shape = list(field.shape)
        shape[axis] *= 2
        field = jnp.stack([low, high], axis=axis + 1).reshape(shape)
    return field


def _add_change(height: Array, change: Array, terrain: _Terrain) -> Array:
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


def _round(height: Array, terrain: _Terrain, drop: float, schedule: Schedule, level: int) -> Array:
    """Coarser levels first, then the sweeps of this one."""
    ground, active = terrain
    if level + 1 < len(schedule.sweeps):
        coarse = _coarsen(height)
        coarse_terrain = _Terrain(
            None if ground is None else _coarsen(ground),
            # A coarse cell takes part when all of its cells do.
            None if active is None else _coarsen(active.astype(height.dtype)) == 1.0,
        )
        relaxed = _round(coarse, coarse_terrain, 2.0 * drop, schedule, level + 1)
        height = _add_change(height, _refine(relaxed - coarse), terrain)
    links = None if active is None else _links(active)
    slid = _slide(height, links, drop, schedule.momentum, schedule.sweeps[level])
    # A sweep stops at the floor; its momentum might not.
    return _add_change(height, slid - height, terrain) if schedule.momentum else slid


def settle(
    pile: Pile,
    *,
    repose_angle: float = GRAVEL.repose_angle,
    schedule: Schedule = DEFAULT_SCHEDULE,
) -> Pile:
    """Relaxes a disturbed pile until it is within the schedule's tolerance.

    Slopes of the floor itself, where no soil lies on it, are not changed, nor are unseen cells.

    Args:
        pile: Any pile.
        repose_angle: Angle of repose [rad].
        schedule: Sweeps, tolerance, and when to give up.

    Returns:
        A pile of the same volume; the same pile if it was within the tolerance. Differentiable in
        `pile.height` by reverse mode, whose memory is one surface a round and what a single round
        leaves. Under `vmap` every member makes its own number of rounds on the CPU, one after the
        other; on other devices all make as many as the slowest.
    """
    return _settled(pile, pile.height, jnp.zeros(2, jnp.int32), repose_angle, schedule)


def settle_dug(
    pile: Pile,
    dug: Float[Array, "n m"],
    start: tuple[Array, Array],
    *,
    repose_angle: float = GRAVEL.repose_angle,
    schedule: Schedule = DEFAULT_SCHEDULE,
) -> Pile:
    """Writes a window that was dug in back into its pile and lets the pile slide.

    The window is settled alone, its sides being walls. Where that leaves the pile too steep
    across one of them, and steeper than it was, the avalanche goes on in another window there,
    and so on. So a pile that was within the tolerance before is so afterwards.

    Args:
        pile: The pile before.
        dug: Heights of the window after digging, see `window_of` [m].
        start: First cell of the window.
        repose_angle: Angle of repose [rad].
        schedule: Sweeps, tolerance, and when to give up.

    Returns:
        The pile afterwards, see `settle`.
    """
    return _settled(pile, dug, jnp.stack(start), repose_angle, schedule)


def relax(
    pile: Pile,
    *,
    repose_angle: float = GRAVEL.repose_angle,
    tolerance: float = math.radians(1.0),
) -> Pile:
    """Lets a pile slide until no slope exceeds the angle of repose; keeps its volume.

    Args:
        pile: Any pile.
        repose_angle: Angle of repose [rad].
        tolerance: How much steeper than `repose_angle` the result may be [rad].

    Returns:
        The relaxed pile, see `settle`, which this is with more patience.
    """
    schedule = dataclasses.replace(DEFAULT_SCHEDULE, tolerance=tolerance, most_rounds=_MOST_ROUNDS)
    return settle(pile, repose_angle=repose_angle, schedule=schedule)


# `relax` gives up after this many rounds; a tall cliff across a 20 m grid needs about half.
_MOST_ROUNDS = 200


def _settled(pile: Pile, dug: Array, start: Array, repose_angle: float, schedule: Schedule) -> Pile:
    one_by_one = jax.default_backend() == "cpu"
    solve = _solver(pile.cell_size, repose_angle, schedule, one_by_one)
    return pile.replace(height=solve(pile.height, dug, pile.ground, pile.valid, start))


@functools.cache
def _solver(
    cell_size: float, repose_angle: float, schedule: Schedule, one_by_one: bool
) -> Callable[[Array, Array, Array | None, Array | None, Array], Array]:
    """Relaxation of (before, dug, ground, valid, start), with its reverse rule, for one setting.

    `dug` is a window that begins at `start`, or all of the grid. The rule keeps the surface before
    and nothing else, and makes the rounds again: so where a rollout is rematerialised, XLA drops
    the forward pass, which nothing asks for any more.
    """
    drop = cell_size * math.tan(repose_angle)
    limit = cell_size * math.tan(repose_angle + schedule.tolerance)

    def cut(pile: Pile, start: Array, shape: tuple[int, ...]) -> tuple[Array, _Terrain]:
        """The window, with sides that are multiples of the coarsest cell."""
        part = pad_pile(_cut(pile, start, shape), schedule.block)
        return part.height, _Terrain(part.ground, movable(part, repose_angle))

    def one_round(part: Array, terrain: _Terrain) -> Array:
        return _round(part, terrain, drop, schedule, 0)

    def make_rounds(
        pile: Pile, dug: Array, start: Array, record: tuple[Array, Array] | None
    ) -> _Rounds:
        """Rounds until the pile rests; the record takes the windows and where they were."""
        shape = dug.shape

        def more(state: _Rounds) -> _Rounds:
            before, terrain = cut(pile.replace(height=state.height), state.start, shape)
            after = one_round(before, terrain)
            record = state.record
            if record is not None:
                record = (
                    record[0].at[state.made].set(before),
                    record[1].at[state.made].set(state.start),
                )
            height = _paste(state.height, after[: shape[0], : shape[1]], state.start)
            steep = _steeper_than(limit, after, terrain.active)
            start, left = state.start, state.left
            if shape != pile.height.shape:
                start, steep, left = lax.cond(
                    steep,
                    lambda: (start, jnp.array(True), left),
                    lambda: _go_beyond(pile, height, start, left, shape, repose_angle, limit),
                )
            return _Rounds(height, start, state.made + 1, steep, left, record)

        height = _paste(pile.height, dug, start)
        first, terrain = cut(pile.replace(height=height), start, shape)
        steep = _steeper_than(limit, first, terrain.active)
        return lax.while_loop(
            lambda state: state.steep & (state.made < schedule.most_rounds),
            more,
            _Rounds(height, start, jnp.zeros((), jnp.int32), steep, jnp.array(False), record),
        )

    def run(
        before: Array, dug: Array, ground: Array | None, valid: Array | None, start: Array
    ) -> Array:
        pile = Pile(before, cell_size, (0.0, 0.0), ground, valid)
        return make_rounds(pile, dug, start, None).height

    def pull(
        before: Array,
        dug: Array,
        ground: Array | None,
        valid: Array | None,
        start: Array,
        cotangent: Array,
    ) -> tuple[Array, Array]:
        pile = Pile(before, cell_size, (0.0, 0.0), ground, valid)
        shape = dug.shape
        padded = cut(pile, start, shape)[0].shape
        record = (
            jnp.zeros((schedule.most_rounds, *padded), before.dtype),
            jnp.zeros((schedule.most_rounds, 2), jnp.int32),
        )
        last = make_rounds(pile, dug, start, record)
        assert last.record is not None
        parts, starts = last.record

        def back(k: Array, cotangent: Array) -> Array:
            here = starts[last.made - 1 - k]
            _, terrain = cut(pile, here, shape)
            _, pullback = jax.vjp(lambda h: one_round(h, terrain), parts[last.made - 1 - k])
            part = lax.dynamic_slice(cotangent, here, shape)
            part = jnp.pad(part, [(0, p - n) for p, n in zip(padded, shape, strict=True)])
            return _paste(cotangent, pullback(part)[0][: shape[0], : shape[1]], here)

        cotangent = lax.fori_loop(0, last.made, back, cotangent)
        of_dug = lax.dynamic_slice(cotangent, start, shape)
        return _paste(cotangent, jnp.zeros_like(of_dug), start), of_dug

    if one_by_one:
        # A CPU gains nothing from a batch, which would make as many rounds as its slowest member.
        run = jax.custom_batching.sequential_vmap(run)
        pull = jax.custom_batching.sequential_vmap(pull)

    @jax.custom_vjp
    def solve(
        before: Array, dug: Array, ground: Array | None, valid: Array | None, start: Array
    ) -> Array:
        return run(before, dug, ground, valid, start)

    def forward(*arguments: Any):
        return run(*arguments), arguments

    def backward(arguments: tuple[Any, ...], cotangent: Array):
        return *pull(*(*arguments, cotangent)), None, None, None

    solve.defvjp(forward, backward)
    return solve


def _paste(height: Array, part: Array, start: Array) -> Array:
    return lax.dynamic_update_slice(height, part, (start[0], start[1]))


class _Rounds(NamedTuple):
    """What the rounds of a relaxation carry."""

    height: Array  # of the whole grid
    start: Array  # first cell of the window
    made: Array  # rounds so far
    steep: Array  # whether there is more to do
    left: Array  # whether the avalanche has left its first window
    record: tuple[Array, Array] | None  # windows and their starts before each round


def _go_beyond(
    pile: Pile,
    height: Array,
    start: Array,
    left: Array,
    shape: tuple[int, ...],
    repose_angle: float,
    limit: float,
) -> tuple[Array, Array, Array]:
    """The next window of an avalanche, whether there is one, and whether it has left the first.

    It goes on where the pile is too steep and steeper than it was before the loading. If that is
    so across a side of the first window, the whole grid is searched for the steepest such place,
    and again after every further window.
    """

    def worst(before: Pile, height: Array) -> Array:
        active = movable(before, repose_angle)
        rises = zip(_rises(height, active), _rises(before.height, active), strict=True)
        worse = (jnp.where((now > limit) & (now > then), now, 0.0) for now, then in rises)
        return functools.reduce(jnp.maximum, worse)

    beyond = [left]
    for axis in (0, 1):
        # Two cells on either side; at the border of the grid these lie inside the window.
        sizes = tuple(4 if k == axis else n for k, n in enumerate(shape))
        for side in (0, shape[axis]):
            first = start.at[axis].add(side - 2)
            strip = lax.dynamic_slice(height, first, sizes)
            beyond.append(worst(_cut(pile, first, sizes), strip).sum() > 0.0)
    left = functools.reduce(jnp.logical_or, beyond)

    def search() -> tuple[Array, Array]:
        steep = worst(pile, height)
        cell = jnp.stack(jnp.unravel_index(jnp.argmax(steep), steep.shape)).astype(jnp.int32)
        sizes = jnp.asarray(shape, jnp.int32)
        first = jnp.clip(cell - sizes // 2, 0, jnp.asarray(steep.shape, jnp.int32) - sizes)
        return first, steep.max() > 0.0

    start, steep = lax.cond(left, search, lambda: (start, jnp.array(False)))
    return start, steep, left


def _rises(height: Array, active: Array | None) -> Iterator[Array]:
    """Height differences to half of the neighbours over their distance in cells."""
    around, links = _rim(height), None if active is None else _links(active)
    for (i, j), bit in tuple(zip(_NEIGHBOURS, _BITS, strict=True))[4:]:
        rise = jnp.abs(height - _around(around, i, j)) / math.hypot(i, j)
        # The mirrored border repeats a straight difference at a diagonal distance: no maximum.
        yield rise if links is None else jnp.where(links & bit != 0, rise, 0.0)


def _steeper_than(limit: float, height: Array, active: Array | None) -> Bool[Array, ""]:
    """Whether some height difference over its distance in cells is more than a limit [m]."""
    steep = functools.reduce(jnp.logical_or, (r > limit for r in _rises(height, active)))
    # XLA's sums are many times faster on a CPU than its `any` and `max`.
    return jnp.where(steep, 1.0, 0.0).sum() > 0.0


def steepest_slope(pile: Pile) -> Float[Array, ""]:
    """Steepest slope between any two neighbouring cells that were seen [rad]."""
    steepest = functools.reduce(jnp.maximum, _rises(pile.height, pile.valid)).max()
    return jnp.arctan(steepest / pile.cell_size)


# --- which cells, and where


def movable(pile: Pile, repose_angle: float) -> Bool[Array, "nx ny"] | None:
    """Cells that were seen and whose floor is not too steep for soil to lie on; None: all."""
    if pile.ground is None:
        return pile.valid
    drop = pile.cell_size * math.tan(repose_angle)
    around = _rim(pile.ground)
    active = jnp.ones(pile.height.shape, bool) if pile.valid is None else pile.valid
    for i, j in _NEIGHBOURS:
        step = jnp.abs(pile.ground - _around(around, i, j))
        active = active & (step <= drop * math.hypot(i, j))
    return active


def pad_pile(pile: Pile, block: int) -> Pile:
    """Extends the sides of a pile to multiples of `block` cells; the new ones take no part."""
    nx, ny = pile.height.shape
    widths = ((0, -nx % block), (0, -ny % block))
    if widths == ((0, 0), (0, 0)):
        return pile
    valid = jnp.ones((nx, ny), bool) if pile.valid is None else pile.valid
    return pile.replace(
        height=jnp.pad(pile.height, widths, mode="edge"),
        ground=None if pile.ground is None else jnp.pad(pile.ground, widths, mode="edge"),
        valid=jnp.pad(valid, widths),
    )


# Side of the window that is settled after a loading [cells], and how far its centre lies ahead of
# the dig location along the heading [m]: the bucket reaches 4.5 m in, avalanches run up from there.
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

    window = _cut(pile, start, sizes)
    corner = jnp.stack([s.astype(pile.height.dtype) for s in start])
    origin = jnp.asarray(pile.origin) + pile.cell_size * corner
    return window.replace(origin=origin), (start[0], start[1])


def _cut(pile: Pile, start: Array | tuple[Array, ...], sizes: tuple[int, ...]) -> Pile:
    """The fields of a part of the grid."""

    def cut(field: Array | None) -> Array | None:
        return None if field is None else lax.dynamic_slice(field, start, sizes)

    return pile.replace(height=cut(pile.height), ground=cut(pile.ground), valid=cut(pile.valid))
