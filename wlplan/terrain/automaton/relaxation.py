"""Relaxation of a pile: rounds, window after window, until it rests, and their reverse rule."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, overload

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from wlplan.checks import check_pile, is_traced
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton.rounds import DEFAULT_SCHEDULE, Schedule, Terrain, one_round
from wlplan.terrain.automaton.slopes import movable, rises, steeper_than, steepest_slope
from wlplan.terrain.automaton.windows import pad_pile, paste
from wlplan.terrain.heightmap import cut_out
from wlplan.types import Pile


class Settled(NamedTuple):
    """A pile that was let slide, and how that ended."""

    pile: Pile
    rounds: Int[Array, ""]  # that were made
    at_rest: Bool[Array, ""]  # False: it gave up after the schedule's `most_rounds`
    steepest_slope: Float[Array, ""]  # left between cells that can slide [rad]


def settle(
    pile: Pile,
    *,
    repose_angle: float = GRAVEL.repose_angle,
    schedule: Schedule = DEFAULT_SCHEDULE,
) -> Settled:
    """Relaxes a disturbed pile until it is within the schedule's tolerance.

    Slopes of the floor itself, where no soil lies on it, are not changed, nor are unseen cells.

    Args:
        pile: Any pile.
        repose_angle: Angle of repose [rad].
        schedule: Sweeps, tolerance, and when to give up.

    Returns:
        A pile of the same volume; the same pile if it was within the tolerance; and how it ended.
        The pile is differentiable in `pile.height` by reverse mode, whose memory is one surface a
        round and what a single round leaves. Under `vmap` every member makes its own number of
        rounds on the CPU, one after the other; on other devices all make as many as the slowest.
    """
    corner = jnp.zeros(2, jnp.int32)
    settled: Settled = _settled(pile, pile.height, corner, repose_angle, schedule)
    return settled


def settle_dug(
    pile: Pile,
    dug: Float[Array, "n m"],
    start: tuple[Array, Array],
    *,
    repose_angle: float = GRAVEL.repose_angle,
    schedule: Schedule = DEFAULT_SCHEDULE,
) -> Settled:
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
        The pile afterwards and how it ended, see `settle`.
    """
    settled: Settled = _settled(pile, dug, jnp.stack(start), repose_angle, schedule)
    return settled


@overload
def relax(
    pile: Pile, *, repose_angle: float = ..., tolerance: float = ..., report: Literal[False] = ...
) -> Pile: ...


@overload
def relax(
    pile: Pile, *, repose_angle: float = ..., tolerance: float = ..., report: Literal[True]
) -> Settled: ...


def relax(
    pile: Pile,
    *,
    repose_angle: float = GRAVEL.repose_angle,
    tolerance: float = math.radians(1.0),
    report: bool = False,
) -> Pile | Settled:
    """Lets a pile slide until no slope exceeds the angle of repose; keeps its volume.

    Args:
        pile: Any pile.
        repose_angle: Angle of repose [rad].
        tolerance: How much steeper than `repose_angle` the result may be [rad].
        report: Whether to return how it ended, too.

    Returns:
        The relaxed pile, or with `report` what `settle` returns, which this is with more patience.

    Raises:
        InputError: If a height is NaN or infinite.

    Warns:
        RuntimeWarning: If the pile is not at rest when it gives up. Not under `jit`, where only
            the report says so.
    """
    check_pile(pile)
    settled: Settled = _relaxed(pile, repose_angle, tolerance)
    if report:
        return settled
    if not is_traced(settled) and not settled.at_rest.all():
        steepest = math.degrees(float(settled.steepest_slope.max()))
        warnings.warn(
            f"the pile is not at rest: after {int(settled.rounds.max())} rounds a slope of "
            f"{steepest:.0f} degrees is left",
            RuntimeWarning,
            stacklevel=2,
        )
    return settled.pile


@functools.partial(jax.jit, static_argnums=(1, 2))
def _relaxed(pile: Pile, repose_angle: float, tolerance: float) -> Settled:
    schedule = dataclasses.replace(DEFAULT_SCHEDULE, tolerance=tolerance, most_rounds=_MOST_ROUNDS)
    return settle(pile, repose_angle=repose_angle, schedule=schedule)


# `relax` gives up after this many rounds; a tall cliff across a 20 m grid needs about half.
_MOST_ROUNDS = 200


