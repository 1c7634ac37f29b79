"""Adam over the whole sequence of poses and actions, from several starts at once."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wlplan.planning.descent import Descent, begin, descend_stepwise, least, step
from wlplan.planning.job import Decisions, Job, check_has_gradient, contour_length
from wlplan.planning.planners.greedy import Greedy
from wlplan.planning.playing import costs_and_gradients, cusps_of_plans
from wlplan.planning.population import plans_to_start_at
from wlplan.planning.proposals import Planner, Progress, Proposals
from wlplan.planning.watch import watching

_GREEDY = Greedy()


@dataclasses.dataclass(frozen=True)
class Gradient:
    """Improves all loadings at once: plans of another planner, and perturbations of the first."""

    plays_in_referee: ClassVar[bool] = True  # the plan that it starts at

    # Plans that are optimised side by side: those of the planner that it starts at, as many as it
    # hands over, and perturbations of the first.
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
    # How many plans are handed on, the first start included, and how often one is taken from each
    # start as the iterations go.
    candidates: int = 16
    snapshot_every: int = 4
    # How often the ways are searched for; in between they move with the poses.
    search_every: int = 8
    # Whose plans it starts at.
    start: Planner = _GREEDY

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """The cheapest plans that were passed, in the order of their cost, leaves [K, N].

        The limit is the first plan that it starts at: nothing that costs more is handed on.
        Arguments as of `Planner.propose`.

        Raises:
            InputError: If the world has no derivative, or the planner that it starts at plans fixed
                poses.
        """
        check_has_gradient(job, "plan in a learned world, or use the greedy or the nominal planner")
        watch = watching(progress)
        plans = plans_to_start_at(self.start, job, loads, seed=seed, watch=watch)
        job = job.replace(referee=None)
        length = contour_length(job)
        random = np.random.default_rng([seed, 1])
        shaken = (self._perturbed(_row(plans, 0), length, random) for _ in range(self.starts))
        start = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[: self.starts], plans, *shaken)
        # Which load is a truck's last has no gradient.
        trucks, start = start.truck, start.replace(truck=None)
        base = _row(plans, 0)

        def with_truck(variables: Decisions, row: int) -> Decisions:
            one = _row(variables, row)
            return one.replace(truck=None if trucks is None else trucks[row : row + 1])

        # Every plan that may be handed on: cost, and decisions with a leading axis of one.
        snapshots: list[tuple[float, Decisions]] = []
        limit = np.inf
        step_number, cusps = 0, None

        def evaluate(decisions: Decisions) -> tuple[Array, Decisions]:
            nonlocal step_number, cusps
            if step_number % self.search_every == 0:
                watch.spend(loading=self.starts * loads, way=self.starts * loads)
                cusps = cusps_of_plans(job, decisions)
            step_number += 1
            watch.spend(gradient=self.starts * loads)
            found: tuple[Array, Decisions] = costs_and_gradients(
                job, (decisions.replace(truck=trucks), cusps)
            )
            return found

        def visit(number: int, costs: Array, descent: Descent) -> None:
            nonlocal limit
            values = np.asarray(costs)
            if number == 0 and np.isfinite(values[0]):
                limit = float(values[0])
            if number % self.snapshot_every == 0:
                found = np.flatnonzero(np.isfinite(values))
                snapshots.extend(
                    (float(values[row]), with_truck(descent.variables, int(row))) for row in found
                )
            if np.isfinite(values).any():
                row = int(np.nanargmin(values))
                plan = with_truck(descent.variables, row)
                watch.keep(jax.tree.map(lambda leaf: leaf[0], plan), float(values[row]))
            reached = min(least(descent.best_costs), least(values))
            watch("gradient", number, self.iterations, reached)

        last = descend_stepwise(
            evaluate,
            begin(start, self._optimiser(length)),
            functools.partial(_advance, length=length, planner=self),
            self.iterations + 1,
            visit,
        )
        best = [
            (float(cost), with_truck(last.best, row))
            for row, cost in enumerate(np.asarray(last.best_costs))
            if np.isfinite(cost)
        ]
        pool = sorted([*best, *snapshots], key=lambda pair: pair[0])
        # An even choice, since the cheapest plans are also those that exploit the model most.
        cheap = [plan for cost, plan in pool if cost <= limit] or [base]
        # Always the same number, repeats included: what plays them is compiled for it.
        picks = np.linspace(0, len(cheap) - 1, self.candidates - 1).round().astype(int)
        candidates = jax.tree.map(
            lambda *leaves: jnp.concatenate(leaves), *[cheap[k] for k in picks]
        )
        return Proposals(candidates, limit=jax.tree.map(lambda leaf: leaf[0], base))

    def _optimiser(self, length: Float[Array, ""]) -> optax.GradientTransformation:
        """Adam with a step length for each kind of variable."""
        schedule = optax.cosine_decay_schedule(-1.0, self.iterations, alpha=0.05)
        sizes: Any = (self.step_position / length, self.step_offset, self.step_action)
        steps = Decisions(*sizes)

        def scale(updates: Decisions, _: Decisions | None) -> Decisions:
            scaled: Decisions = jax.tree.map(lambda size, update: size * update, steps, updates)
            return scaled

        return optax.chain(
            optax.scale_by_adam(b1=0.8),
            optax.scale_by_schedule(schedule),
            optax.stateless(scale),
        )

    def _perturbed(
        self, plan: Decisions, length: Float[Array, ""], random: np.random.Generator
    ) -> Decisions:
        def shaken(leaf: Array, spread: float | Array) -> Array:
            return leaf + spread * jnp.asarray(random.normal(size=leaf.shape), leaf.dtype)

        return Decisions(
            position=shaken(plan.position, self.spread_position / length),
            offset=shaken(plan.offset, self.spread_offset),
            action=shaken(plan.action, self.spread_action),
            truck=plan.truck,
        )


@functools.partial(jax.jit, static_argnames="planner")
def _advance(
    descent: Descent,
    costs: Float[Array, " k"],
    gradients: Decisions,
    *,
    length: Float[Array, ""],
    planner: Gradient,
) -> Descent:
    return step(descent, costs, gradients, planner._optimiser(length))


def _row(plans: Decisions, row: int) -> Decisions:
    one: Decisions = jax.tree.map(lambda leaf: leaf[row : row + 1], plans)
    return one
