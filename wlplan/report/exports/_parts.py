"""The parts of a plan that can be drawn, in the coordinates of the scan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from wlplan.report.figures.truck import Truck
from wlplan.report.legs import approach, approach_distance, way
from wlplan.report.legs import legs as legs_of
from wlplan.report.stands import stands_of
from wlplan.site.frame import frame_recorded
from wlplan.site.receiver import Receiver


def _shifted(points: Float[np.ndarray, "n 2"], document: Mapping[str, Any]) -> np.ndarray:
    shifted: np.ndarray = np.asarray(points, float) + np.array(frame_recorded(document).offset[:2])
    return shifted


def digs(document: Mapping[str, Any]) -> Iterator[tuple[int, Mapping[str, Any], np.ndarray]]:
    """Number, record and approach of each load: two points, the second where it digs [m]."""
    distance = approach_distance(document)
    for number, load in enumerate(document["loads"], start=1):
        yield number, load, _shifted(approach(load, distance), document)


def legs(document: Mapping[str, Any]) -> Iterator[tuple[int, str, np.ndarray]]:
    """Number of the load, "reverse" or "forward", and points of each leg of its way [m]."""
    for number, load in enumerate(document["loads"], start=1):
        for name, leg in legs_of(way(load)).items():
            yield number, name, _shifted(leg, document)


def trucks(document: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """Name and four corners of each truck [m]."""
    for name, stand in stands_of(document):
        truck = Truck(Receiver(stand["x"], stand["y"], stand["heading"]))
        yield name, _shifted(truck.body, document)
