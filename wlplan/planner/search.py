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

from wlplan.planner.job import Decisions, Job, cost_of_one, load_once, play_decisions, unsquash
from wlplan.types import Pile
from wlplan.units import ACTION_HIGH, ACTION_LOW

Progress = Callable[[str, int, int, float | None], None]
"""`progress(stage, done, total, cost)`, called as a planner advances."""


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """How hard the baselines search."""

    # Poses a metre of contour, heading offsets before squashing, and actions that are tried.
    poses_per_metre: float = 1.5
    offsets: tuple[float, ...] = (-0.6, 0.0, 0.6)
    actions: int = 24
    # The best candidates are refined by this many steps of Adam; 0 for worlds without gradient.
    refined: int = 8
    refine_steps: int = 30
    refine_rate: float = 0.08
    # Candidates that are evaluated at once: bounds the memory.
    batch: int = 256


def latin_hypercube(n: int, rng: np.random.Generator) -> np.ndarray:
    """n actions that fill the box evenly, one in each n-th of every parameter, shape [n, 4]."""
    cells = np.stack([rng.permutation(n) for _ in ACTION_LOW], axis=1)
    part = (cells + rng.random(cells.shape)) / n
    low, high = np.asarray(ACTION_LOW), np.asarray(ACTION_HIGH)
    return low + part * (high - low)


def _contour_length(job: Job) -> float:
    points = np.asarray(job.toe.points)
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


@functools.partial(jax.jit, static_argnames="batch")
def _candidate_costs(
    job: Job, pile: Pile, poses: Decisions, actions: Float[Array, "a 4"], *, batch: int
) -> Float[Array, "p a"]:
    """Cost of every action at every pose; what depends on the pose alone is computed once."""

    def at_pose(pose: Decisions) -> Array:
        return jax.vmap(
            lambda action: cost_of_one(job, pile, pose.replace(action=action))
        )(actions)

    return jax.lax.map(at_pose, poses, batch_size=max(1, batch // actions.shape[0]))


@functools.partial(jax.jit, static_argnames=("steps", "rate"))
def _refine(
    job: Job, pile: Pile, starts: Decisions, *, steps: int, rate: float
) -> tuple[Decisions, Float[Array, "k"]]:
    """Adam on single loadings, from several starts; returns the best visited of each."""
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps))
    length = _length_of(job)

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
        (last, _, best, best_cost), _ = jax.lax.scan(step, carry, None, length=steps)
        value = cost(last)
        best = jax.tree.map(lambda b, v: jnp.where(value < best_cost, v, b), best, last)
        return best.replace(position=best.position / length), jnp.minimum(value, best_cost)

    return jax.vmap(one)(starts)


def _length_of(job: Job) -> Float[Array, ""]:
    """Length of the toe contour [m]."""
    steps = job.toe.points[1:] - job.toe.points[:-1]
    return jnp.sqrt((steps**2).sum(axis=1)).sum()


@jax.jit
def _advance(job: Job, pile: Pile, decisions: Decisions) -> Pile:
    return load_once(job, pile, decisions)[0]


def greedy(
    job: Job,
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
        seed: Of the actions that are tried.
        settings: How hard to search.
        progress: Called after each loading.
    """
    rng = np.random.default_rng(seed)
    dtype = job.pile.height.dtype
    count = max(8, round(settings.poses_per_metre * _contour_length(job)))
    pile, chosen = job.pile, []
    for load in range(loads):
        # A fresh offset a loading, so that poses are not tied to one raster.
        positions = (np.arange(count) + rng.random()) / count
        grid = np.stack(np.meshgrid(positions, settings.offsets, indexing="ij"), -1).reshape(-1, 2)
        actions = jnp.asarray(unsquash(latin_hypercube(settings.actions, rng)), dtype)
        poses = Decisions(
            position=jnp.asarray(grid[:, 0], dtype),
            offset=jnp.asarray(grid[:, 1], dtype),
            action=jnp.zeros((len(grid), 4), dtype),
        )
        costs = np.asarray(
            _candidate_costs(job, pile, poses, actions, batch=settings.batch)
        )
        # One start a pose, so that refinement does not begin in the same place eight times.
        best_action = costs.argmin(axis=1)
        best_poses = np.argsort(costs.min(axis=1))[: max(settings.refined, 1)]
        starts = Decisions(
            position=poses.position[best_poses],
            offset=poses.offset[best_poses],
            action=actions[best_action[best_poses]],
        )
        values = costs.min(axis=1)[best_poses]
        if settings.refined:
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
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *chosen)


def evenly_spread(job: Job, loads: int, action: Float[Array, "4"]) -> Decisions:
    """Poses at equal distances around the toe, square to it, with one action."""
    dtype = job.pile.height.dtype
    return Decisions(
        position=(jnp.arange(loads, dtype=dtype) + 0.5) / loads,
        offset=jnp.zeros(loads, dtype),
        action=jnp.broadcast_to(action[None, :], (loads, 4)),
    )


@functools.partial(jax.jit, static_argnames=("loads",))
def _nominal_cost(job: Job, action: Float[Array, "4"], *, loads: int) -> Float[Array, ""]:
    return play_decisions(job, evenly_spread(job, loads, action)).cost


@functools.partial(jax.jit, static_argnames=("loads",))
def _nominal_gradient(job: Job, action: Float[Array, "4"], *, loads: int):
    return jax.value_and_grad(
        lambda a: play_decisions(job, evenly_spread(job, loads, a)).cost
    )(action)


def nominal(
    job: Job,
    loads: int,
    *,
    seed: int,
    settings: SearchSettings = SearchSettings(),
    progress: Progress | None = None,
) -> Decisions:
    """One fixed action at evenly spread poses, the action tuned on this pile.

    The action is the best of a Latin hypercube over whole plans, refined by Adam.

    Args:
        job: Pile, world and objective.
        loads: Number of loadings.
        seed: Of the actions that are tried.
        settings: How hard to search.
        progress: Called as the tuning advances.
    """
    dtype = job.pile.height.dtype
    rng = np.random.default_rng(seed)
    trials = jnp.asarray(unsquash(latin_hypercube(settings.actions, rng)), dtype)
    total = len(trials) + settings.refine_steps
    best, best_cost = trials[0], np.inf
    for k, trial in enumerate(trials):
        cost = float(_nominal_cost(job, trial, loads=loads))
        if cost < best_cost:
            best, best_cost = trial, cost
        if progress is not None:
            progress("nominal", k + 1, total, best_cost)
    if settings.refined:
        optimiser = optax.adam(2.0 * settings.refine_rate)
        action, state = best, optimiser.init(best)
        for k in range(settings.refine_steps):
            cost, gradient = _nominal_gradient(job, action, loads=loads)
            if float(cost) < best_cost:
                best, best_cost = action, float(cost)
            updates, state = optimiser.update(gradient, state)
            action = optax.apply_updates(action, updates)
            if progress is not None:
                progress("nominal", len(trials) + k + 1, total, best_cost)
    return evenly_spread(job, loads, best)
