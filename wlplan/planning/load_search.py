"""The search of a next load: many poses and actions, the best of them refined by gradient."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wlplan.actions import spread_actions
from wlplan.parallel import ParallelMap
from wlplan.planning.amounts import Outlook, Trucks
from wlplan.planning.descent import descend
from wlplan.planning.good_ways import good_ways
from wlplan.planning.job import Decisions, Job, Standing, beginning, can_refine, contour_length
from wlplan.planning.poses import Toe, pose_at
from wlplan.planning.search import Cusps
from wlplan.planning.stepping import next_load, score_of, score_of_next
from wlplan.planning.watch import Watch
from wlplan.traced import traced
from wlplan.types import Pile, Pose
from wlplan.worlds.capabilities import roughly
from wlplan.xla import floats


class Tried(NamedTuple):
    """Loads that could be made next: every action at every pose."""

    poses: Float[np.ndarray, "p 2"]  # positions along the toe, and heading offsets
    cusps: Cusps  # of the ways from there, leaves [p, ...]
    actions: Float[Array, "a 4"]  # before squashing
    costs: Float[np.ndarray, "p a"]  # infinite where there is none
    masses: Float[np.ndarray, "p a"]  # [tonne]


class Memory(NamedTuple):
    """What is remembered from load to load."""

    outlook: Outlook | None = None  # None: before the first
    known: Float[np.ndarray, "k 4"] | None = None  # actions that were good, before squashing


class Ranked(NamedTuple):
    """The best of them, each at a pose of its own, in no order."""

    decisions: Decisions  # leaves [K]
    cusps: Cusps  # leaves [K, ...]
    scores: Float[np.ndarray, " k"]  # cost of each and of what it leaves to do


@dataclasses.dataclass(frozen=True)
class LoadSearch:
    """How next loads are searched for; what planners have in common that go load by load.

    What is tried is foreseen roughly, if the world can, and what is refined fully. In a world
    without a derivative nothing is refined.
    """

    # Poses a metre of contour, heading offsets before squashing, and actions that are tried.
    poses_per_metre: float = 1.5
    offsets: tuple[float, ...] = (-0.6, 0.0, 0.6)
    actions: int = 24
    # So many poses in a row have the ways of the first of them, shifted with the pose.
    neighbours: int = 2
    # Candidates that are refined, each at a pose of its own, and steps and rate of Adam.
    refined: int = 8
    refine_steps: int = 20
    refine_rate: float = 0.1
    # Candidates that are evaluated at once: bounds the memory.
    batch: int = 256

    def look(
        self,
        job: Job,
        standing: Standing,
        random: np.random.Generator,
        watch: Watch,
        memory: Memory,
    ) -> tuple[Tried, Memory]:
        """What could be made next, and what is to be remembered of it for the loads after it.

        A truck is filled as it was begun: the outlook stays the same until it has left.

        Args:
            job: With its toe.
            standing: Before the loading.
            random: As of `attempt`.
            watch: Told what it took.
            memory: Of the loads before.
        """
        tried = self.attempt(job, standing, random, watch, known=memory.known)
        if not isinstance(job.amount, Trucks):
            return tried, memory._replace(outlook=self.outlook(job, standing, tried, watch)[0])
        if memory.outlook is None or not standing.done.aboard > 0.0:
            memory = Memory(*self.outlook(job, standing, tried, watch))
            tried = self.attempt(job, standing, random, watch, known=memory.known)
        return tried, memory

    def attempt(
        self,
        job: Job,
        standing: Standing,
        random: np.random.Generator,
        watch: Watch,
        *,
        known: Float[np.ndarray, "k 4"] | None = None,
    ) -> Tried:
        """Tries every action at every pose.

        Args:
            job: With its toe.
            standing: Before the loading.
            random: Source of a shift of all poses, so that they are not tied to one raster, and of
                the actions.
            watch: Told what it took.
            known: Actions that were good before, before squashing; they are tried too.
        """
        dtype = job.pile.height.dtype
        count = max(8, round(self.poses_per_metre * float(contour_length(job))))
        positions = (np.arange(count) + random.random()) / count
        poses = np.stack(np.meshgrid(positions, self.offsets, indexing="ij"), -1)
        poses = poses.reshape(-1, 2).astype(dtype)
        actions = spread_actions(self.actions, random, dtype)
        if known is not None:
            # In place of others: what evaluates them is compiled for their number.
            kept = np.concatenate([np.asarray(actions)[len(known) :], known])[-self.actions :]
            actions = jnp.asarray(kept.astype(dtype))
        searched = positions[:: self.neighbours].astype(dtype)
        cusps = quick_ways(job, standing.pile, searched)
        of_pose = np.arange(len(poses)) // (self.neighbours * len(self.offsets))
        cusps = jax.tree.map(lambda leaf: leaf[of_pose], cusps)
        costs, masses = self._costs(job, standing, poses, cusps, actions)
        watch.spend(look=costs.size, quick_way=len(searched))
        return Tried(poses, cusps, actions, costs, masses)

    def outlook(
        self, job: Job, standing: Standing, tried: Tried, watch: Watch
    ) -> tuple[Outlook, Float[np.ndarray, "k 4"]]:
        """What loads are like, by those that were tried, and actions to try for the next.

        These are of a full load, of a good one, and two between that and the cheapest: a truck may
        need a load of any mass.

        How many buckets a truck takes hangs on what these two hold, so for trucks the best are
        refined first.
        """
        rows = [int(np.argmin(_per_tonne(tried.costs, tried.masses)))]
        rows += [int(np.argmax(np.where(np.isfinite(tried.costs), tried.masses, -np.inf)))]
        actions = np.asarray(tried.actions)[np.array(rows) % len(tried.actions)]
        good, full = (
            _Load(float(tried.costs.flat[row]), float(tried.masses.flat[row])) for row in rows
        )
        pose = rows[0] // len(tried.actions)
        spare = _spare(good, tried.costs[pose], tried.masses[pose])
        if not isinstance(job.amount, Trucks) or not can_refine(job, self.refine_steps):
            return _outlook(good, full, spare), actions
        loads = []
        for worth in (1.0, _WORTH):
            priced = _outlook(good, good, spare, price=worth * good.cost / good.mass)
            best = self.best(job, standing, tried, priced, watch)
            row = int(np.argmin(best.scores))
            one = jax.tree.map(lambda leaf, row=row: leaf[row], (best.decisions, best.cusps))
            cost, mass = _cost_and_mass(job, standing, *one)
            watch.spend(look=1)
            loads.append((_Load(float(cost), float(mass)), np.asarray(one[0].action)))
        (good, first), (full, second) = loads
        least = np.asarray(tried.actions)[int(np.argmin(tried.costs[pose]))]
        between = [first + part * (least - first) for part in (1.0 / 3.0, 2.0 / 3.0)]
        return _outlook(good, full, spare), np.stack([second, first, *between])

    def best(
        self, job: Job, standing: Standing, tried: Tried, outlook: Outlook, watch: Watch
    ) -> Ranked:
        """The best of what was tried, refined.

        Args:
            job: With its toe.
            standing: Before the loading.
            tried: What `attempt` found.
            outlook: What the loads after it will be like.
            watch: Told what it took.
        """
        scores = _scores(job, standing, tried.costs, tried.masses, outlook)
        # One start a pose, so that refinement does not begin in the same place eight times.
        rows = np.argsort(scores.min(axis=1))[: self.refined]
        starts = Decisions(
            position=tried.poses[rows, 0],
            offset=tried.poses[rows, 1],
            action=np.asarray(tried.actions)[scores.argmin(axis=1)[rows]],
        )
        cusps = jax.tree.map(lambda leaf: leaf[rows], tried.cusps)
        if not can_refine(job, self.refine_steps):
            return Ranked(starts, cusps, scores.min(axis=1)[rows])
        count = self.refine_steps * len(rows)
        watch.spend(look_gradient=count)
        decisions, refined = refined_loads(
            job,
            standing,
            starts,
            (outlook, cusps),
            steps=self.refine_steps,
            rate=self.refine_rate,
        )
        return Ranked(decisions, cusps, np.asarray(refined))

    def _costs(
        self,
        job: Job,
        standing: Standing,
        poses: Float[np.ndarray, "p 2"],
        cusps: Cusps,
        actions: Float[Array, "a 4"],
    ) -> tuple[Float[np.ndarray, "p a"], Float[np.ndarray, "p a"]]:
        """Cost of every action at every pose, infinite where it is none, and mass [tonne]."""
        count = len(poses)
        rows = _portions(count, max(1, self.batch // len(actions)))
        parts = jax.tree.map(lambda leaf: leaf[rows], (poses, cusps))
        # What is refined afterwards need not be known well before.
        look = _rough_costs if can_refine(job, self.refine_steps) else _costs_of_portions
        found = look((job, standing, actions), parts)
        costs, masses = (np.asarray(leaf).reshape(-1, len(actions))[:count] for leaf in found)
        return np.nan_to_num(costs, nan=np.inf, posinf=np.inf), masses


def price_of(job: Job, seed: int, watch: Watch) -> float:
    """What a tonne costs at least, as the pile is."""
    tried = LoadSearch().attempt(job, beginning(job), np.random.default_rng(seed), watch)
    return float(_per_tonne(tried.costs, tried.masses).min())


# Scores are computed in multiples of so many.
_BLOCK = 4096
# A fuller load is worth it up to so many times the price of a tonne.
_WORTH = 2.0

_At = tuple[Any, Cusps]
"""Poses [p, 2], as positions along the toe and heading offsets, and cusps of the ways."""


def costs_at_poses(
    shared: tuple[Job, Standing, Float[Array, "a 4"]], at: _At
) -> tuple[Float[Array, "p a"], Float[Array, "p a"]]:
    """Cost and mass [tonne] of every action at every pose.

    What depends on the pose alone is computed once.
    """
    job, standing, actions = shared

    def at_pose(pose: Array, cusps: Cusps) -> tuple[Array, Array]:
        def one(action: Array) -> tuple[Array, Array]:
            found = next_load(job, standing, Decisions(pose[0], pose[1], action), cusps)
            return found.cost, found.performance.mass

        return jax.vmap(one)(actions)

    return jax.vmap(at_pose)(*at)


def rough_costs_at_poses(
    shared: tuple[Job, Standing, Float[Array, "a 4"]], at: _At
) -> tuple[Float[Array, "p a"], Float[Array, "p a"]]:
    """The same as the world foresees it roughly, if it can."""
    job, standing, actions = shared
    return costs_at_poses((job.replace(world=roughly(job.world)), standing, actions), at)


_costs_of_portions = ParallelMap(costs_at_poses)
_rough_costs = ParallelMap(rough_costs_at_poses)


def _portions(count: int, size: int) -> Int[np.ndarray, "portions size"]:
    """Rows in portions of one shape; the last row fills the last portion up.

    The number of poses follows from the length of the toe; if that were a shape, every next pile
    would be compiled for.
    """
    portions = -(-count // size)
    rows: np.ndarray = np.minimum(np.arange(portions * size), count - 1).reshape(portions, size)
    return rows


def quick_ways(job: Job, pile: Pile, positions: Float[np.ndarray, " p"]) -> Cusps:
    """Cusps of good ways from positions along the toe, square to it."""
    assert job.toe is not None
    # By portions, as below.
    rows = _portions(len(positions), 32).ravel()
    poses = jax.tree.map(
        lambda leaf: np.asarray(leaf)[: len(positions)],
        _square_to_toe(job.toe, pile, positions[rows]),
    )
    receivers = jax.tree.map(
        lambda leaf: np.broadcast_to(leaf, len(positions)), job.site.placed_receiver
    )
    return good_ways(pile, job.yard, job.site.machine, poses, receivers).cusps


@traced()
def _square_to_toe(toe: Toe, pile: Pile, positions: Float[Array, " p"]) -> Pose:
    poses: Pose = jax.vmap(lambda at: pose_at(toe, pile, at, jnp.zeros_like(at)))(positions)
    return poses


class _Load(NamedTuple):
    cost: float
    mass: float  # [tonne]


def _per_tonne(
    costs: Float[np.ndarray, "*n"], masses: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """What a tonne costs, infinite where there is none."""
    return np.where(masses > 0.0, costs / np.maximum(masses, 1e-6), np.inf)


def _spare(good: _Load, costs: Float[np.ndarray, " a"], masses: Float[np.ndarray, " a"]) -> float:
    """What a tonne less in a load saves, by the cheapest load from where the good one is."""
    cheapest = int(np.argmin(costs))
    less = good.mass - float(masses[cheapest])
    if less <= 0.0:
        return 0.0
    return min((good.cost - float(costs[cheapest])) / less, good.cost / good.mass)


def _outlook(good: _Load, full: _Load, spare: float, price: float = 0.0) -> Outlook:
    return Outlook(*(floats(np.asarray(number)) for number in (*good, *full, spare, price)))


@traced()
def _cost_and_mass(
    job: Job, standing: Standing, decisions: Decisions, cusps: Cusps
) -> tuple[Array, Array]:
    found = next_load(job, standing, decisions, cusps)
    return found.cost, found.performance.mass


def _scores(
    job: Job,
    standing: Standing,
    costs: Float[np.ndarray, "p a"],
    masses: Float[np.ndarray, "p a"],
    outlook: Outlook,
) -> Float[np.ndarray, "p a"]:
    """Cost of every action at every pose and of what is then left to do."""
    # Always about the same shape, see `_portions`.
    size = -(-costs.size // _BLOCK) * _BLOCK
    flat = (np.resize(values, size) for values in (costs, masses))
    found: np.ndarray = np.asarray(_scores_of(job, standing, *flat, outlook))
    return found[: costs.size].reshape(costs.shape)


@traced()
def _scores_of(
    job: Job, standing: Standing, costs: Array, masses: Array, outlook: Outlook
) -> Float[Array, " n"]:
    return jax.vmap(lambda cost, mass: score_of(job, standing, cost, mass, outlook))(costs, masses)


@traced(static_argnames=("steps", "rate"))
def refined_loads(
    job: Job,
    standing: Standing,
    starts: Decisions,
    known: tuple[Outlook, Cusps],
    *,
    steps: int,
    rate: float,
) -> tuple[Decisions, Float[Array, " k"]]:
    """Adam on single loadings, from several starts; returns the best visited of each.

    The ways keep their cusps, which move with the pose.
    """
    length = contour_length(job)
    outlook, cusps = known

    def score(variables: Decisions, cusps: Cusps) -> Array:
        # Metres along the contour, so that one rate suits all variables.
        decisions = variables.replace(position=variables.position / length)
        return score_of_next(job, standing, decisions, outlook, cusps)

    best, scores = descend(
        lambda variables: jax.vmap(jax.value_and_grad(score))(variables, cusps),
        starts.replace(position=starts.position * length),
        optax.adam(optax.cosine_decay_schedule(rate, steps)),
        steps,
    )
    return best.replace(position=best.position / length), scores
