"""Diggability maps: what one fixed action would yield all around a pile. Paper, section 7.4."""

from __future__ import annotations

from typing import no_type_check

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from wlplan.checks import check_action, check_pile, check_world
from wlplan.terrain.toe import ToeContour, edge_poses, toe_contour
from wlplan.types import Action, Performance, Pile, Pose, PyTree, World
from wlplan.worlds.capabilities import as_pytree, can, foresee

# The action of the paper's diggability map. Paper, section 7.4.
PAPER_ACTION = Action(0.68, 4.51, 0.17, 4.46)


@no_type_check
class DiggabilityMap(struct.PyTreeNode):
    """Dig poses around a pile and the performance predicted at each, leaves [n]."""

    pose: Pose
    performance: Performance


def diggability_map(
    world: World,
    pile: Pile,
    *,
    locations: int = 150,
    action: Action = PAPER_ACTION,
    contour: ToeContour | None = None,
) -> DiggabilityMap:
    """Predict one action at evenly spaced locations around the toe, all in one batched call.

    Each location digs the pile as it stands, along the inward normal.

    Args:
        world: Simulator or learned model.
        pile: One pile, not a batch.
        locations: Number of dig locations.
        action: Action at every location, scalar leaves.
        contour: Toe of the pile, where it is known already; by default it is traced.

    Raises:
        InputError: If the world is a name, the action is outside its box, there is nothing to dig,
            or a bucket can start nowhere on the toe.
    """
    check_world(world)
    check_pile(pile)
    check_action(action)
    contour = toe_contour(pile) if contour is None else contour
    pose = edge_poses(contour, locations)
    dtype = pile.height.dtype
    pose = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), pose)
    action = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), action)
    return DiggabilityMap(pose, _predict(as_pytree(world), pile, pose, action))


def stalls_on_map(
    world: World, pile: Pile, found: DiggabilityMap, action: Action = PAPER_ACTION
) -> Float[Array, " n"] | None:
    """How likely each location of a map stalls; None if the world does not know.

    Args:
        world: That predicted the map.
        pile: That it is of.
        found: The map.
        action: At every location.
    """
    if not can(world, "stall_probability"):
        return None
    likely: Array = _stalls(as_pytree(world), pile, found.pose, action)
    return likely


@jax.jit
def _stalls(world: PyTree, pile: Pile, pose: Pose, action: Action) -> Array:
    dtype = pile.height.dtype
    action = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), action)
    found: Array = jax.vmap(lambda one: world.stall_probability(pile, one, action))(pose)
    return found


@jax.jit
def _predict(world: PyTree, pile: Pile, pose: Pose, action: Action) -> Performance:
    predicted: Performance = jax.vmap(lambda one: foresee(world, pile, one, action))(pose)
    return predicted
