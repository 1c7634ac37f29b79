"""Sweeps of the automaton: one, many in a row, with momentum, and until the pile rests."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, UInt8

from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton.neighbours import BITS, NEIGHBOURS, links_of, neighbour, rim
from wlplan.terrain.automaton.slopes import movable, steeper_than
from wlplan.types import Pile
from wlplan.xla import materialize

_Kept = TypeVar("_Kept")

# Part of the excess height that an edge moves in one sweep; 1 / (number of neighbours) is the
# largest value at which a sweep is non-expansive.
FLOW_FRACTION = 0.125


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
    links = None if active is None else links_of(active)
    return height - FLOW_FRACTION * _outflow(rim(height), drop, links)


def _excess(height: Array, neighbour: Array, limit: float) -> Array:
    """How much of a height difference is more than is stable, with its sign."""
    difference = height - neighbour
    return difference - jnp.clip(difference, -limit, limit)


def _outflow(rimmed: Array, drop: float, links: Array | None) -> Array:
    """Excess height towards all neighbours together; input with a rim, output without."""
    height = neighbour(rimmed, 0, 0)
    total = jnp.zeros_like(height)
    for (i, j), bit in zip(NEIGHBOURS, BITS, strict=True):
        flow = _excess(height, neighbour(rimmed, i, j), drop * math.hypot(i, j))
        total = total + (flow if links is None else jnp.where(links & bit != 0, flow, 0.0))
    return total


def _spread(vector: Array, rimmed: Array, drop: float, links: Array | None) -> Array:
    """The Jacobian of `_outflow` at a surface, which is symmetric, applied to a vector.

    Both inputs with a rim, the output without.
    """
    height, centre = neighbour(rimmed, 0, 0), neighbour(vector, 0, 0)
    total = jnp.zeros_like(centre)
    for (i, j), bit in zip(NEIGHBOURS, BITS, strict=True):
        slides = jnp.abs(height - neighbour(rimmed, i, j)) > drop * math.hypot(i, j)
        if links is not None:
            slides = slides & (links & bit != 0)
        total = total + jnp.where(slides, centre - neighbour(vector, i, j), 0.0)
    return total


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
    return _many_sweeps(height, None if active is None else links_of(active), drop, count)


def _many_sweeps(height: Array, links: Array | None, drop: float, count: int) -> Array:
    if count <= _KEPT:
        return slide(height, jnp.full_like(height, -jnp.inf), links, drop, 0.0, count)
    part = 1
    while part * _KEPT < count:
        part *= _KEPT

    @jax.checkpoint
    def block(h: Array, _: None) -> tuple[Array, None]:
        return _many_sweeps(h, links, drop, part), None

    blocks, rest = divmod(count, part)
    height, _ = lax.scan(block, height, None, length=blocks)
    return _many_sweeps(height, links, drop, rest) if rest else height


@partial(jax.custom_vjp, nondiff_argnums=(3, 4, 5))
def slide(
    height: Float[Array, "nx ny"],
    floor: Float[Array, "nx ny"],
    links: UInt8[Array, "nx ny"] | None,
    drop: float,
    momentum: float,
    count: int,
) -> Float[Array, "nx ny"]:
    """`count` sweeps from standstill, each as far as the last and further: the heavy-ball method.

    The velocity is dropped when it points uphill, against what the sweep itself would do. If a
    cell would end below its floor, the sweeps are made again, and the velocity is dropped as well
    before it takes more from a cell than lies there. A sweep from standstill never does that.

    Args:
        height: Surface [m].
        floor: What cannot be moved [m].
        links: Which neighbours exchange soil, see `links_of`; None: all.
        drop: Largest stable height difference between two cells that share a side [m].
        momentum: Part of the velocity that is kept from sweep to sweep.
        count: Number of sweeps.
    """
    if momentum == 0.0:

        def plain(_: Array, rimmed: Array) -> Array:
            return rim(neighbour(rimmed, 0, 0) - FLOW_FRACTION * _outflow(rimmed, drop, links))

        return neighbour(lax.fori_loop(0, count, plain, rim(height)), 0, 0)

    def step(lowest: Array | None, _: Array, state: _Moving, kept: None) -> tuple[_Moving, None]:
        return _sweep_on(state, lowest, links, drop, momentum)[0], kept

    (rimmed, _), _ = _above_floor(floor, step, height, None, count)
    return neighbour(rimmed, 0, 0)


# Surface with its rim, and velocity.
_Moving = tuple[Array, Array]


def _above_floor(
    floor: Array,
    step: Callable[[Array | None, Array, _Moving, _Kept], tuple[_Moving, _Kept]],
    height: Array,
    kept: _Kept,
    count: int,
) -> tuple[_Moving, _Kept]:
    """So many steps from standstill, and what they write down.

    If they end below the floor they are made again, and are told how low the surface may get.
    """
    lowest = jnp.minimum(floor, height)
    begin = rim(height), jnp.zeros_like(height)
    end, kept = lax.fori_loop(0, count, lambda k, carry: step(None, k, *carry), (begin, kept))
    again = below(neighbour(end[0], 0, 0), lowest)
    state = jax.tree.map(lambda a, b: jnp.where(again, a, b), begin, end)
    # Not a branch, which a batch on a GPU would always take.
    more = jnp.where(again, count, 0)
    result: tuple[_Moving, _Kept] = lax.fori_loop(
        0, more, lambda k, carry: step(lowest, k, *carry), (state, kept)
    )
    return result


def below(height: Array, lowest: Array) -> Bool[Array, ""]:
    """Whether any cell of a surface is lower than another surface."""
    # XLA's sums are many times faster on a CPU than its `any`.
    return jnp.where(height < lowest, 1.0, 0.0).sum() > 0.0


def _sweep_on(
    state: _Moving, lowest: Array | None, links: Array | None, drop: float, momentum: float
) -> tuple[_Moving, Array]:
    """Surface with its rim and velocity after one more sweep, and how much velocity was kept."""
    rimmed, velocity = state
    height = neighbour(rimmed, 0, 0)
    flow = materialize(-FLOW_FRACTION * _outflow(rimmed, drop, links), rimmed[0, 0])
    dropped = jnp.vdot(flow, velocity) < 0.0
    if lowest is not None:
        dropped = dropped | below(height + momentum * velocity + flow, lowest)
    part = jnp.where(dropped, jnp.zeros((), flow.dtype), jnp.asarray(momentum, flow.dtype))
    velocity = part * velocity + flow
    return (rim(height + velocity), velocity), part


# For the reverse rule of `slide`: surface and part of the velocity of each sweep, and the links.
_Record = tuple[Array, Array, Array | None]


def _slide_forward(
    height: Array, floor: Array, links: Array | None, drop: float, momentum: float, count: int
) -> tuple[Array, _Record]:
    def step(
        lowest: Array | None, k: Array, state: _Moving, kept: tuple[Array, Array]
    ) -> tuple[_Moving, tuple[Array, Array]]:
        (surfaces, parts), surface = kept, state[0]
        state, part = _sweep_on(state, lowest, links, drop, momentum)
        return state, (surfaces.at[k].set(surface), parts.at[k].set(part))

    surfaces = jnp.zeros((count, *rim(height).shape), height.dtype)
    kept = surfaces, jnp.zeros(count, height.dtype)
    (rimmed, _), (surfaces, parts) = _above_floor(floor, step, height, kept, count)
    return neighbour(rimmed, 0, 0), (surfaces, parts, links)


def _slide_backward(
    drop: float, momentum: float, count: int, record: _Record, cotangent: Array
) -> tuple[Array, None, None]:
    surfaces, parts, links = record

    # `both` is the cotangent of a sweep's velocity: that of the next velocity and of the surface.
    # Carried with its rim, as the flow is: XLA makes far slower code of the other ways tried.
    def step(
        state: tuple[Array, Array], recorded: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], None]:
        height, both = state
        surface, part = recorded
        height = height - FLOW_FRACTION * rim(_spread(both, surface, drop, links))
        return (height, part * both + height), None

    start = (rim(cotangent), rim(cotangent))
    (height, _), _ = lax.scan(step, start, (surfaces, parts), reverse=True)
    return neighbour(height, 0, 0), None, None


slide.defvjp(_slide_forward, _slide_backward)


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
        return (count < most_sweeps) & steeper_than(limit, height, active)

    def more(state: tuple[Array, Array]) -> tuple[Array, Array]:
        height, count = state
        return sweeps(height, drop, active, every), count + every

    height, _ = lax.while_loop(steep, more, (pile.height, jnp.zeros((), jnp.int32)))
    return pile.replace(height=height)
