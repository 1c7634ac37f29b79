"""The place of the truck and the digs of a plan, refined together by gradient.

What a plan costs is smooth in where the loader dumps as long as the ways keep their cusps, which
move with their ends. What a truck must not stand on has no gradient: steps onto it are not made.
Where trucks are filled to just what they may lack, most steps of the digs cost much, and none of
the place does: so both have steps of their own length, and only those are made that are cheaper.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, TypeAlias, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from wlplan.planning.job import Decisions, Job, contour_length
from wlplan.planning.placement import place_of, receiver_at
from wlplan.planning.playing import cusps_of_plans, play_candidate
from wlplan.planning.search import Cusps
from wlplan.planning.watch import Watch
from wlplan.site.receiver import Receiver
from wlplan.xla import ParallelMap

# First steps: of the place [m], of the heading there [rad], of digs along the toe [m], of their
# headings and actions before squashing.
_PLACE, _HEADING, _POSITION, _OFFSET, _ACTION = 0.4, 0.1, 0.12, 0.05, 0.05
# How steps grow after one that was made and shrink after one that was not; below the last part of
# the first ones nothing is left to gain.
_GROWS, _SHRINKS, _LEAST = 1.5, 0.4, 0.02
# How often the ways are searched for.
_SEARCH_EVERY = 6


@no_type_check
class Placed(struct.PyTreeNode):
    """A plan, and where the truck stands."""

    receiver: Receiver
    plan: Decisions


def at_receiver(job: Job, receiver: Receiver) -> Job:
    """A job whose truck stands somewhere else."""
    moved: Job = job.replace(site=job.site.replace(receiver=receiver))
    return moved


def cost_of_placed(
    job: Job, placed: Placed, *, truck: Array | None = None, cusps: Cusps | None = None
) -> Float[Array, ""]:
    """What a plan costs with the truck at a place.

    Args:
        job: What is planned for; its receiver plays no part.
        placed: Receiver, and decisions [N] without trucks.
        truck: That each load goes to, [N].
        cusps: Of the best ways where they are known; leaves [N, ...].
    """
    plan = placed.plan.replace(truck=truck)
    cost: Array = play_candidate(
        at_receiver(job, placed.receiver), plan, cusps=cusps, report=False
    ).cost
    return cost


def _cost_and_gradient(
    job: Job, row: tuple[Placed, Array | None, Cusps]
) -> tuple[Float[Array, ""], Any]:
    placed, truck, cusps = row
    return jax.value_and_grad(lambda one: cost_of_placed(job, one, truck=truck, cusps=cusps))(
        placed
    )


_costs_and_gradients = ParallelMap(_cost_and_gradient)


MayStand: TypeAlias = Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]
"""Whether trucks may stand where they are loaded from x [m], y [m] and heading [rad]."""


def refined(job: Job, plan: Decisions, may_stand: MayStand, *, steps: int, watch: Watch) -> Placed:
    """A cheaper place with cheaper digs, found by steps down the gradient of both.

    Args:
        job: In a world with a derivative, with its toe and the receiver that the descent begins at.
        plan: Decisions that it begins at, leaves [N].
        may_stand: Where the truck has room.
        steps: Most steps; at each both are moved, or one of them, whatever is cheapest.
        watch: Told what it took.
    """
    truck, count = plan.truck, len(plan.position)
    length = float(contour_length(job))
    at, lengths = Placed(job.site.placed_receiver, plan.replace(truck=None)), np.ones(2)
    cost, gradient, cusps = np.inf, at, None

    def look(tried: list[Placed]) -> tuple[np.ndarray, list[Placed]]:
        rows = jax.tree.map(lambda *leaves: jnp.stack(leaves), *tried)
        same = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], len(tried), 0), (truck, cusps))
        watch.spend(gradient=len(tried) * count)
        costs, gradients = _costs_and_gradients(job, (rows, *same))
        found = [jax.tree.map(lambda leaf, k=k: leaf[k], gradients) for k in range(len(tried))]
        return np.nan_to_num(np.asarray(costs, float), nan=np.inf), found

    for number in range(steps):
        if number % _SEARCH_EVERY == 0:
            watch.spend(loading=count, way=count)
            moved = at_receiver(job, at.receiver)
            row = jax.tree.map(lambda leaf: leaf[None], at.plan)
            cusps = jax.tree.map(lambda leaf: leaf[0], cusps_of_plans(moved, row))
            costs, gradients = look([at])
            cost, gradient = float(costs[0]), gradients[0]
        watch("truck and digs", number, steps, cost)
        parts = ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0))
        tried = [_step(job, at, gradient, part * lengths, length, may_stand) for part in parts]
        costs, gradients = look(tried)
        best = int(np.argmin(costs))
        if costs[best] < cost:
            at, cost, gradient = tried[best], float(costs[best]), gradients[best]
            lengths = lengths * np.where(np.array(parts[best]) > 0.0, _GROWS, _SHRINKS)
        else:
            lengths = lengths * _SHRINKS
        if lengths.max() < _LEAST:
            break
    return at.replace(plan=at.plan.replace(truck=truck))


def _step(
    job: Job,
    at: Placed,
    gradient: Placed,
    lengths: Float[np.ndarray, "2"],
    toe: float,
    may_stand: MayStand,
) -> Placed:
    """A step down the gradient: of the place and of the digs, each so many times its first one."""
    place: Any = (_PLACE, _PLACE, _HEADING)
    digs: Any = (_POSITION / toe, _OFFSET, _ACTION)
    receiver = _moved(at.receiver, gradient.receiver, Receiver(*place), lengths[0])
    allowed = _allowed(place_of(at.receiver), place_of(receiver), may_stand)
    return Placed(
        receiver_at(allowed, job.pile),
        _moved(at.plan, gradient.plan, Decisions(*digs), lengths[1]),
    )


def _moved(values: Any, gradient: Any, sizes: Any, length: float) -> Any:
    """Values moved down a gradient, the one that moves furthest by its size, times a length."""
    down = jax.tree.map(lambda size, slope: -size * np.asarray(slope), sizes, gradient)
    furthest = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(down))
    if not 0.0 < furthest < np.inf:
        return values

    def moved(value: Array, size: Any, part: Any) -> Array:
        return jnp.asarray(np.asarray(value) + length * size * part / furthest, value.dtype)

    return jax.tree.map(moved, values, sizes, down)


def _allowed(
    old: Float[np.ndarray, "3"], new: Float[np.ndarray, "3"], may_stand: MayStand
) -> Float[np.ndarray, "3"]:
    """The step from a place to the next, or as many of its parts as the truck has room for."""
    parts = sorted(itertools.product((True, False), repeat=3), key=sum, reverse=True)
    tried = np.where(np.array(parts), new, old)
    # The last is the old place, where the truck stands already.
    found = np.append(may_stand(tried[:-1]), True)
    allowed: np.ndarray = tried[int(np.argmax(found))]
    return allowed
