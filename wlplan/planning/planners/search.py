"""The baselines: a tuned fixed action at evenly spread poses, and the best next loading.

Both are meant to be hard to beat: the nominal action is tuned for the very pile it is used on, and
the greedy planner tries many poses and actions and refines the best by gradient.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wlplan.actions import latin_hypercube
from wlplan.planning.job import (
    Decisions,
    ToeJob,
    contour_length,
    cost_of_one,
    costs_and_gradients,
    decide,
    outcomes,
    stacked,
    unsquash,
)
from wlplan.types import Pile
from wlplan.xla import ParallelMap

Progress = Callable[[str, int, int, float | None], None]
"""`progress(stage, done, total, cost)`, called as a planner advances."""


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """How hard the baselines search."""

    # Poses a metre of contour, heading offsets before squashing, and actions that are tried.
    poses_per_metre: float = 1.5
    offsets: tuple[float, ...] = (-0.6, 0.0, 0.6)
    actions: int = 24
    # Steps of Adam that refine the best candidates; 0 for worlds without a gradient.
    refine_steps: int = 30
    refine_rate: float = 0.08
    # The greedy planner refines this many candidates, each at a pose of its own.
    refined: int = 8
    # The nominal planner plays this many plans side by side.
    rows: int = 6
    # Candidates that are evaluated at once: bounds the memory.
    batch: int = 256


def _spread_actions(n: int, rng: np.random.Generator, dtype: np.dtype) -> Float[Array, "n 4"]:
    """Actions, before squashing, that fill the box evenly."""
    return jnp.asarray(unsquash(latin_hypercube(n, 4, rng)), dtype)


def _costs_at_poses(
    shared: tuple[ToeJob, Pile, Float[Array, "a 4"]], poses: Float[Array, "p 2"]
) -> Float[Array, "p a"]:
    """Cost of every action at every pose; what depends on the pose alone is computed once."""
    job, pile, actions = shared

    def at_pose(pose: Array) -> Array:
        return jax.vmap(lambda a: cost_of_one(job, pile, Decisions(pose[0], pose[1], a)))(actions)

    return jax.vmap(at_pose)(poses)


_costs_of_portions = ParallelMap(_costs_at_poses)


def _candidate_costs(
    job: ToeJob,
    pile: Pile,
    poses: Float[np.ndarray, "p 2"],
    actions: Float[Array, "a 4"],
    *,
    batch: int,
) -> Float[np.ndarray, "p a"]:
    """Cost of every action at every pose, in portions of at most `batch` of one shape.

    Poses are positions along the toe and heading offsets, as in `Decisions`. Their number follows
    from the length of the toe; if that were a shape, every next pile would be compiled for.
    """
    size = max(1, batch // len(actions))
    portions = -(-len(poses) // size)
    rows = np.minimum(np.arange(portions * size), len(poses) - 1).reshape(portions, size)
    costs = _costs_of_portions((job, pile, actions), poses[rows])
    return np.asarray(costs).reshape(-1, len(actions))[: len(poses)]


@functools.partial(jax.jit, static_argnames=("steps", "rate"))
def _refine(
    job: ToeJob, pile: Pile, starts: Decisions, *, steps: int, rate: float
) -> tuple[Decisions, Float[Array, " k"]]:
    """Adam on single loadings, from several starts; returns the best visited of each."""
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps))
    length = contour_length(job)

    def cost(variables: Decisions) -> Array:
        # Metres along the contour, so that one rate suits all variables.
        return cost_of_one(job, pile, variables.replace(position=variables.position / length))

    def one(start: Decisions) -> tuple[Decisions, Array]:
        def step(carry, _):
            variables, state, best, best_cost = carry
            value, gradient = jax.value_and_grad(cost)(variables)
            better = value < best_cost
            best = jax.tree.map(lambda b, v: jnp.where(better, v, b), best, variables)
            updates, state = optimiser.update(gradient, state, variables)
            variables = optax.apply_updates(variables, updates)
            return (variables, state, best, jnp.minimum(value, best_cost)), None

        first = start.replace(position=start.position * length)
        carry = (first, optimiser.init(first), first, jnp.full((), jnp.inf, length.dtype))
        (_, _, best, best_cost), _ = jax.lax.scan(step, carry, None, length=steps)
        return best.replace(position=best.position / length), best_cost

    return jax.vmap(one)(starts)


@jax.jit
def _advance(job: ToeJob, pile: Pile, decisions: Decisions) -> Pile:
    return job.world(pile, *decide(job, pile, decisions))[0]


def greedy(
    job: ToeJob,
    loads: int,
    *,
    seed: int,
    settings: SearchSettings = SearchSettings(),
    progress: Progress | None = None,
) -> Decisions:
    """The cheapest next loading, again and again.

    Args:
        job: Pile, world and objective.
        loads: Number of loadings.
        seed: Of the poses and actions that are tried.
        settings: How hard to search.
        progress: Called after each loading with its cost.

    Returns:
        One plan, leaves [1, N].
    """
    rng = np.random.default_rng(seed)
    dtype = job.pile.height.dtype
    count = max(8, round(settings.poses_per_metre * float(contour_length(job))))
    pile, chosen = job.pile, []
    for load in range(loads):
        # A fresh shift a loading, so that poses are not tied to one raster.
        positions = (np.arange(count) + rng.random()) / count
        poses = np.stack(np.meshgrid(positions, settings.offsets, indexing="ij"), -1)
        poses = poses.reshape(-1, 2).astype(dtype)
        actions = _spread_actions(settings.actions, rng, dtype)
        costs = _candidate_costs(job, pile, poses, actions, batch=settings.batch)
        # One start a pose, so that refinement does not begin in the same place eight times.
        best_poses = np.argsort(costs.min(axis=1))[: settings.refined]
        starts = Decisions(
            position=jnp.asarray(poses[best_poses, 0]),
            offset=jnp.asarray(poses[best_poses, 1]),
            action=actions[costs.argmin(axis=1)[best_poses]],
        )
        values = costs.min(axis=1)[best_poses]
        if settings.refine_steps:
            starts, refined = _refine(
                job, pile, starts, steps=settings.refine_steps, rate=settings.refine_rate
            )
            values = np.asarray(refined)
        best = int(np.nanargmin(values))
        decision = jax.tree.map(lambda leaf, b=best: leaf[b], starts)
        pile = _advance(job, pile, decision)
        chosen.append(decision)
        if progress is not None:
            progress("greedy", load + 1, loads, float(values[best]))
    return jax.tree.map(lambda leaf: leaf[None], stacked(chosen))


def evenly_spread(job: ToeJob, loads: int, actions: Float[Array, "k 4"]) -> Decisions:
    """Poses at equal distances around the toe, square to it, one action a plan; leaves [K, N]."""
    dtype = job.pile.height.dtype
    shape = (actions.shape[0], loads)
    position = (jnp.arange(loads, dtype=dtype) + 0.5) / loads
    return Decisions(
        position=jnp.broadcast_to(position[None, :], shape),
        offset=jnp.zeros(shape, dtype),
        action=jnp.broadcast_to(actions[:, None, :], (*shape, 4)),
    )


def nominal(
    job: ToeJob,
    loads: int,
    *,
    seed: int,
    settings: SearchSettings = SearchSettings(),
    progress: Progress | None = None,
) -> Decisions:
    """One fixed action at evenly spread poses, the action tuned on this pile.

    The best actions of a Latin hypercube, each judged by its whole plan, are refined by Adam.

    Args:
        job: Pile, world and objective.
        loads: Number of loadings.
        seed: Of the actions that are tried.
        settings: How hard to search.
        progress: Called as the tuning advances.

    Returns:
        One plan, leaves [1, N].
    """
    dtype = job.pile.height.dtype
    rng = np.random.default_rng(seed)
    rows = settings.rows
    batches = -(-settings.actions // rows)
    trials = _spread_actions(rows * batches, rng, dtype)
    total = batches + settings.refine_steps

    def costs_of(actions: Array) -> tuple[np.ndarray, Array]:
        plans = evenly_spread(job, loads, actions)
        if not settings.refine_steps:
            return np.asarray(outcomes(job, plans).cost), jnp.zeros_like(actions)
        costs, gradients = costs_and_gradients(job, plans)
        # All loadings share the action.
        return np.asarray(costs), gradients.action.sum(axis=1)

    tried = []
    for k in range(batches):
        tried.append(costs_of(trials[k * rows : (k + 1) * rows])[0])
        if progress is not None:
            progress("nominal", k + 1, total, float(np.nanmin(np.concatenate(tried))))
    order = np.argsort(np.concatenate(tried))
    best, best_cost = trials[order[0]], float(np.concatenate(tried)[order[0]])
    actions = trials[order[:rows]]
    optimiser = optax.adam(2.0 * settings.refine_rate)
    state = optimiser.init(actions)
    for k in range(settings.refine_steps):
        costs, gradient = costs_of(actions)
        winner = int(np.nanargmin(costs))
        if costs[winner] < best_cost:
            best, best_cost = actions[winner], float(costs[winner])
        updates, state = optimiser.update(gradient, state)
        actions = optax.apply_updates(actions, updates)
        if progress is not None:
            progress("nominal", batches + k + 1, total, best_cost)
    return evenly_spread(job, loads, best[None, :])
