"""Adam over the whole sequence of poses and actions, from several starts at once."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wlplan.planner.job import Decisions, Job, play_decisions
from wlplan.planner.search import Progress, SearchSettings, greedy, nominal


@dataclasses.dataclass(frozen=True)
class GradientSettings:
    """How hard the gradient planner works."""

    # Plans that are optimised side by side: greedy, nominal, and perturbations of them.
    starts: int = 6
    iterations: int = 60
    # Largest step of an iteration: along the contour [m], heading offset and action before
    # squashing.
    step_position: float = 0.12
    step_offset: float = 0.05
    step_action: float = 0.08
    # Spread of the perturbed starts, in the same units.
    spread_position: float = 1.5
    spread_offset: float = 0.3
    spread_action: float = 0.5
    search: SearchSettings = SearchSettings()


@jax.jit
def _values_and_gradients(job: Job, starts: Decisions):
    """Cost and gradient of each start; leaves [S, N]."""

    def cost(decisions: Decisions) -> Array:
        return play_decisions(job, decisions).cost

    return jax.vmap(jax.value_and_grad(cost))(starts)


@functools.partial(jax.jit, static_argnames=("settings",))
def _update(
    gradient: Decisions,
    state: optax.OptState,
    decisions: Decisions,
    length: Float[Array, ""],
    *,
    settings: GradientSettings,
) -> tuple[Decisions, optax.OptState]:
    """One step of Adam with a step length for each kind of variable."""
    direction, state = _optimiser(settings).update(gradient, state)
    return decisions.replace(
        position=decisions.position + settings.step_position / length * direction.position,
        offset=decisions.offset + settings.step_offset * direction.offset,
        action=decisions.action + settings.step_action * direction.action,
    ), state


def _optimiser(settings: GradientSettings) -> optax.GradientTransformation:
    return optax.chain(
        optax.scale_by_adam(b1=0.8),
        optax.scale_by_schedule(optax.cosine_decay_schedule(-1.0, settings.iterations, alpha=0.05)),
    )


def gradient(
    job: Job,
    loads: int,
    *,
    seed: int,
    settings: GradientSettings = GradientSettings(),
    progress: Progress | None = None,
) -> Decisions:
    """The cheapest plan that Adam finds from greedy, nominal and perturbed starts.

    Every plan that is visited counts, so the result costs at most what the greedy plan does.

    Args:
        job: Pile, world and objective; the world must be differentiable.
        loads: Number of loadings.
        seed: Of the starts.
        settings: How hard to work.
        progress: Called after each iteration with the best cost so far.
    """
    first = [
        greedy(job, loads, seed=seed, settings=settings.search, progress=progress),
        nominal(job, loads, seed=seed, settings=settings.search, progress=progress),
    ][: settings.starts]
    length = _contour_length(job)
    rng = np.random.default_rng([seed, 1])
    starts = first + [
        _perturbed(first[k % len(first)], length, rng, settings)
        for k in range(settings.starts - len(first))
    ]
    decisions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    state = _optimiser(settings).init(decisions)
    best, best_cost = first[0], np.inf
    for k in range(settings.iterations + 1):
        costs, gradients = _values_and_gradients(job, decisions)
        costs = np.asarray(costs)
        winner = int(np.nanargmin(costs))
        if costs[winner] < best_cost:
            best_cost = float(costs[winner])
            best = jax.tree.map(lambda leaf, w=winner: leaf[w], decisions)
        if progress is not None:
            progress("gradient", k, settings.iterations, best_cost)
        if k < settings.iterations:
            decisions, state = _update(
                gradients, state, decisions, jnp.asarray(length, costs.dtype), settings=settings
            )
    return best


def _contour_length(job: Job) -> float:
    points = np.asarray(job.toe.points)
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _perturbed(
    plan: Decisions, length: float, rng: np.random.Generator, settings: GradientSettings
) -> Decisions:
    def shaken(leaf: Array, spread: float) -> Array:
        return leaf + jnp.asarray(spread * rng.normal(size=leaf.shape), leaf.dtype)

    return Decisions(
        position=shaken(plan.position, settings.spread_position / length),
        offset=shaken(plan.offset, settings.spread_offset),
        action=shaken(plan.action, settings.spread_action),
    )
