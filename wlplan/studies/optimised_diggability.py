"""Diggability maps at the locally best heading and action.

The paper's map has one action everywhere, along the inward normal; it "can be further improved by
searching also for the locally optimal heading and loading action". Paper, section 7.4.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float

from wlplan.actions import spread_actions, squash
from wlplan.checks import check_action, check_pile, check_world
from wlplan.errors import InputError
from wlplan.parallel import ParallelMap
from wlplan.planning.descent import descend
from wlplan.planning.job import Job, can_refine
from wlplan.planning.loading import Loading
from wlplan.planning.objective import Objective
from wlplan.planning.objectives import OBJECTIVES
from wlplan.planning.poses import MAX_OFFSET
from wlplan.planning.search import Cusps
from wlplan.site.site import Site
from wlplan.studies.diggability import PAPER_ACTION, DiggabilityMap, located
from wlplan.studies.map_costs import Judged, cusps_of, job_of, judged, room_around
from wlplan.terrain.toe import ToeContour
from wlplan.types import Action, Performance, Pile, Pose, World, action_from, action_vector
from wlplan.worlds.capabilities import foresee

# Load below which time / mass is held finite [tonne], as in the terms of the planners.
_LEAST_MASS = 0.1
# Locations that one core searches at a time.
_PORTION = 15


@dataclasses.dataclass(frozen=True)
class TimePerTonne:
    """(T / T0) / (M / M0): the time that a tonne takes, driving included, over a typical one [1].

    Its inverse is the rate. The references are those of `wlplan.planning.terms`.
    """

    time: float = 46.3  # [s]
    mass: float = 4.29  # [tonne]

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        performance, carried = loading.performance, loading.transport
        tonnes = jnp.sqrt(performance.mass**2 + _LEAST_MASS**2) / self.mass
        return (performance.time + carried.time + carried.wait) / self.time / tonnes


RATE = Objective({"rate": TimePerTonne(), "touching": OBJECTIVES["efficiency"]["touching"]})
"""Tonnes an hour, and room to drive up; what a map goes by if nothing else is asked for."""


@dataclasses.dataclass(frozen=True)
class LocalSearch:
    """How the best heading and action of a location are searched for.

    Actions that fill their box are tried at some headings, and the fixed one. The best of the best
    few headings are refined by Adam. In a world without a derivative nothing is refined.
    """

    offsets: tuple[float, ...] = (0.0,)  # of the heading, before squashing
    actions: int = 24
    refined: int = 1  # headings whose best is refined
    steps: int = 20
    rate: float = 0.5


@no_type_check
class OptimisedMap(struct.PyTreeNode):
    """What the best heading and action of each location yield, beside one action everywhere."""

    best: DiggabilityMap
    fixed: DiggabilityMap  # the same locations, along the inward normal
    offset: Float[Array, " n"]  # of the best heading from the inward normal [rad]

    @property
    def gain(self) -> Float[np.ndarray, " n"]:
        """By how much the fixed action costs more than the best [%]; of `RATE`: more t/h."""
        best, fixed = (np.asarray(one.cost, float) for one in (self.best, self.fixed))
        gain: np.ndarray = 100.0 * (fixed / best - 1.0)
        return gain


def optimised_map(
    world: World,
    pile: Pile,
    *,
    locations: int = 150,
    action: Action = PAPER_ACTION,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = RATE,
    site: Site | None = None,
    search: LocalSearch | None = None,
    seed: int = 0,
    contour: ToeContour | Sequence[ToeContour] | None = None,
) -> OptimisedMap:
    """The best heading and action at evenly spaced locations around the toe, by gradient.

    Each location digs the pile as it stands. The bucket goes in at the same point as in
    `diggability_map`; its heading is at most `MAX_OFFSET` off the inward normal, and the action
    stays in its box. The best is never worse than the fixed action, by the objective, and a local
    optimum otherwise.

    Args:
        world: Simulator or learned model.
        pile: One pile, or several on one map; not a batch.
        locations: As of `diggability_map`.
        action: The fixed action that it is compared with.
        objective: What is best: by default the rate in t/h; or whatever planners take.
        site: Machine, and where loads go: with a receiver the driving there counts, without one
            digging alone.
        search: How it is searched for.
        seed: Of the actions that are tried.
        contour: As of `diggability_map`.

    Raises:
        InputError: As `diggability_map`, or if the world does not know what the objective needs.
    """
    return optimised_maps(
        world,
        [pile],
        locations=locations,
        action=action,
        objective=objective,
        site=site,
        search=search,
        seed=seed,
        contours=None if contour is None else [contour],
    )[0]


def optimised_maps(
    world: World,
    piles: Sequence[Pile],
    *,
    locations: int = 150,
    action: Action = PAPER_ACTION,
    objective: str | Objective | Mapping[str, Any] | Callable[..., Any] = RATE,
    site: Site | None = None,
    search: LocalSearch | None = None,
    seed: int = 0,
    contours: Sequence[ToeContour | Sequence[ToeContour]] | None = None,
) -> list[OptimisedMap]:
    """`optimised_map` of many maps of one size, all in one call of one program.

    Args:
        world: As there.
        piles: Maps with as many cells of the same size.
        locations: On each.
        action: As there.
        objective: As there.
        site: As there; of all of them.
        search: As there.
        seed: As there.
        contours: Toes of each pile, where they are known already.

    Raises:
        InputError: As there, or if the maps differ in size or there is none.
    """
    check_world(world)
    check_action(action)
    _check_sizes(piles)
    for pile in piles:
        check_pile(pile)
    search = LocalSearch() if search is None else search
    site = Site() if site is None else site
    # What differs in kind among maps would be compiled for.
    bare = [pile.replace(ground=pile.floor, valid=None) for pile in piles]
    jobs = [job_of(world, pile, site, objective) for pile in bare]
    job = jobs[0]
    steps = search.steps if can_refine(job, search.steps) else 0
    toes = [None] * len(piles) if contours is None else contours
    poses = [located(pile, locations, toe) for pile, toe in zip(piles, toes, strict=True)]
    cusps = [cusps_of(*one) for one in zip(jobs, poses, strict=True)]
    dtype = bare[0].height.dtype
    task = _Task(
        job=job.replace(pile=None, yard=None),
        actions=spread_actions(search.actions, np.random.default_rng(seed), dtype),
        fixed=jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), action),
        search=dataclasses.replace(search, steps=steps),
    )
    # A row is a portion of the locations of one pile; the last one fills the last portion up.
    portions = -(-locations // _PORTION)
    rows = np.minimum(np.arange(portions * _PORTION), locations - 1).reshape(portions, _PORTION)
    maps = np.repeat(np.arange(len(piles)), portions)
    of_maps = _stacked([(one.pile, one.yard) for one in jobs])
    of_places = _stacked(list(zip(poses, cusps, strict=True)))
    found = _of_portions(
        task,
        (
            jax.tree.map(lambda leaf: leaf[maps], of_maps),
            jax.tree.map(
                lambda leaf: leaf[:, rows].reshape(-1, _PORTION, *leaf.shape[2:]), of_places
            ),
        ),
    )
    return [
        jax.tree.map(
            lambda leaf, k=k: np.asarray(leaf).reshape(len(piles), -1, *leaf.shape[2:])[k][
                :locations
            ],
            found,
        )
        for k in range(len(piles))
    ]


def _check_sizes(piles: Sequence[Pile]) -> None:
    if not piles:
        raise InputError("no pile to map: give at least one.")
    sizes = {(tuple(np.shape(pile.height)), pile.cell_size) for pile in piles}
    if len(sizes) > 1:
        raise InputError(
            "the maps of the piles differ in their cells: give maps of one size, or map them one "
            "by one."
        )


def _stacked(members: Sequence[Any]) -> Any:
    """Pytrees as one along a new leading axis, by numpy, which compiles nothing."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *members)


