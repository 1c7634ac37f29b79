"""The pile in three dimensions, load by load: what the page draws and moves."""

from __future__ import annotations

import base64
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from wlplan.report.figures.relief import view_of
from wlplan.report.figures.truck import Truck
from wlplan.report.legs import approach, approach_distance, way
from wlplan.site.frame import frame_recorded
from wlplan.site.machine import WA320
from wlplan.site.receiver import Receiver
from wlplan.types import Pile

# Cells a side at most: what a browser still moves at once.
_CELLS = 200
# Heights are kept in whole parts of this [m].
_STEP = 0.005
# Lines lie so far above the ground, and go so far into the pile [m].
_ABOVE, _IN = 0.15, 0.8


def scene_of(
    before: Pile, heights: Float[np.ndarray, "n nx ny"], document: Mapping[str, Any]
) -> dict[str, Any]:
    """What the page needs to show the pile after any load, small enough to be part of it.

    Args:
        before: The pile before the first load.
        heights: As each load leaves them [m].
        document: Content of the plan.json: its loads with their paths, trucks and receiver.

    Returns:
        Values of JSON. `heights` are whole numbers of `step` metres over `lowest`, two bytes each,
        low byte first, in base64, row by row of x; `changes` the windows that each load changes.
    """
    loads = document["loads"]
    digs = np.array([[load["x"], load["y"]] for load in loads], float).reshape(-1, 2)
    trucks = _trucks(document)
    seen = [digs, *(truck.body for truck in trucks)]
    seen += [way(load)[:, :2] for load in loads]
    points = np.concatenate(seen)
    all_heights = np.concatenate([np.asarray(before.height)[None], heights]).astype(np.float64)
    # It is looked at from the side of the trucks.
    side = np.mean([truck.body.mean(axis=0) for truck in trucks] or digs, axis=0)
    ground, whole = ground_of(before, all_heights, points, side, document)
    distance = approach_distance(document)
    return {
        **ground,
        "changes": [_change(old, new) for old, new in itertools.pairwise(whole)],
        "loader": {"length": WA320.length, "width": WA320.bucket_width},
        "loads": [
            {
                "dig": _dig(load, distance, before, all_heights[n]),
                "path": _path(load, before, all_heights[n]),
                "truck": _truck_of(document, n),
            }
            for n, load in enumerate(loads)
        ],
        "said": [_said(load, ground["offset"]) for load in loads],
        "trucks": [_box(truck, before, all_heights[0]) for truck in trucks],
    }


def ground_of(
    pile: Pile,
    heights: Float[np.ndarray, "n nx ny"],
    points: Float[np.ndarray, "m 2"],
    side: Float[np.ndarray, "2"],
    document: Mapping[str, Any],
) -> tuple[dict[str, Any], Int[np.ndarray, "n a b"]]:
    """The ground that a page shows, and heights on it in whole steps.

    Args:
        pile: Whose grid and floor it is.
        heights: Of the pile, one or several [m]; the page has the first.
        points: What is to be seen beside the pile [m].
        side: From where it is looked at [m].
        document: With its frame.
    """
    rows, columns, every = _window(pile, points)
    shown = np.asarray(heights, np.float64)[:, rows, columns][:, ::every, ::every]
    lowest = float(shown.min())
    whole = np.rint((shown - lowest) / _STEP).astype(np.int64)
    floor = np.asarray(pile.floor, np.float64)[rows, columns][::every, ::every]
    corner, size = np.asarray(pile.origin, np.float64), pile.cell_size

    def along(axis: int, cells: slice) -> list[float]:
        places = corner[axis] + size * np.arange(cells.start, cells.stop, every)
        rounded: list[float] = np.round(places, 3).tolist()
        return rounded

    ground = {
        "x": along(0, rows),
        "y": along(1, columns),
        "view": np.round(view_of(pile, points), 2).tolist(),
        "side": np.round(side, 2).tolist(),
        "offset": list(frame_recorded(document).offset),
        "step": _STEP,
        "lowest": lowest,
        "heights": _packed(whole[0]),
        "floor": _packed(np.rint((floor - lowest) / _STEP).astype(np.int64)),
    }
    return ground, whole


