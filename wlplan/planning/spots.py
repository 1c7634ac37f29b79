"""Where the truck stands, chosen by what loads cost with it there.

A spot is judged by the loads that are best with it: of digs all along the toe, each with its best
action, those that cost least a tonne, the way to the truck included. What a dig yields does not
depend on the truck, so it is computed once. A spot has to have room for the truck, in its area.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.actions import spread_actions, squash
from wlplan.parallel import ParallelMap
from wlplan.planning.job import Job, beginning
from wlplan.planning.loading import Loading, Transport
from wlplan.planning.placement import (
    Closed,
    TruckArea,
    cost_of_truck,
    not_for_trucks,
    places_around,
    receiver_at,
    truck_stands_on,
    way_lengths,
    where_allowed,
)
from wlplan.planning.playing import assess, counting
from wlplan.planning.watch import Watch
from wlplan.site.receiver import Receiver
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import LoadingPlan, Pose
from wlplan.worlds.capabilities import foresee

# Digs along the toe, actions at each, and by how many digs, the best, a spot is judged, of so many
# that are looked at.
_DIGS, _ACTIONS, _BEST, _LOOKED_AT = 32, 24, 4, 6
# Spots whose ways are looked at, those that the shortest ways make the best; and of how many, apart
# from each other by so much [m], plans are made.
_SPOTS, _PORTION = 48, 8
TRIED, _APART = 3, 3.0
# Time and work of a way while nothing is known of the truck [s], [kJ].
_TYPICAL = (20.0, 350.0)


def best_spots(
    job: Job,
    *,
    seed: int,
    watch: Watch,
    closed: Closed = None,
    area: TruckArea = None,
) -> list[Receiver]:
    """The best spots, the very best first.

    Args:
        job: World, pile, site, objective and yard; its receiver plays no part.
        seed: Of the actions that are tried.
        watch: Told what it took.
        closed: Cells of the pile's grid that nothing may drive on.
        area: Polygons that trucks may stand in.

    Raises:
        InputError: If a bucket can start nowhere, or there is no room in the area.
    """
    pile, machine = job.pile, job.site.machine
    dtype = pile.height.dtype
    digs = edge_poses(toe_contour(pile, machine=machine), _DIGS)
    poses = np.stack([np.asarray(v, float) for v in (digs.x, digs.y, digs.heading)], axis=-1)
    actions = spread_actions(_ACTIONS, np.random.default_rng(seed), dtype)
    costs, longer, masses = (
        np.asarray(leaf, float) for leaf in _yields((job, actions), jnp.asarray(poses, dtype))
    )
    watch.spend(look=costs.size)
    per_tonne = np.where(masses > 0.0, costs / np.maximum(masses, 1e-3), np.inf)
    best = per_tonne.argmin(axis=1)
    value = per_tonne.min(axis=1)

    places = where_allowed(places_around(digs), pile, machine, closed, area)
    truck = cost_of_truck(places, pile, machine, closed)
    on, _ = truck_stands_on(places, pile, not_for_trucks(pile, closed), machine)
    if not on.all():
        truck = np.where(on == 0.0, truck, np.inf)
    # What a metre of way costs a tonne.
    metre = float(np.median((longer - costs).mean(axis=1) / np.maximum(masses.max(axis=1), 1e-3)))
    apart = np.hypot(*(places[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
    digs_of = np.argsort(value[None] + metre * apart, axis=1)[:, :_LOOKED_AT]
    lengths = np.asarray(
        way_lengths(jnp.asarray(places, dtype), jnp.asarray(poses[digs_of], dtype), machine)
    )
    each = np.sort(value[digs_of] + metre * lengths, axis=1)
    bound = each[:, :_BEST].mean(axis=1) + metre * truck
    order = np.argsort(bound)[:_SPOTS]
    order = order[np.isfinite(bound[order])]
    rows = np.resize(order, (-(-len(order) // _PORTION), _PORTION))
    found = _costs_of_spots(
        job,
        (
            jnp.asarray(places[rows], dtype),
            jnp.asarray(poses[digs_of[rows]], dtype),
            actions[best[digs_of[rows]]],
        ),
    )
    cost, mass = (np.asarray(leaf, float).reshape(-1, _LOOKED_AT)[: len(order)] for leaf in found)
    watch.spend(look=cost.size, quick_way=cost.size)
    each = np.sort(np.where(mass > 0.0, cost / np.maximum(mass, 1e-3), np.inf), axis=1)
    scores = each[:, :_BEST].mean(axis=1) + metre * truck[order]
    chosen: list[np.ndarray] = []
    for row in order[np.argsort(scores)]:
        if all(np.hypot(*(places[row, :2] - other[:2])) > _APART for other in chosen):
            chosen.append(places[row])
    return [receiver_at(place, pile) for place in chosen[:TRIED]]


def at_receiver(job: Job, receiver: Receiver) -> Job:
    """A job whose truck stands somewhere else."""
    moved: Job = job.replace(site=job.site.replace(receiver=receiver))
    return moved


def _yields_of(
    shared: tuple[Job, Float[Array, "a 4"]], pose: Float[Array, "3"]
) -> tuple[Float[Array, " a"], Float[Array, " a"], Float[Array, " a"]]:
    """Loads with each action: cost with a typical way, with a metre more, and mass [tonne]."""
    job, actions = shared
    time, work = (jnp.asarray(value, pose.dtype) for value in _TYPICAL)
    more = 2.0 / job.site.machine.travel_speed

    def one(raw: Array) -> tuple[Array, Array, Array]:
        dig, action = Pose(*pose), squash(raw)
        performance = foresee(job.world, job.pile, dig, action)
        ways = Transport(time, work), Transport(time + more, work)
        near, far = (
            job.objective(Loading(job.pile, dig, action, performance, way, job.site, job.world))
            for way in ways
        )
        return near, far, performance.mass

    return jax.vmap(one)(actions)


def _costs_of_some(
    job: Job, spots: tuple[Float[Array, "n 3"], Float[Array, "n m 3"], Float[Array, "n m 4"]]
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """Cost and mass [tonne] of loads for receivers, each from digs with their actions."""

    def one(place: Array, pose: Array, action: Array) -> tuple[Array, Array]:
        at = at_receiver(job, Receiver(*place))
        loading = LoadingPlan(Pose(*pose), squash(action))
        performance = foresee(job.world, job.pile, loading.pose, loading.action)
        stays = jnp.zeros((), bool)
        standing = beginning(at)
        assessed, _ = assess(
            counting(at), standing, loading, performance, leaves=stays, thorough=False
        )
        return assessed.cost, performance.mass

    return jax.vmap(jax.vmap(one, in_axes=(None, 0, 0)))(*spots)


_yields, _costs_of_spots = ParallelMap(_yields_of), ParallelMap(_costs_of_some)