@no_type_check
class _Task(struct.PyTreeNode):
    """What is asked of every location."""

    job: Job  # without its pile and its yard
    actions: Float[Array, "a 4"]  # that are tried, before squashing
    fixed: Action
    search: LocalSearch = struct.field(pytree_node=False)


def _turned(anchor: Pose, offset: Float[Array, ""]) -> Pose:
    """The pose at a location, with a heading offset before squashing."""
    turned: Pose = anchor.replace(heading=anchor.heading + MAX_OFFSET * jnp.tanh(offset))
    return turned


def _of_portion(task: _Task, row: tuple[Any, Any]) -> OptimisedMap:
    """The map of some locations, leaves [p]."""
    (pile, yard), (anchors, cusps) = row
    job, search = task.job.replace(pile=pile, yard=yard), task.search
    room = room_around(job)

    def dug(pose: Pose, action: Action, cusps: Cusps | None) -> tuple[Performance, Judged]:
        performance = foresee(job.world, job.pile, pose, action)
        return performance, judged(job, room, (pose, action, performance), cusps)

    def cost(raw: Array, anchor: Pose, cusps: Cusps | None) -> Array:
        return dug(_turned(anchor, raw[0]), squash(raw[1:]), cusps)[1].cost

    def mapped(poses: Pose, actions: Action) -> DiggabilityMap:
        performance, (carried, costs) = jax.vmap(dug)(poses, actions, cusps)
        driving = None if room is None else carried
        return DiggabilityMap(poses, performance, actions, driving, costs)

    fixed_actions = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, anchors.x.shape), task.fixed)
    fixed = mapped(anchors, fixed_actions)
    starts, at_start, where = _starts(task, cost, (anchors, cusps))
    if search.steps == 0:
        best, costs = starts, at_start
    else:
        there = jax.tree.map(lambda leaf: leaf[where], (anchors, cusps))
        best, costs = descend(
            lambda raw: jax.vmap(jax.value_and_grad(cost))(raw, *there),
            starts,
            optax.adam(optax.cosine_decay_schedule(search.rate, search.steps)),
            search.steps,
        )
    count = len(anchors.x)
    each = _number_or_infinity(costs).reshape(count, -1)
    raw = best.reshape(count, -1, 5)[jnp.arange(count), each.argmin(axis=1)]
    better = each.min(axis=1) < jnp.asarray(fixed.cost)
    offset = jnp.where(better, MAX_OFFSET * jnp.tanh(raw[:, 0]), 0.0)
    found = action_vector(jax.vmap(squash)(raw[:, 1:]))
    chosen = action_from(jnp.where(better[:, None], found, action_vector(fixed_actions)))
    heading = anchors.heading + offset
    over = jnp.where(jnp.abs(heading) > np.pi, jnp.sign(heading), 0.0)
    poses = anchors.replace(heading=heading - 2.0 * np.pi * over)
    return OptimisedMap(mapped(poses, chosen), fixed, offset)