# Compiled once, also where a pile is settled outside of `jit`.
@functools.partial(jax.jit, static_argnames=("repose_angle", "schedule"))
def _settled(
    pile: Pile, dug: Array, start: Array, repose_angle: float, schedule: Schedule
) -> Settled:
    one_by_one = jax.default_backend() == "cpu"
    solve = _solver(pile.cell_size, repose_angle, schedule, one_by_one)
    height, rounds, at_rest = solve(pile.height, dug, pile.ground, pile.valid, start)
    after = pile.replace(height=height)
    still = lax.stop_gradient(after)
    slope = steepest_slope(still, movable(still, repose_angle))
    return Settled(after, rounds, at_rest, slope)


@functools.cache
def _solver(
    cell_size: float, repose_angle: float, schedule: Schedule, one_by_one: bool
) -> Callable[[Array, Array, Array | None, Array | None, Array], tuple[Array, Array, Array]]:
    """Relaxation of (before, dug, ground, valid, start), with its reverse rule, for one setting.

    It returns the surface, the rounds that were made, and whether it is at rest.

    `dug` is a window that begins at `start`, or all of the grid. The rule keeps the surface before
    and nothing else, and makes the rounds again: so where a rollout is rematerialised, XLA drops
    the forward pass, which nothing asks for any more.
    """
    drop = cell_size * math.tan(repose_angle)
    limit = cell_size * math.tan(repose_angle + schedule.tolerance)

    def window(pile: Pile, start: Array, shape: tuple[int, ...]) -> tuple[Array, Terrain]:
        """The window, with sides that are multiples of the coarsest cell."""
        part = pad_pile(cut_out(pile, start, shape), schedule.block)
        return part.height, Terrain(part.ground, movable(part, repose_angle))

    def make_rounds(pile: Pile, dug: Array, start: Array, *, room: int) -> _Rounds:
        """Rounds until the pile rests; so many of them are recorded."""
        shape = dug.shape

        def more(state: _Rounds) -> _Rounds:
            before, terrain = window(pile.replace(height=state.height), state.start, shape)
            after = one_round(before, terrain, drop, schedule)
            windows, starts = state.windows, state.starts
            if room:
                windows = windows.at[state.made].set(before)
                starts = starts.at[state.made].set(state.start)
            height = paste(state.height, after[: shape[0], : shape[1]], state.start)
            steep = steeper_than(limit, after, terrain.active)
            start, left = state.start, state.left
            if shape != pile.height.shape:
                start, steep, left = lax.cond(
                    steep,
                    lambda: (start, jnp.array(True), left),
                    lambda: _go_beyond(pile, height, start, left, shape, repose_angle, limit),
                )
            return _Rounds(height, start, state.made + 1, steep, left, windows, starts)

        height = paste(pile.height, dug, start)
        first, terrain = window(pile.replace(height=height), start, shape)
        begin = _Rounds(
            height,
            start,
            made=jnp.zeros((), jnp.int32),
            steep=steeper_than(limit, first, terrain.active),
            left=jnp.array(False),
            windows=jnp.zeros((room, *first.shape), height.dtype),
            starts=jnp.zeros((room, 2), jnp.int32),
        )
        return lax.while_loop(
            lambda state: state.steep & (state.made < schedule.most_rounds), more, begin
        )

    def run(
        before: Array, dug: Array, ground: Array | None, valid: Array | None, start: Array
    ) -> tuple[Array, Array, Array]:
        pile = Pile(before, cell_size, (0.0, 0.0), ground, valid)
        last = make_rounds(pile, dug, start, room=0)
        return last.height, last.made, ~last.steep

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
        last = make_rounds(pile, dug, start, room=schedule.most_rounds)
        padding = [(0, p - n) for p, n in zip(last.windows.shape[1:], shape, strict=True)]

        def back(k: Array, cotangent: Array) -> Array:
            before, here = last.windows[last.made - 1 - k], last.starts[last.made - 1 - k]
            _, terrain = window(pile, here, shape)
            _, pullback = jax.vjp(lambda h: one_round(h, terrain, drop, schedule), before)
            part = jnp.pad(lax.dynamic_slice(cotangent, here, shape), padding)
            return paste(cotangent, pullback(part)[0][: shape[0], : shape[1]], here)

        cotangent = lax.fori_loop(0, last.made, back, cotangent)
        of_dug = lax.dynamic_slice(cotangent, start, shape)
        return paste(cotangent, jnp.zeros_like(of_dug), start), of_dug

    if one_by_one:
        # A CPU gains nothing from a batch, which would make as many rounds as its slowest member.
        run = jax.custom_batching.sequential_vmap(run)
        pull = jax.custom_batching.sequential_vmap(pull)

    @jax.custom_vjp
    def solve(
        before: Array, dug: Array, ground: Array | None, valid: Array | None, start: Array
    ) -> tuple[Array, Array, Array]:
        return run(before, dug, ground, valid, start)

    def forward(*arguments: Any) -> tuple[tuple[Array, Array, Array], tuple[Any, ...]]:
        return run(*arguments), arguments

    def backward(
        arguments: tuple[Any, ...], cotangents: tuple[Array, Any, Any]
    ) -> tuple[Array, Array, None, None, None]:
        # Rounds, and whether it is at rest, have no derivative.
        return *pull(*(*arguments, cotangents[0])), None, None, None

    solve.defvjp(forward, backward)
    return solve


