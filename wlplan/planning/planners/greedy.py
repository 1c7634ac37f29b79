"""The cheapest next loading, again and again: meant to be hard to beat."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wlplan.actions import spread_actions
from wlplan.planning.descent import descend
from wlplan.planning.job import (
    Decisions,
    Job,
    can_refine,
    contour_length,
    cost_of_next,
    cusps_of_next,
    decide,
    stacked,
)
from wlplan.planning.proposals import Progress, Proposals
from wlplan.planning.search import Cusps
from wlplan.types import Pile
from wlplan.xla import ParallelMap


@dataclasses.dataclass(frozen=True)
class Greedy:
    """Tries many poses and actions for the next loading and refines the best by gradient.

    In a world without a derivative nothing is refined.
    """

    # Poses a metre of contour, heading offsets before squashing, and actions that are tried.
    poses_per_metre: float = 1.5
    offsets: tuple[float, ...] = (-0.6, 0.0, 0.6)
    actions: int = 24
    # So many poses in a row have the ways of the first of them, shifted with the pose.
    neighbours: int = 2
    # Candidates that are refined, each at a pose of its own, and steps and rate of Adam.
    refined: int = 8
    refine_steps: int = 30
    refine_rate: float = 0.08
    # Candidates that are evaluated at once: bounds the memory.
    batch: int = 256

    @classmethod
    def by_trial(cls) -> Greedy:
        """The default in worlds without a derivative, where a trial takes long: fewer of them."""
        return cls(poses_per_metre=1.0, actions=16, refine_steps=0)

    def propose(
        self, job: Job, loads: int, *, seed: int, progress: Progress | None = None
    ) -> Proposals:
        """One plan, leaves [1, N]; arguments as of `Planner.propose`."""
        refines = can_refine(job, self.refine_steps)
        random = np.random.default_rng(seed)
        dtype = job.pile.height.dtype
        count = max(8, round(self.poses_per_metre * float(contour_length(job))))
        pile, chosen = job.pile, []
        for load in range(loads):
            # A fresh shift a loading, so that poses are not tied to one raster.
            positions = (np.arange(count) + random.random()) / count
            poses = np.stack(np.meshgrid(positions, self.offsets, indexing="ij"), -1)
            poses = poses.reshape(-1, 2).astype(dtype)
            actions = spread_actions(self.actions, random, dtype)
            searched = positions[:: self.neighbours].astype(dtype)
            cusps = _cusps_at(job, pile, searched, batch=self.batch // self.actions)
            of_pose = np.arange(len(poses)) // (self.neighbours * len(self.offsets))
            cusps = jax.tree.map(lambda leaf, rows=of_pose: leaf[rows], cusps)
            costs = _candidate_costs(job, pile, (poses, cusps), actions, batch=self.batch)
            # One start a pose, so that refinement does not begin in the same place eight times.
            cheapest = costs.min(axis=1)
            best_poses = np.argsort(cheapest)[: self.refined]
            starts = Decisions(
                position=jnp.asarray(poses[best_poses, 0]),
                offset=jnp.asarray(poses[best_poses, 1]),
                action=actions[costs.argmin(axis=1)[best_poses]],
            )
            values = cheapest[best_poses]
            if refines:
                best_cusps = jax.tree.map(lambda leaf, rows=best_poses: leaf[rows], cusps)
                starts, refined = _refine(
                    job, pile, starts, best_cusps, steps=self.refine_steps, rate=self.refine_rate
                )
                values = np.asarray(refined)
            best = int(np.argmin(values))
            decision = jax.tree.map(lambda leaf, b=best: leaf[b], starts)
            pile = _advance(job, pile, decision)
            chosen.append(decision)
            if progress is not None:
                progress("greedy", load + 1, loads, float(values[best]))
        return Proposals(jax.tree.map(lambda leaf: leaf[None], stacked(chosen)))


_Tried = tuple[Any, Cusps]
"""Poses [p, 2], as positions along the toe and heading offsets, and cusps of the ways."""


def _costs_at_poses(
    shared: tuple[Job, Pile, Float[Array, "a 4"]], tried: _Tried
) -> Float[Array, "p a"]:
    """Cost of every action at every pose; what depends on the pose alone is computed once."""
    job, pile, actions = shared

    def at_pose(pose: Array, cusps: Cusps) -> Array:
        return jax.vmap(
            lambda action: cost_of_next(job, pile, Decisions(pose[0], pose[1], action), cusps)
        )(actions)

    return jax.vmap(at_pose)(*tried)


def _cusps_of_some(shared: tuple[Job, Pile], positions: Float[Array, " p"]) -> Cusps:
    job, pile = shared
    return jax.vmap(lambda at: cusps_of_next(job, pile, at, jnp.zeros_like(at)))(positions)


_costs_of_portions, _cusps_of_portions = ParallelMap(_costs_at_poses), ParallelMap(_cusps_of_some)


def _portions(count: int, size: int) -> Int[np.ndarray, "portions size"]:
    """Rows in portions of one shape; the last row fills the last portion up.

    The number of poses follows from the length of the toe; if that were a shape, every next pile
    would be compiled for.
    """
    portions = -(-count // size)
    rows: np.ndarray = np.minimum(np.arange(portions * size), count - 1).reshape(portions, size)
    return rows


def _cusps_at(job: Job, pile: Pile, positions: Float[np.ndarray, " p"], *, batch: int) -> Cusps:
    """Cusps of the ways from positions along the toe, square to it."""
    rows = _portions(len(positions), max(1, batch))
    found = _cusps_of_portions((job, pile), positions[rows])
    joined: Cusps = jax.tree.map(
        lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:])[: len(positions)], found
    )
    return joined


def _candidate_costs(
    job: Job, pile: Pile, tried: _Tried, actions: Float[Array, "a 4"], *, batch: int
) -> Float[np.ndarray, "p a"]:
    """Cost of every action at every pose, infinite where it is none.

    Portions hold at most `batch` costs.
    """
    count = len(tried[0])
    rows = _portions(count, max(1, batch // len(actions)))
    parts = jax.tree.map(lambda leaf: leaf[rows], tried)
    found = np.asarray(_costs_of_portions((job, pile, actions), parts))
    costs: np.ndarray = np.nan_to_num(found, nan=np.inf, posinf=np.inf)
    return costs.reshape(-1, len(actions))[:count]


@functools.partial(jax.jit, static_argnames=("steps", "rate"))
def _refine(
    job: Job, pile: Pile, starts: Decisions, cusps: Cusps, *, steps: int, rate: float
) -> tuple[Decisions, Float[Array, " k"]]:
    """Adam on single loadings, from several starts; returns the best visited of each.

    The ways keep their cusps, which move with the pose.
    """
    length = contour_length(job)

    def cost(variables: Decisions, cusps: Cusps) -> Array:
        # Metres along the contour, so that one rate suits all variables.
        decisions = variables.replace(position=variables.position / length)
        return cost_of_next(job, pile, decisions, cusps)

    best, costs = descend(
        lambda variables: jax.vmap(jax.value_and_grad(cost))(variables, cusps),
        starts.replace(position=starts.position * length),
        optax.adam(optax.cosine_decay_schedule(rate, steps)),
        steps,
    )
    return best.replace(position=best.position / length), costs


@jax.jit
def _advance(job: Job, pile: Pile, decisions: Decisions) -> Pile:
    return job.world(pile, *decide(job, pile, decisions))[0]
