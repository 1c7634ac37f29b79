"""The legs of a load of a plan.json: up to the pile, back in reverse, forward to the truck."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from wlplan.site.machine import WA320

GEARS = {"reverse": -1.0, "forward": 1.0}
"""Gears of the legs of the way to the truck, as its points have them."""


def approach_distance(document: Mapping[str, Any]) -> float:
    """From where the loader waits to where the bucket goes in [m]; of the WA320 if not recorded."""
    machine = document.get("machine")
    parameters = machine.get("parameters") if isinstance(machine, Mapping) else None
    known = parameters.get("approach_distance") if isinstance(parameters, Mapping) else None
    return float(known) if isinstance(known, int | float) else WA320.approach_distance


def approach(load: Mapping[str, Any], distance: float) -> Float[np.ndarray, "2 2"]:
    """Where the loader waits and where the bucket goes in [m].

    Args:
        load: With `x` and `y` [m] and `heading` [rad].
        distance: Between the two [m], see `approach_distance`.
    """
    dig, heading = np.array([[load["x"], load["y"]]], float), np.array([load["heading"]], float)
    line: np.ndarray = approaches(dig, heading, distance)[0]
    return line


def approaches(
    digs: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, " n"], distance: float
) -> Float[np.ndarray, "n 2 2"]:
    """`approach` of several: dig locations [m] and headings [rad]."""
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.stack([digs - distance * ahead, digs], axis=1)


def way(load: Mapping[str, Any]) -> Float[np.ndarray, "n 4"]:
    """Points of the way to the truck: x [m], y [m], heading [rad] and gear; none if not known."""
    path = load.get("path") or {}
    return np.array(path.get("points", []), float).reshape(-1, 4)


def legs(points: Float[np.ndarray, "n 4"]) -> dict[str, Float[np.ndarray, "_ 2"]]:
    """The legs of a way by name, x and y of their points [m]; only those that there are."""
    found = {name: points[points[:, 3] == gear, :2] for name, gear in GEARS.items()}
    return {name: leg for name, leg in found.items() if len(leg) > 1}
