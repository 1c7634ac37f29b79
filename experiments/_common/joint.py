"""The place of the truck and the digs of a plan, refined together by gradient.

What a plan costs has kinks just where good plans are: trucks are filled to what they may lack at
most, and ways graze what they must not touch. So a step goes where the cost falls on all sides of
the kinks nearby: down the shortest of all mixtures of the gradients there. What a truck must not
stand on has no gradient: steps onto it are made as far as there is room.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, TypeAlias, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from wlplan.parallel import ParallelMap
from wlplan.planning.job import Decisions, Job, contour_length
from wlplan.planning.placement import place_of, receiver_at
from wlplan.planning.playing import play_candidate
from wlplan.planning.spots import at_receiver
from wlplan.planning.watch import Watch
from wlplan.site.receiver import Receiver

# First steps: of the place [m], of the heading there [rad], of digs along the toe [m], of their
# headings and actions before squashing.
_PLACE, _HEADING, _POSITION, _OFFSET, _ACTION = 0.4, 0.1, 0.12, 0.05, 0.05
# Parts of a step that are tried side by side, and how the next one grows after one that was made.
_PARTS, _GROWS = (1.0, 0.3, 0.1), 2.0
# Gradients nearby that are mixed; after so many without a step that is cheaper steps get shorter.
_MIXED = 4


@no_type_check
class Placed(struct.PyTreeNode):
    """A plan, and where the truck stands."""

    receiver: Receiver
    plan: Decisions


def cost_of_placed(job: Job, placed: Placed, truck: Array | None = None) -> Float[Array, ""]:
    """What a plan costs with the truck at a place; the ways are searched for.

    Args:
        job: What is planned for; its receiver plays no part.
        placed: Receiver, and decisions [N] without trucks.
        truck: That each load goes to, [N].
    """
    plan = placed.plan.replace(truck=truck)
    cost: Array = play_candidate(at_receiver(job, placed.receiver), plan, report=False).cost
    return cost


def _cost_and_gradient(
    shared: tuple[Job, Array | None], placed: Placed
) -> tuple[Float[Array, ""], Any]:
    job, truck = shared
    return jax.value_and_grad(lambda one: cost_of_placed(job, one, truck))(placed)


_costs_and_gradients = ParallelMap(_cost_and_gradient)

MayStand: TypeAlias = Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]
"""Whether trucks may stand where they are loaded from x [m], y [m] and heading [rad]."""


def refined(job: Job, plan: Decisions, may_stand: MayStand, *, steps: int, watch: Watch) -> Placed:
    """A cheaper place with cheaper digs, or the same, by steps down the gradient of both.

    Args:
        job: In a world with a derivative, with its toe and the receiver that the descent begins at.
        plan: Decisions that it begins at, leaves [N].
        may_stand: Where the truck has room.
        steps: Most steps that are tried.
        watch: Told what it took.
    """
    truck, count = plan.truck, len(plan.position)
    start = Placed(job.site.placed_receiver, plan.replace(truck=None))
    flat, unravel = ravel_pytree(start)
    sizes = np.asarray(ravel_pytree(_sizes(start, float(contour_length(job))))[0], float)

    def look(tried: list[Placed]) -> tuple[np.ndarray, np.ndarray]:
        """Costs [K], infinite where there is none, and gradients in parts of first steps [K, n]."""
        watch.spend(gradient=len(tried) * count)
        rows = jax.tree.map(lambda *leaves: jnp.stack(leaves), *tried)
        costs, gradients = _costs_and_gradients((job, truck), rows)
        slopes = [
            ravel_pytree(jax.tree.map(lambda leaf, k=k: leaf[k], gradients))[0]
            for k in range(len(tried))
        ]
        return np.nan_to_num(np.asarray(costs, float), nan=np.inf), np.asarray(
            slopes, float
        ) * sizes

    def moved(at: Placed, step: Float[np.ndarray, " n"]) -> Placed:
        values = np.asarray(ravel_pytree(at)[0], float) + step * sizes
        to: Placed = unravel(jnp.asarray(values, flat.dtype))
        allowed = _allowed(place_of(at.receiver), place_of(to.receiver), may_stand)
        return to.replace(receiver=receiver_at(allowed, job.pile))

    at, length = start, 1.0
    costs, mixed = look([at])
    cost = float(costs[0])
    for number in range(steps):
        watch("truck and digs", number, steps, cost)
        down = -_shortest_mixture(mixed)
        furthest = float(np.abs(down).max())
        if not 0.0 < furthest < np.inf:
            break
        tried = [moved(at, part * length / furthest * down) for part in _PARTS]
        costs, slopes = look(tried)
        best = int(np.argmin(costs))
        if costs[best] < cost:
            at, cost, mixed = tried[best], float(costs[best]), slopes[best : best + 1]
            length = min(1.0, _GROWS * _PARTS[best] * length)
        elif len(mixed) < _MIXED and np.isfinite(slopes[-1]).all():
            mixed = np.concatenate([mixed, slopes[-1:]])
        else:
            mixed, length = mixed[:1], _PARTS[-1] * length
    return at.replace(plan=at.plan.replace(truck=truck))


def _sizes(placed: Placed, toe: float) -> Placed:
    """First steps of all variables."""
    receiver: Any = (_PLACE, _PLACE, _HEADING)
    digs: Any = (_POSITION / toe, _OFFSET, _ACTION)
    kinds = Placed(Receiver(*receiver), Decisions(*digs))
    sizes: Placed = jax.tree.map(lambda size, leaf: jnp.full_like(leaf, size), kinds, placed)
    return sizes


def _shortest_mixture(rows: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " n"]:
    """The shortest vector among all weighted means of some."""
    from scipy.optimize import nnls

    if len(rows) == 1:
        only: np.ndarray = rows[0]
        return only
    # That the weights sum to one is one more equation, which counts much more than the others.
    much = 1e3 * float(np.abs(rows).max())
    weights, _ = nnls(
        np.vstack([rows.T, np.full(len(rows), much)]), np.append(np.zeros(rows.shape[1]), much)
    )
    mixture: np.ndarray = weights @ rows / max(float(weights.sum()), 1e-12)
    return mixture


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
