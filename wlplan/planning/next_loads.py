"""The next load as a pure function: under `jit`, over many piles at once, or exported.

It makes the same search as `LoadSearch`, with fixed shapes. What stands there and where the truck
is are in the job; the toe is traced from the pile as it is.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from wlplan.actions import spread_actions
from wlplan.planning.amounts import Outlook
from wlplan.planning.driving import room_of
from wlplan.planning.job import Decisions, Job, Standing, beginning, contour_length, decided
from wlplan.planning.load_search import (
    LoadSearch,
    costs_at_poses,
    refined_loads,
    rough_costs_at_poses,
)
from wlplan.planning.loading import Transport
from wlplan.planning.poses import pose_at
from wlplan.planning.search import Cusps
from wlplan.planning.stepping import next_load as assessed_next
from wlplan.planning.traced_toe import traced_toe
from wlplan.planning.way import cusps_to
from wlplan.types import Action, Performance, Pose

_SEARCH = LoadSearch()
# Places along the toe that are tried at a time, and at most; on a longer one they lie wider apart.
_PORTION, _MOST = 8, 192


class NextLoad(NamedTuple):
    """The load to make next."""

    pose: Pose
    action: Action
    performance: Performance  # as the world foresees it
    transport: Transport
    cost: Float[Array, ""]  # infinite if there is nothing to dig


def best_next(job: Job, *, search: LoadSearch = _SEARCH, seed: int = 0) -> NextLoad:
    """The cheapest next load of a job, one of a number of loads.

    Pure: any leaf of the job may be traced, so it passes `jit` and `vmap`. It has no derivative.

    Args:
        job: World, pile, site with its receiver, objective and yard; its toe is traced anew.
        search: How loads are searched for.
        seed: Of the actions and poses that are tried.
    """
    toe, exists = traced_toe(job.pile, job.site.machine)
    job = job.replace(toe=toe, referee=None)
    standing, dtype = beginning(job), job.pile.height.dtype
    random = np.random.default_rng(seed)
    shift, actions = random.random(), spread_actions(search.actions, random, dtype)
    count = jnp.clip(jnp.round(search.poses_per_metre * contour_length(job)), 8, _MOST)
    at_once = _Portions(job, standing, actions, search, shift, count.astype(jnp.int32))
    tried = lax.fori_loop(0, -(-at_once.places // _PORTION), at_once.fill, at_once.empty())
    starts, cusps, costs = _starts(tried, actions, search)
    outlook = Outlook(*(jnp.zeros((), dtype) for _ in Outlook._fields))
    if search.refine_steps:
        starts, costs = refined_loads(
            job,
            standing,
            starts,
            (outlook, cusps),
            steps=search.refine_steps,
            rate=search.refine_rate,
        )
    row = jnp.argmin(jnp.nan_to_num(costs, nan=jnp.inf))
    one, known = jax.tree.map(lambda leaf: leaf[row], (starts, cusps))
    found = told(job, standing, one, known)
    return found._replace(cost=jnp.where(exists, found.cost, jnp.inf))


def told(job: Job, standing: Standing, decision: Decisions, cusps: Cusps) -> NextLoad:
    """What a next load comes to."""
    one = decided(job, standing, decision)
    found = assessed_next(job, standing, decision, cusps)
    return NextLoad(one.pose, one.action, found.performance, found.transport, found.cost)


class _Tried(NamedTuple):
    """Loads that could be made next, at up to P poses."""

    poses: Float[Array, "p 2"]  # positions along the toe, and heading offsets
    cusps: Any  # leaves [p, ...]
    costs: Float[Array, "p a"]  # infinite where there is none


class _Portions(NamedTuple):
    """Places along a toe, some of them at a time."""

    job: Job
    standing: Standing
    actions: Float[Array, "a 4"]
    search: LoadSearch
    shift: float
    places: Array  # how many

    def poses(self, number: Array | int) -> tuple[Array, Array]:
        """Positions of the places of a portion whose ways are searched for, and all its poses."""
        rows = number * _PORTION + np.arange(_PORTION)
        places = (jnp.minimum(rows, self.places - 1) + self.shift) / self.places
        places = places.astype(self.actions.dtype)
        offsets = jnp.asarray(self.search.offsets, places.dtype)
        pairs = jnp.stack(jnp.meshgrid(places, offsets, indexing="ij"), axis=-1)
        return places[:: self.search.neighbours], pairs.reshape(-1, 2)

    def tried(self, number: Array | int) -> _Tried:
        """A portion, evaluated."""
        searched, poses = self.poses(number)
        job, pile = self.job, self.standing.pile
        room, machine = room_of(job.yard, pile), job.site.machine

        def way(position: Array) -> Cusps:
            assert job.toe is not None
            pose = pose_at(job.toe, pile, position, jnp.zeros_like(position))
            return cusps_to(pose, job.site.placed_receiver, room, machine, thorough=False)

        of_pose = np.arange(len(poses)) // (self.search.neighbours * len(self.search.offsets))
        cusps = jax.tree.map(lambda leaf: leaf[of_pose], jax.vmap(way)(searched))
        look = rough_costs_at_poses if self.search.refine_steps else costs_at_poses
        costs, _ = look((job, self.standing, self.actions), (poses, cusps))
        return _Tried(poses, cusps, jnp.nan_to_num(costs, nan=jnp.inf, posinf=jnp.inf))

    def empty(self) -> _Tried:
        """No portion evaluated yet."""
        shapes = jax.eval_shape(self.tried, 0)
        portions = math.ceil(_MOST / _PORTION)
        none: _Tried = jax.tree.map(
            lambda leaf: jnp.zeros((portions * leaf.shape[0], *leaf.shape[1:]), leaf.dtype), shapes
        )
        return none._replace(costs=jnp.full_like(none.costs, jnp.inf))

    def fill(self, number: Array, tried: _Tried) -> _Tried:
        """One portion more."""
        found = self.tried(number)
        size = len(found.poses)
        filled: _Tried = jax.tree.map(
            lambda all_, some: lax.dynamic_update_slice_in_dim(all_, some, number * size, axis=0),
            tried,
            found,
        )
        return filled


def _starts(
    tried: _Tried, actions: Array, search: LoadSearch
) -> tuple[Decisions, Any, Float[Array, " k"]]:
    """The best few poses, each with its best action."""
    best = tried.costs.min(axis=1)
    _, rows = lax.top_k(-best, search.refined)
    starts = Decisions(
        position=tried.poses[rows, 0],
        offset=tried.poses[rows, 1],
        action=actions[tried.costs.argmin(axis=1)[rows]],
    )
    return starts, jax.tree.map(lambda leaf: leaf[rows], tried.cusps), best[rows]
