"""What a foreman should know of a plan before a machine is sent: one sentence each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from wlplan.planning.placement import not_for_trucks, place_of, truck_stands_on
from wlplan.site.receiver import stands_of
from wlplan.site.site import Site
from wlplan.terrain.standing import standing
from wlplan.terrain.steepness import remarks_on_steepness, slopes_of_soil
from wlplan.types import Characteristics, Pile

# Part of the median load below which a load yields next to nothing.
_NEXT_TO_NOTHING = 0.3
# How far a prediction of a load may be off what was played, relative.
_FAR_OFF = 0.25
# Probability of a stall that is worth saying: some six times that of a cycle with any action.
_MAY_STALL = 0.15
# How far a characteristic of a face may be outside what a model was trained on, as a part of that.
_OUTSIDE = 0.1
# How far ahead of the dig location a bucket cuts [m], and how far off level the floor there may be
# [m]: on one that falls by 0.1 m a quarter of the loads stalled, on level ones one in a thousand.
_CUT, _UNEVEN = 3.2, 0.07
# Part of a truck, and of all ways, on unseen ground that is worth saying.
_UNSEEN_TRUCK, _UNSEEN_WAYS = 0.2, 0.1
# How deep an outline may be in something that is only that [m]: half a cell and some.
_TOUCHES = -0.1


def remarks_on(
    document: Mapping[str, Any],
    pile: Pile,
    site: Site,
    *,
    faces: Characteristics | None = None,
    seen: tuple[Characteristics, Characteristics] | None = None,
    soil: Mapping[int, np.ndarray] | None = None,
) -> list[str]:
    """What is worth knowing of a plan, sentences without their stops.

    Args:
        document: Content of its plan.json.
        pile: The pile before the first loading.
        site: With its receivers.
        faces: Characteristics of the faces that are dug, leaves [N], if they are known.
        seen: The least and the largest that the model that predicted was trained on, if there is
            one that says so.
        soil: Cells with soil that cannot be driven over when a truck comes, by the truck, counted
            from 0; for others those of the pile.
    """
    loads = document["loads"]
    return [
        *_stopped(document),
        *_trucks(document),
        *_empty(loads),
        *_far_off(loads),
        *_may_stall(loads),
        *_new_faces(faces, seen),
        *([] if seen is None else _uneven_floor(loads, pile, site)),
        *_tight(loads),
        *_unseen_ways(loads),
        *_places_of_trucks(pile, site, soil or {}),
        *_steep(pile, site),
    ]


def remarks_on_map(
    document: Mapping[str, Any], pile: Pile, site: Site, *, models: bool = False
) -> list[str]:
    """What is worth knowing of a diggability map, sentences without their stops.

    Args:
        document: Content of its diggability.json.
        pile: That is mapped.
        site: Machine and soil.
        models: Whether models predicted, which know level floors alone.
    """
    places = document["locations"]
    masses = np.array([place["mass"] for place in places])
    little = masses < _NEXT_TO_NOTHING * max(float(np.median(masses)), 1.0)
    likely = np.array([place.get("stall_probability", 0.0) for place in places])
    found = []
    if little.any():
        found.append(f"{_places(little)} next to nothing: {masses.min():.1f} t at the least")
    if (likely > _MAY_STALL).any():
        found.append(
            f"{_places(likely > _MAY_STALL, 'is', 'are')} at the edge of a stall, with a "
            f"probability of up to {100.0 * likely.max():.0f} %"
        )
    off = _off_level(places, pile, site) if models else np.zeros(0)
    if (off > _UNEVEN).any():
        found.append(
            f"the floor at {_places(off > _UNEVEN, 'is', 'is')} not level, off by up to "
            f"{off.max():.1f} m: the models know level floors alone"
        )
    unseen = np.array([not _was_seen(place, pile) for place in places])
    if unseen.any():
        found.append(f"{_places(unseen, 'lies', 'lie')} where the scan saw nothing: it is a guess")
    return [*found, *_steep(pile, site)]


def _places(which: np.ndarray, one: str = "yields", more: str = "yield") -> str:
    """Places by how many they are, and a verb."""
    count = int(which.sum())
    return f"{count} of {len(which)} places {one if count == 1 else more}"


def _was_seen(place: Mapping[str, Any], pile: Pile) -> bool:
    if pile.valid is None:
        return True
    at = (np.array([place["x"], place["y"]]) - np.asarray(pile.origin, float)) / pile.cell_size
    i, j = np.clip(np.rint(at).astype(int), 0, np.array(pile.height.shape) - 1)
    return bool(np.asarray(pile.valid)[i, j])


def _stopped(document: Mapping[str, Any]) -> list[str]:
    by = {"budget": "by its budget", "interrupted": "by hand"}.get(document.get("stopped", ""))
    return [] if by is None else [f"the search was ended early, {by}: this is the best by then"]


def _trucks(document: Mapping[str, Any]) -> list[str]:
    job, trucks = document.get("job") or {}, document.get("trucks") or []
    found = []
    for sign, what in ((-1.0, "less"), (1.0, "more")):
        part = 1.0 + sign * job.get("tolerance", 0.0)
        off = [
            (number, truck["mass"])
            for number, truck in enumerate(trucks, start=1)
            if "payload" in truck and sign * (truck["mass"] - part * truck["payload"]) > 5e-4
        ]
        if off:
            names = ", ".join(f"{number} ({mass:.1f} t)" for number, mass in off)
            one = f"truck {names} carries" if len(off) == 1 else f"trucks {names} carry"
            found.append(f"{one} {what} than {100.0 * part:.0f} % of the payload")
    missing = job.get("count", 0) - len(trucks) if trucks else 0
    if missing > 0:
        found.append(f"{missing} of {job['count']} trucks are not filled")
    return found


def _empty(loads: Sequence[Mapping[str, Any]]) -> list[str]:
    masses = np.array([load["simulated"]["mass"] for load in loads])
    little = np.flatnonzero(masses < _NEXT_TO_NOTHING * max(float(np.median(masses)), 1.0))
    if not len(little):
        return []
    return [f"{_loads(little)} next to nothing: {_values(masses[little])} t"]


def _far_off(loads: Sequence[Mapping[str, Any]]) -> list[str]:
    if not all("predicted" in load for load in loads):
        return []
    predicted, played = (
        np.array([[load[part][q] for q in ("mass", "time")] for load in loads])
        for part in ("predicted", "simulated")
    )
    off = predicted / np.maximum(played, 1e-3) - 1.0
    worst = np.abs(off).max(axis=1)
    far = np.flatnonzero(worst > _FAR_OFF)
    if not len(far):
        return []
    return [
        f"{_loads(far, 'is', 'are')} predicted up to {100.0 * worst.max():.0f} % off what was "
        f"played: go by what was played"
    ]


def _may_stall(loads: Sequence[Mapping[str, Any]]) -> list[str]:
    likely = np.array([load.get("stall_probability", 0.0) for load in loads])
    edge = np.flatnonzero(likely > _MAY_STALL)
    if not len(edge):
        return []
    return [
        f"{_loads(edge, 'is', 'are')} at the edge of a stall, with a probability of up to "
        f"{100.0 * likely.max():.0f} %: a stall takes more than twice as long"
    ]


def _new_faces(
    faces: Characteristics | None, seen: tuple[Characteristics, Characteristics] | None
) -> list[str]:
    if faces is None or seen is None:
        return []
    at, low, high = (np.stack(jax.tree.leaves(one)) for one in (faces, *seen))
    low, high = low[:, None], high[:, None]
    outside = np.maximum(low - at, at - high) / (high - low)
    new = np.flatnonzero(outside.max(axis=0) > _OUTSIDE)
    if not len(new):
        return []
    return [
        f"the face of {_loads(new, 'is', 'are')} of a shape that the model was not trained on: "
        f"go by what was played"
    ]


def _uneven_floor(loads: Sequence[Mapping[str, Any]], pile: Pile, site: Site) -> list[str]:
    """The models know level floors alone: of another they see nothing."""
    worst = _off_level(loads, pile, site)
    uneven = np.flatnonzero(worst > _UNEVEN)
    if not len(uneven):
        return []
    return [
        f"the floor ahead of {_loads(uneven, 'is', 'is')} not level, off by up to "
        f"{worst.max():.1f} m: the models know level floors alone and do not foresee a stall "
        f"there; go by what was played"
    ]


def _off_level(loads: Sequence[Mapping[str, Any]], pile: Pile, site: Site) -> np.ndarray:
    """How far the floor that each bucket goes over is off that where it goes in [m]."""
    x, y, heading = (
        np.array([[load.get(name, np.nan)] for load in loads]) for name in ("x", "y", "heading")
    )
    half = 0.5 * site.machine.bucket_width
    grid = np.meshgrid(np.linspace(0.0, _CUT, 9), np.linspace(-half, half, 5))
    # The dig location first: the floor is compared with that there.
    ahead, left = (np.append(0.0, axis.ravel())[None] for axis in grid)
    c, s = np.cos(heading), np.sin(heading)
    places = np.stack([x + c * ahead - s * left, y + s * ahead + c * left])
    cells = (places - np.asarray(pile.origin, float)[:, None, None]) / pile.cell_size
    floor = np.asarray(pile.floor)
    if not np.isfinite(cells).all():
        return np.zeros(len(loads))
    most = np.array(floor.shape)[:, None, None] - 1
    i, j = np.clip(np.rint(cells).astype(int), 0, most)
    # Structures are not meant.
    off = np.abs(floor[i, j] - floor[i[:, :1], j[:, :1]])
    worst: np.ndarray = np.where(standing(floor, pile.cell_size)[i, j], 0.0, off).max(axis=1)
    return worst


def _tight(loads: Sequence[Mapping[str, Any]]) -> list[str]:
    clear = np.array([load.get("clearance", np.inf) for load in loads])
    tight = np.flatnonzero(clear < _TOUCHES)
    if not len(tight):
        return []
    return [
        f"the way or the lane of {_loads(tight, '', '')}is not clear: the loader's outline is up "
        f"to {-clear.min():.1f} m in soil or in what stands there; clear it first"
    ]


def _unseen_ways(loads: Sequence[Mapping[str, Any]]) -> list[str]:
    paths = [load["path"] for load in loads if "path" in load]
    length = sum(path["length"] for path in paths)
    unseen = sum(path["unseen"] for path in paths)
    if not paths or unseen < _UNSEEN_WAYS * length:
        return []
    return [
        f"{100.0 * unseen / length:.0f} % of the ways lie on ground that the scan did not see: "
        f"look before you drive there"
    ]


def _places_of_trucks(pile: Pile, site: Site, soil: Mapping[int, np.ndarray]) -> list[str]:
    return [
        remark
        for _, truck in stands_of(site.placed_receiver)
        for remark in _truck(pile, site.of_truck(truck), soil.get(truck))
    ]


def _truck(pile: Pile, site: Site, soil: np.ndarray | None) -> list[str]:
    place = place_of(site.placed_receiver)[None]
    blocked = not_for_trucks(pile, site.keep_out, soil)
    on, unseen = truck_stands_on(place, pile, blocked, site.machine)
    where = site.frame.place(place[0, 0], place[0, 1])
    if on[0] > 0.0:
        return [
            f"the truck that is loaded from {where} stands on the pile, on a structure or on "
            f"closed ground"
        ]
    if unseen[0] > _UNSEEN_TRUCK:
        return [f"the truck that is loaded from {where} stands where the scan saw nothing"]
    return []


def _steep(pile: Pile, site: Site) -> list[str]:
    floor = np.asarray(pile.floor)
    stands = standing(floor, pile.cell_size)
    slopes = slopes_of_soil(np.asarray(pile.height), floor, stands, pile.cell_size)
    return remarks_on_steepness(slopes, site.soil)


def _loads(rows: np.ndarray, one: str = "yields", more: str = "yield") -> str:
    """Loads by their numbers, counted from 1, and a verb."""
    numbers = ", ".join(str(int(row) + 1) for row in rows[:8])
    more_of_them = f" and {len(rows) - 8} more" if len(rows) > 8 else ""
    verb = one if len(rows) == 1 else more
    return f"load{'' if len(rows) == 1 else 's'} {numbers}{more_of_them} {verb}"


def _values(values: np.ndarray) -> str:
    return ", ".join(f"{value:.1f}" for value in values[:8])
