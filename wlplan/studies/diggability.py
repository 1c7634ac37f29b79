"""Diggability maps: what one fixed action would yield all around a pile. Paper, section 7.4."""

from __future__ import annotations

import math
from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.tree_util import Partial
from jaxtyping import Float

from wlplan.errors import InputError
from wlplan.terrain.toe import ToeContour, toe_contour
from wlplan.types import Action, Performance, Pile, Pose, PyTree, World

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

    Each location digs the pile as it stands, along the inward normal. Only the performance is
    computed: XLA removes the piles after, which nobody reads.

    Args:
        world: Simulator or learned model.
        pile: One pile, not a batch.
        locations: Number of dig locations.
        action: Action at every location, scalar leaves.
        contour: Toe of the pile, where it is known already; by default it is traced.

    Raises:
        InputError: If there is nothing to dig, or a bucket can start nowhere on the toe.
    """
    contour = toe_contour(pile) if contour is None else contour
    pose = edge_poses(contour, locations)
    dtype = pile.height.dtype
    pose = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), pose)
    action = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), action)
    # A plain function becomes a pytree without leaves, so that both kinds of World can be passed.
    model = Partial(world) if jax.tree_util.all_leaves([world]) else world
    return DiggabilityMap(pose=pose, performance=_predict(model, pile, pose, action))


@jax.jit
def _predict(world: PyTree, pile: Pile, pose: Pose, action: Action) -> Performance:
    return jax.vmap(lambda one: world(pile, one, action)[1])(pose)


def edge_poses(contour: ToeContour, locations: int) -> Pose:
    """Poses evenly spaced by arc length over the accessible part of a toe, heading inward.

    Args:
        contour: Toe of a pile.
        locations: Number of poses; more than the contour has points are interpolated.

    Raises:
        InputError: If the number is not positive, or no point of the contour is accessible.
    """
    if locations < 1:
        raise InputError(f"{locations} dig locations asked for: ask for at least one.")
    points = np.flatnonzero(contour.accessible)
    if points.size == 0:
        raise InputError(
            "A bucket can start nowhere on the toe of this pile: it lies on unseen ground or at "
            "the edge of the map; scan a wider area around the pile."
        )
    # Every accessible point stands for one step of the contour, half before it and half after.
    place = (np.arange(locations) + 0.5) * points.size / locations
    nearest = points[np.floor(place).astype(int)]
    offset = place % 1.0 - 0.5
    neighbour = nearest + np.where(offset < 0.0, -1, 1)
    count = len(contour.heading)
    neighbour = neighbour % count if contour.closed else np.clip(neighbour, 0, count - 1)
    weight = np.where(contour.accessible[neighbour], np.abs(offset), 0.0)

    def between(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        return (1.0 - weight) * values[nearest] + weight * values[neighbour]

    heading = np.arctan2(between(np.sin(contour.heading)), between(np.cos(contour.heading)))
    # Between two points of an open contour's ends, or of a cusp, the headings may cancel.
    smooth = np.abs(_turn(contour.heading[nearest], contour.heading[neighbour])) < 0.5 * math.pi
    return Pose(
        x=between(contour.points[:, 0]),
        y=between(contour.points[:, 1]),
        heading=np.where(smooth, heading, contour.heading[nearest]),
    )


def _turn(start: Float[np.ndarray, " n"], end: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Angle from one heading to another [rad], -pi to pi."""
    return (end - start + math.pi) % (2.0 * math.pi) - math.pi
