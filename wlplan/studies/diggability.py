"""Diggability maps: what one fixed action would yield all around a pile. Paper, section 7.4."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from wlplan.checks import check_action, check_pile, check_world
from wlplan.planning.loading import Transport
from wlplan.terrain.toe import ToeContour
from wlplan.terrain.toes import poses_around, toes_of
from wlplan.types import Action, Performance, Pile, Pose, PyTree, World
from wlplan.worlds.capabilities import as_pytree, can, foresee
from wlplan.xla import on_device

# The action of the paper's diggability map. Paper, section 7.4.
PAPER_ACTION = Action(0.68, 4.51, 0.17, 4.46)
_SECONDS_PER_HOUR = 3600.0


@no_type_check
class DiggabilityMap(struct.PyTreeNode):
    """Dig poses around a pile and the performance predicted at each, leaves [n].

    An optimised map says more: the action of each location, the driving to the receiver, if there
    is one, and what the loading costs.
    """

    pose: Pose
    performance: Performance
    action: Action | None = None
    transport: Transport | None = None
    cost: Float[Array, " n"] | None = None

    @property
    def rate(self) -> Float[np.ndarray, " n"]:
        """What a loader moves from there [t/h], driving to the receiver included where known."""
        mass, time = (np.asarray(getattr(self.performance, q), float) for q in ("mass", "time"))
        driving = 0.0 if self.transport is None else np.asarray(self.transport.time, float)
        rate: np.ndarray = _SECONDS_PER_HOUR * mass / np.maximum(time + driving, 1e-9)
        return rate


def diggability_map(
    world: World,
    pile: Pile,
    *,
    locations: int = 150,
    action: Action = PAPER_ACTION,
    contour: ToeContour | Sequence[ToeContour] | None = None,
) -> DiggabilityMap:
    """Predict one action at evenly spaced locations around the toe, all in one batched call.

    Each location digs the pile as it stands, along the inward normal.

    Args:
        world: Simulator or learned model.
        pile: One pile, or several on one map; not a batch.
        locations: Number of dig locations; of several piles, shared out by the lengths of the toes.
        action: Action at every location, scalar leaves.
        contour: Toe of the pile, or several, where they are known already; by default the toes of
            all piles of the map are traced.

    Raises:
        InputError: If the world is a name, the action is outside its box, there is nothing to dig,
            or a bucket can start nowhere on the toe.
    """
    check_world(world)
    check_pile(pile)
    check_action(action)
    pose = located(pile, locations, contour)
    action = jax.tree.map(lambda leaf: jnp.asarray(leaf, pile.height.dtype), action)
    return DiggabilityMap(pose, _predict(as_pytree(world), pile, pose, action))


def located(pile: Pile, locations: int, contour: ToeContour | Sequence[ToeContour] | None) -> Pose:
    """The poses of a map, leaves [n]; arguments as of `diggability_map`."""
    if contour is None:
        contour = [toe.contour for toe in toes_of(pile)]
    contours = [contour] if isinstance(contour, ToeContour) else contour
    pose, _ = poses_around(contours, locations)
    dtype = pile.height.dtype
    placed: Pose = jax.tree.map(lambda leaf: on_device(np.asarray(leaf, dtype)), pose)
    return placed


class Foreseen(NamedTuple):
    """What a world says of each location beside its outcome; None where it does not know."""

    stall_probability: Float[Array, " n"] | None  # [1]
    deviation: Performance | None  # of the error, standard, leaves [n] [tonne, s, kJ]


def foreseen_on_map(
    world: World, pile: Pile, found: DiggabilityMap, action: Action = PAPER_ACTION
) -> Foreseen:
    """How likely each location of a map stalls, and how far off its prediction may be.

    Args:
        world: That predicted the map.
        pile: That it is of.
        found: The map.
        action: At every location, unless the map has one for each.
    """
    dtype, count = pile.height.dtype, len(found.pose.x)
    action = action if found.action is None else found.action
    at = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, dtype), count), action)
    known: Foreseen = _foreseen(as_pytree(world), pile, found.pose, at)
    return known


@jax.jit
def _foreseen(world: PyTree, pile: Pile, pose: Pose, action: Action) -> Foreseen:
    def known(name: str) -> PyTree:
        if not can(world, name):
            return None
        return jax.vmap(lambda *at: getattr(world, name)(pile, *at))(pose, action)

    return Foreseen(known("stall_probability"), known("uncertainty"))


@jax.jit
def _predict(world: PyTree, pile: Pile, pose: Pose, action: Action) -> Performance:
    predicted: Performance = jax.vmap(lambda one: foresee(world, pile, one, action))(pose)
    return predicted
