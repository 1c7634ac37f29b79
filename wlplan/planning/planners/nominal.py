"""One fixed action at evenly spread poses, the action tuned on the very pile it is used on."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from wlplan.actions import spread_actions
from wlplan.planning.descent import Descent, begin, descend_stepwise, least, step
from wlplan.planning.job import Decisions, Job, can_refine
from wlplan.planning.playing import costs_and_gradients, cusps_of_plans, outcomes
from wlplan.planning.proposals import Progress, Proposals
from wlplan.planning.search import Cusps
from wlplan.planning.watch import watching


@dataclasses.dataclass(frozen=True)
class Nominal:
    """The best actions of a Latin hypercube, each judged by its whole plan, refined by Adam.

    In a world without a derivative nothing is refined.
    """

    # Actions that are tried, and how many plans are played side by side.
    actions: int = 24
    rows: int = 6
    # Steps of Adam on the best `rows` of them, and its rate.
    refine_steps: int = 30
    refine_rate: float = 0.16

    @classmethod
    def by_trial(cls) -> Nominal:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(actions=16, refine_steps=0)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """One plan, leaves [1, N]; arguments as of `Planner.propose`."""
        watch = watching(progress)
        refines = can_refine(job, self.refine_steps)
        batches = -(-self.actions // self.rows)
        random = np.random.default_rng(seed)
        trials = spread_actions(self.rows * batches, random, job.pile.height.dtype)
        total = batches + (self.refine_steps if refines else 0)
        # All plans dig at the same poses, so they have the same ways, but for the soil around.
        cusps: Cusps | None = None
        if refines:
            watch.spend(loading=loads, way=loads)
            cusps = cusps_of_plans(job, evenly_spread(job, loads, trials[:1]))
            cusps = jax.tree.map(lambda leaf: jnp.repeat(leaf, self.rows, axis=0), cusps)

        def evaluate(actions: Array) -> tuple[Array, Array]:
            plans = evenly_spread(job, loads, actions)
            count = loads * len(actions)
            if not refines:
                watch.spend(loading=count, way=count)
                return outcomes(job, plans).cost, jnp.zeros_like(actions)
            watch.spend(gradient=count)
            costs, gradients = costs_and_gradients(job, (plans, cusps))
            # All loadings share the action.
            return costs, gradients.action.sum(axis=1)

        def keep(actions: Array, costs: Any) -> None:
            values = np.nan_to_num(np.asarray(costs), nan=np.inf)
            best = int(np.argmin(values))
            plan = evenly_spread(job, loads, actions[best : best + 1])
            watch.keep(jax.tree.map(lambda leaf: leaf[0], plan), float(values[best]))

        tried: list[np.ndarray] = []
        for k in range(batches):
            costs, _ = evaluate(trials[k * self.rows : (k + 1) * self.rows])
            tried.append(np.asarray(costs))
            keep(trials[k * self.rows : (k + 1) * self.rows], tried[-1])
            watch("nominal", k + 1, total, least(np.concatenate(tried)))
        costs_of_trials = np.nan_to_num(np.concatenate(tried), nan=np.inf, posinf=np.inf)
        order = np.argsort(costs_of_trials)
        best, lowest = trials[order[0]], float(costs_of_trials[order[0]])
        if refines:

            def visit(number: int, costs: Array, descent: Descent) -> None:
                reached = min(lowest, least(costs), least(descent.best_costs))
                keep(descent.variables, costs)
                watch("nominal", batches + number + 1, total, reached)

            last = descend_stepwise(
                evaluate,
                begin(trials[order[: self.rows]], _optimiser(self.refine_rate)),
                functools.partial(_advance, rate=self.refine_rate),
                self.refine_steps,
                visit,
            )
            winner = int(np.argmin(last.best_costs))
            if float(last.best_costs[winner]) < lowest:
                best = last.best[winner]
        return Proposals(evenly_spread(job, loads, best[None, :]))


def _optimiser(rate: float) -> optax.GradientTransformation:
    return optax.adam(rate)


@functools.partial(jax.jit, static_argnames="rate")
def _advance(descent: Descent, costs: Array, gradients: Array, *, rate: float) -> Descent:
    return step(descent, costs, gradients, _optimiser(rate))


def evenly_spread(job: Job, loads: int, actions: Float[Array, "k 4"]) -> Decisions:
    """Poses at equal distances around the toe, square to it, one action a plan; leaves [K, N]."""
    dtype = job.pile.height.dtype
    shape = (actions.shape[0], loads)
    position = (jnp.arange(loads, dtype=dtype) + 0.5) / loads
    return Decisions(
        position=jnp.broadcast_to(position[None, :], shape),
        offset=jnp.zeros(shape, dtype),
        action=jnp.broadcast_to(actions[:, None, :], (*shape, 4)),
    )
