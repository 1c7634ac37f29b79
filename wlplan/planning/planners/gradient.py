"""Adam over the whole sequence of poses and actions, from several starts at once."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wlplan.planning.job import Decisions, ToeJob, contour_length, costs_and_gradients
from wlplan.planning.planners.search import Progress, SearchSettings, greedy, nominal

DEFAULT_SEARCH = SearchSettings()


@dataclasses.dataclass(frozen=True)
class GradientSettings:
    """How hard the gradient planner works."""

    # Plans that are optimised side by side: greedy, nominal, and perturbations of the first.
    starts: int = 6
    iterations: int = 32
    # Largest step of an iteration: along the contour [m], heading offset and action before
    # squashing.
    step_position: float = 0.12
    step_offset: float = 0.05
    step_action: float = 0.08
    # Spread of the perturbed starts, in the same units.
    spread_position: float = 1.5
    spread_offset: float = 0.3
    spread_action: float = 0.5
    # How many plans are handed on for a referee to choose from, and how often one is taken from
    # each start as the iterations go.
    candidates: int = 16
    snapshot_every: int = 4
    search: SearchSettings = DEFAULT_SEARCH
    # Steps of Adam on the nominal plan, which is only a start here.
    nominal_steps: int = 6


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
    job: ToeJob,
    loads: int,
    *,
    seed: int,
    settings: GradientSettings = GradientSettings(),
    progress: Progress | None = None,
) -> Decisions:
    """The cheapest plans that Adam finds from greedy, nominal and perturbed starts.

    Args:
        job: Pile, world and objective; the world must be differentiable.
        loads: Number of loadings.
        seed: Of the starts.
        settings: How hard to work.
        progress: Called after each iteration with the best cost so far.

    Returns:
        `settings.candidates` plans, leaves [K, N], in the order of their cost, none dearer
        than the greedy plan, which is the last.
    """
    search = dataclasses.replace(settings.search, rows=settings.starts)
    base = greedy(job, loads, seed=seed, settings=search, progress=progress)
    quick = dataclasses.replace(search, refine_steps=settings.nominal_steps)
    even = nominal(job, loads, seed=seed, settings=quick, progress=progress)
    length = contour_length(job)
    rng = np.random.default_rng([seed, 1])
    rows = [base, even, *(_perturbed(base, length, rng, settings) for _ in range(settings.starts))]
    decisions = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[: settings.starts], *rows)
    state = _optimiser(settings).init(decisions)
    # Snapshots for the referee, and each start's best.
    kept: list[tuple[float, Decisions]] = []
    best_costs = np.full(settings.starts, np.inf)
    best: list[Decisions] = [base] * settings.starts
    for k in range(settings.iterations + 1):
        costs, gradients = costs_and_gradients(job, decisions)
        costs = np.asarray(costs)
        for row in np.flatnonzero(costs < best_costs):
            best_costs[row] = costs[row]
            best[row] = jax.tree.map(lambda leaf, r=row: leaf[r : r + 1], decisions)
        if k % settings.snapshot_every == 0:
            kept += [
                (float(costs[r]), jax.tree.map(lambda leaf, r=r: leaf[r : r + 1], decisions))
                for r in np.flatnonzero(np.isfinite(costs))
            ]
        if progress is not None:
            progress("gradient", k, settings.iterations, float(best_costs.min()))
        if k < settings.iterations:
            decisions, state = _update(gradients, state, decisions, length, settings=settings)
    pool = sorted([*zip(best_costs.tolist(), best, strict=True), *kept], key=lambda pair: pair[0])
    # The first row starts as the greedy plan. What is dearer than that is no candidate; of the
    # rest an even choice, since the cheapest plans are also those that exploit the model most.
    limit = next(cost for cost, _ in kept)
    cheap = [plan for cost, plan in pool if cost <= limit]
    # Always the same number, repeats included: what plays them is compiled for it.
    picks = np.linspace(0, len(cheap) - 1, settings.candidates - 1).round().astype(int)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *[cheap[k] for k in picks], base)


def _perturbed(
    plan: Decisions, length: Array, rng: np.random.Generator, settings: GradientSettings
) -> Decisions:
    def shaken(leaf: Array, spread: float | Array) -> Array:
        return leaf + spread * jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype)

    return Decisions(
        position=shaken(plan.position, settings.spread_position / length),
        offset=shaken(plan.offset, settings.spread_offset),
        action=shaken(plan.action, settings.spread_action),
    )