class _Rounds(NamedTuple):
    """What the rounds of a relaxation carry."""

    height: Array  # of the whole grid
    start: Array  # first cell of the window
    made: Array  # rounds so far
    steep: Array  # whether there is more to do
    left: Array  # whether the avalanche has left its first window
    windows: Array  # before each round that is recorded
    starts: Array  # first cells of these


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

    It goes on where the pile is too steep and steeper than it was before the loading. Such places
    can only lie across the sides of windows: those of this one are looked at first, then, if there
    was another before, the whole grid.
    """
    cells, window = jnp.asarray(height.shape, jnp.int32), jnp.asarray(shape, jnp.int32)

    def steepness(first: Array, sizes: tuple[int, ...]) -> Array:
        """Of such places in a part of the grid; elsewhere 0."""
        before = cut_out(pile, first, sizes)
        now, active = lax.dynamic_slice(height, first, sizes), movable(before, repose_angle)
        pairs = zip(rises(now, active), rises(before.height, active), strict=True)
        worse = (jnp.where((a > limit) & (a > b), a, 0.0) for a, b in pairs)
        return functools.reduce(jnp.maximum, worse)

    def around(cell: Array) -> Array:
        return jnp.clip(cell - window // 2, 0, cells - window)

    # How much there is of them at each cell along the four sides.
    sides, firsts = [], []
    for axis in (0, 1):
        # Two cells on either side; at the border of the grid these lie inside the window.
        sizes = tuple(4 if k == axis else n for k, n in enumerate(shape))
        for side in (0, shape[axis]):
            first = jnp.clip(start.at[axis].add(side - 2), 0, cells - jnp.asarray(sizes, jnp.int32))
            sides.append(steepness(first, sizes).sum(axis=axis))
            firsts.append(first)
    amounts = jnp.stack([side.sum() for side in sides])
    across = amounts.sum() > 0.0
    left = left | across

    def beside() -> tuple[Array, Array]:
        """A window around the place with most along the side with most."""
        along = ((0, 1), (0, 1), (1, 0), (1, 0))
        places = [
            first + jnp.argmax(side).astype(jnp.int32) * jnp.asarray(unit, jnp.int32)
            for first, side, unit in zip(firsts, sides, along, strict=True)
        ]
        return around(jnp.stack(places)[jnp.argmax(amounts)]), jnp.array(True)

    def anywhere() -> tuple[Array, Array]:
        """A window around the steepest of the column with most."""
        # XLA's argmax over two axes takes longer on a CPU than the rest of the search.
        steep = steepness(jnp.zeros(2, jnp.int32), height.shape)
        columns = steep.sum(axis=0)
        j = jnp.argmax(columns)
        i = jnp.argmax(lax.dynamic_slice_in_dim(steep, j, 1, axis=1))
        return around(jnp.stack([i, j]).astype(jnp.int32)), columns[j] > 0.0

    def nowhere() -> tuple[Array, Array]:
        return start, jnp.array(False)

    start, steep = lax.cond(across, beside, lambda: lax.cond(left, anywhere, nowhere))
    return start, steep, left