def _starts(
    task: _Task, cost: Callable[..., Array], places: tuple[Pose, Cusps | None]
) -> tuple[Float[Array, "s 5"], Float[Array, " s"], Array]:
    """Where to descend from: heading offset and action before squashing, their costs and places.

    What depends on the pose alone is computed once for all actions.
    """
    offsets = jnp.asarray(task.search.offsets, task.actions.dtype)

    def at_place(anchor: Pose, cusps: Cusps | None) -> Array:
        def one(offset: Array, action: Array) -> Array:
            return cost(jnp.concatenate([offset[None], action]), anchor, cusps)

        return jax.vmap(lambda offset: jax.vmap(lambda action: one(offset, action))(task.actions))(
            offsets
        )

    costs = _number_or_infinity(jax.vmap(at_place)(*places))
    # The best action of each heading, of the best few headings: starts that are apart.
    least, which = costs.min(axis=2), costs.argmin(axis=2)
    order = jnp.argsort(least, axis=1)[:, : task.search.refined]
    place = jnp.arange(len(costs))[:, None]
    raw = jnp.concatenate([offsets[order][..., None], task.actions[which[place, order]]], axis=-1)
    where = jnp.repeat(jnp.arange(len(costs)), order.shape[1])
    return raw.reshape(-1, 5), least[place, order].reshape(-1), where


def _number_or_infinity(costs: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Costs, infinite where they are none."""
    return jnp.where(jnp.isnan(costs), jnp.inf, costs)


_of_portions = ParallelMap(_of_portion)