def _window(pile: Pile, points: Float[np.ndarray, "n 2"]) -> tuple[slice, slice, int]:
    """Rows and columns of the cells that are shown, and that only every so manieth is."""
    low, high = (view_of(pile, points) - np.asarray(pile.origin, float)) / pile.cell_size
    shape = np.array(pile.height.shape)
    first = np.clip(np.floor(low).astype(int), 0, shape - 2)
    last = np.clip(np.ceil(high).astype(int) + 1, first + 2, shape)
    every = max(1, math.ceil(int((last - first).max()) / _CELLS))
    return slice(int(first[0]), int(last[0])), slice(int(first[1]), int(last[1])), every


def _packed(values: Int[np.ndarray, "..."]) -> str:
    limits = np.iinfo(np.int16)
    two_bytes = np.clip(values, limits.min, limits.max).astype("<i2")
    return base64.b64encode(two_bytes.tobytes()).decode()


def _change(old: Int[np.ndarray, "a b"], new: Int[np.ndarray, "a b"]) -> dict[str, Any]:
    """The window of what is new, with its first row and column."""
    rows, columns = np.nonzero(old != new)
    if not len(rows):
        return {"at": [0, 0], "size": [0, 0], "heights": ""}
    i, j = int(rows.min()), int(columns.min())
    part = new[i : int(rows.max()) + 1, j : int(columns.max()) + 1]
    return {"at": [i, j], "size": list(part.shape), "heights": _packed(part)}


def height_at(
    points: Float[np.ndarray, "n 2"], pile: Pile, height: Float[np.ndarray, "nx ny"]
) -> Float[np.ndarray, " n"]:
    """Of the nearest cells; beyond the map that of its edge [m]."""
    cells = np.rint((points - np.asarray(pile.origin, float)) / pile.cell_size).astype(int)
    i, j = np.clip(cells, 0, np.array(height.shape) - 1).T
    found: np.ndarray = height[i, j]
    return found


def _path(
    load: Mapping[str, Any], pile: Pile, height: Float[np.ndarray, "nx ny"]
) -> list[list[float]]:
    """x, y, z and gear along the way to the truck [m]; nothing if it is not known."""
    points = way(load)[::2]
    z = height_at(points[:, :2], pile, height) + _ABOVE
    return [
        [round(x, 2), round(y, 2), round(float(up), 2), float(gear)]
        for (x, y, _, gear), up in zip(points.tolist(), z, strict=True)
    ]


def _dig(
    load: Mapping[str, Any], distance: float, pile: Pile, height: Float[np.ndarray, "nx ny"]
) -> list[list[float]]:
    """The approach: from where the loader waits to where the bucket goes in, x, y, z [m]."""
    start, tip = approach(load, distance)
    points = np.stack([start, tip, tip + _IN * (tip - start) / distance])
    z = height_at(points, pile, height) + _ABOVE
    found: list[list[float]] = np.round(np.column_stack([points, z]), 2).tolist()
    return found


def _said(load: Mapping[str, Any], offset: Sequence[float]) -> str:
    """The load in words, in the coordinates of the scan."""
    played = load.get("simulated") or {}
    words = f"at {load['x'] + offset[0]:.1f}, {load['y'] + offset[1]:.1f}"
    return words + (f"; {played['mass']:.1f} t in {played['time']:.0f} s" if played else "")


def _trucks(document: Mapping[str, Any]) -> list[Truck]:
    """One for each place that the plan names."""
    return [Truck(Receiver(*place)) for place in _places(document)]


def _places(document: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    records = [document.get("receiver"), *(document.get("trucks") or [])]
    names = ("x", "y", "heading")
    known = [
        tuple(float(record[name]) for name in names)
        for record in records
        if record and all(name in record for name in names)
    ]
    return [(one[0], one[1], one[2]) for one in dict.fromkeys(known)]


def _truck_of(document: Mapping[str, Any], load: int) -> int:
    """Which of the places a load goes to."""
    places = _places(document)
    for truck in document.get("trucks") or []:
        if load in truck["loads"] and "x" in truck:
            return places.index((float(truck["x"]), float(truck["y"]), float(truck["heading"])))
    return 0


def _box(truck: Truck, pile: Pile, height: Float[np.ndarray, "nx ny"]) -> dict[str, Any]:
    """The corners of bed and cab of a truck, and the ground there [m]."""
    return {
        "bed": np.round(truck.bed, 2).tolist(),
        "cab": np.round(truck.cab, 2).tolist(),
        "ground": round(float(np.median(height_at(truck.body, pile, height))), 2),
    }
