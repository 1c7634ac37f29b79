"""What the locations of a diggability map cost: digging alone, or with the driving to a truck."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from wlplan.planning.amounts import Loads
from wlplan.planning.driving import Room, room_of
from wlplan.planning.good_ways import good_ways
from wlplan.planning.job import Job, check_knows_enough
from wlplan.planning.lane import lane_touching
from wlplan.planning.loading import Loading, Transport
from wlplan.planning.objective import Objective, objective_of
from wlplan.planning.search import Cusps
from wlplan.planning.transport import transport
from wlplan.planning.yard import yard_of
from wlplan.site.frame import LOCAL
from wlplan.site.site import Site
from wlplan.studies.diggability import PAPER_ACTION, DiggabilityMap
from wlplan.types import Action, Performance, Pile, Pose, World
from wlplan.worlds.capabilities import as_pytree


def job_of(
    world: World,
    pile: Pile,
    site: Site,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any],
) -> Job:
    """What every location is judged by; a site without a receiver stays without.

    Args:
        world: That predicts.
        pile: That is mapped.
        site: Machine, and where loads go, if that is known.
        objective: Whatever planners take.

    Raises:
        InputError: If the objective is none, or the world does not know what it needs.
    """
    job = Job(
        world=as_pytree(world),
        pile=pile,
        site=site.replace(frame=LOCAL, keep_out=None, truck_area=None),
        objective=objective_of(objective),
        yard=yard_of(pile, site.machine, site.keep_out),
        amount=Loads(1),
    )
    check_knows_enough(job)
    return job


def cusps_of(job: Job, poses: Pose) -> Cusps | None:
    """Cusps of good ways from each of several poses to the receiver, if there is one."""
    if job.site.receiver is None:
        return None
    receivers = jax.tree.map(
        lambda leaf: np.broadcast_to(np.asarray(leaf), len(poses.x)), job.site.receiver
    )
    return good_ways(job.pile, job.yard, job.site.machine, poses, receivers).cusps


def room_around(job: Job) -> Room | None:
    """Room to drive, if there is anywhere to drive to."""
    return None if job.site.receiver is None else room_of(job.yard, job.pile)


class Judged(NamedTuple):
    """The driving of one loading, and what it costs."""

    transport: Transport  # without a receiver: of the lane alone
    cost: Array


def judged(
    job: Job,
    room: Room | None,
    loading: tuple[Pose, Action, Performance],
    cusps: Cusps | None,
) -> Judged:
    """Judges one loading on the pile of a job.

    Args:
        job: As of `job_of`.
        room: As of `room_around`.
        loading: Pose, action and what they yield.
        cusps: As of `cusps_of`, of one pose.
    """
    pose, action, performance = loading
    if room is None:
        nothing = jnp.zeros_like(performance.mass)
        lane = lane_touching(pose, None, job.pile, job.yard, job.site.machine)
        carried = Transport(nothing, nothing, lane)
    else:
        carried, _ = transport(
            job.pile, pose, performance.mass, job.site, room, cusps=cusps, thorough=False
        )
    seen = Loading(job.pile, pose, action, performance, carried, job.site, job.world)
    return Judged(carried, job.objective(seen))


def with_driving(
    world: World,
    pile: Pile,
    found: DiggabilityMap,
    site: Site,
    *,
    action: Action = PAPER_ACTION,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = "efficiency",
) -> DiggabilityMap:
    """A map with the driving to the receiver, and what each cycle costs.

    The ways are good ones, as planners use while they search.

    Args:
        world: That predicted the map.
        pile: That it is of.
        found: The map.
        site: With its receiver.
        action: At every location, unless the map has one for each.
        objective: What a cycle costs.

    Raises:
        InputError: As `job_of`.
    """
    job = job_of(world, pile, site, objective)
    dtype, count = pile.height.dtype, len(found.pose.x)
    action = action if found.action is None else found.action
    at = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, dtype), count), action)
    costs = _judged_all(job, (found.pose, at, found.performance), cusps_of(job, found.pose))
    carried = None if site.receiver is None else costs.transport
    return found.replace(action=at, transport=carried, cost=costs.cost)


@jax.jit
def _judged_all(
    job: Job, loadings: tuple[Pose, Action, Performance], cusps: Cusps | None
) -> Judged:
    room = room_around(job)
    return jax.vmap(lambda one, way: judged(job, room, one, way))(loadings, cusps)
