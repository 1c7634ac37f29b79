"""The toes of all piles of a map, each traced with the others in its way."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from wlplan.checks import check_pile
from wlplan.errors import InputError
from wlplan.site.machine import WA320, WheelLoader
from wlplan.terrain.outlines import SMALLEST_VOLUME
from wlplan.terrain.parts import Part, find_parts
from wlplan.terrain.toe import TOE_RISE, ToeContour, edge_poses, toe_contour
from wlplan.types import Pile, Pose
from wlplan.xla import on_device


@dataclasses.dataclass(frozen=True)
class PileToe:
    """One pile of a map and its toe."""

    part: Part
    contour: ToeContour


def toes_of(
    pile: Pile,
    *,
    rise: float = TOE_RISE,
    machine: WheelLoader = WA320,
    smallest: float = SMALLEST_VOLUME,
) -> tuple[PileToe, ...]:
    """The toes of all piles of a map that a bucket can dig, the largest pile first.

    While one is traced, the others are ground: a bucket does not drive up through them.

    Args:
        pile: The map, not a batch.
        rise: As of `toe_contour`.
        machine: Likewise.
        smallest: Likewise.

    Raises:
        InputError: As `toe_contour`, if there is none.
    """
    check_pile(pile)
    height, floor = (np.asarray(leaf, np.float64) for leaf in (pile.height, pile.floor))
    origin = np.asarray(pile.origin, np.float64)
    labels, parts = find_parts(height - floor, pile.cell_size, origin, rise=rise, smallest=smallest)
    found = []
    for part in parts:
        others = np.isin(labels, [other.number for other in parts if other is not part])
        ground = np.where(others, height, floor).astype(pile.height.dtype)
        # Where there are no others, it is the pile itself.
        alone = pile.replace(ground=on_device(ground)) if others.any() else pile
        try:
            contour = toe_contour(alone, rise=rise, machine=machine, smallest=smallest)
        except InputError:
            # Too narrow for the bucket: nothing to dig, where there are others.
            if len(parts) == 1:
                raise
            continue
        if contour.accessible.any():
            found.append(PileToe(part, contour))
    if not found:
        # Says why.
        largest = toe_contour(pile, rise=rise, machine=machine, smallest=smallest)
        edge_poses(largest, 1)
    return tuple(found)


def poses_around(
    contours: Sequence[ToeContour], locations: int
) -> tuple[Pose, Int[np.ndarray, " n"]]:
    """Poses evenly spaced over the accessible parts of several toes, heading inward.

    Args:
        contours: Toes, in order.
        locations: Number of poses on all of them, shared out by length; at least one on each.

    Returns:
        The poses, leaves [n], and which of the contours each is on.

    Raises:
        InputError: If there are fewer locations than toes, or as `edge_poses`.
    """
    if locations < len(contours):
        raise InputError(
            f"{locations} dig locations asked for on {len(contours)} piles: ask for at least one "
            f"on each, or choose one pile."
        )
    lengths = np.array([one.length * one.accessible.mean() for one in contours])
    share = lengths / max(float(lengths.sum()), 1e-9) * (locations - len(contours))
    counts = 1 + np.floor(share).astype(int)
    # What is left goes to those that were cut short most.
    most = np.argsort(np.floor(share) - share, kind="stable")
    counts[most[: locations - int(counts.sum())]] += 1
    poses = [edge_poses(one, int(count)) for one, count in zip(contours, counts, strict=True)]
    x, y, heading = (
        np.concatenate([np.asarray(leaf) for leaf in leaves])
        for leaves in zip(*((one.x, one.y, one.heading) for one in poses), strict=True)
    )
    return Pose(x, y, heading), np.repeat(np.arange(len(contours)), counts)
