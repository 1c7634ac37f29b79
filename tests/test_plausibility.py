"""What a foreman should know of a plan: each note where it is due, and none where all is well."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from wlplan.report.plausibility import remarks_on
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.site.soil import GRAVEL
from wlplan.types import Characteristics, Pile

X, Y = np.meshgrid(*(0.1 * np.arange(301) - 15.0,) * 2, indexing="ij")
HEIGHT = np.maximum(3.0 - math.tan(GRAVEL.repose_angle) * np.hypot(X, Y), 0.0).astype(np.float32)
PILE = Pile(HEIGHT, 0.1, (-15.0, -15.0))
SITE = Site(receiver=Receiver(*(jnp.float32(v) for v in (9.0, 6.0, 0.0))))
SEEN = (
    Characteristics(*(jnp.float32(v) for v in (0.0, 0.0, -0.3, -0.3))),
    Characteristics(*(jnp.float32(v) for v in (0.6, 3.0, 0.6, 0.6))),
)


def document(*loads: dict[str, Any]) -> dict[str, Any]:
    """A plan of loads that differ from a good one in some fields."""
    good = {
        "simulated": {"mass": 4.4, "time": 9.0},
        "predicted": {"mass": 4.5, "time": 9.2},
        "clearance": 0.4,
        "path": {"length": 14.0, "unseen": 0.0},
    }
    return {"loads": [{**good, **load} for load in loads]}


def faces(*slopes: float) -> Characteristics:
    other = np.full(len(slopes), 0.1, np.float32)
    return Characteristics(np.array(slopes, np.float32), other, other, other)


def remarks(*loads: dict[str, Any], pile: Pile = PILE, site: Site = SITE) -> list[str]:
    return remarks_on(document(*loads), pile, site)


def test_a_good_plan_needs_no_words() -> None:
    assert remarks({}, {"stall_probability": 0.05}) == []
    assert remarks_on(document({}, {}), PILE, SITE, faces=faces(0.5, 0.58), seen=SEEN) == []


@pytest.mark.parametrize(
    ("load", "words"),
    [
        ({"simulated": {"mass": 0.2, "time": 9.0}, "predicted": {"mass": 0.2, "time": 9.0}}, "0.2"),
        ({"predicted": {"mass": 9.9, "time": 9.0}}, "125 %"),
        ({"predicted": {"mass": 4.4, "time": 3.0}}, "67 %"),
        ({"clearance": -0.4}, "0.4 m in soil"),
        ({"stall_probability": 0.34}, "up to 34 %"),
        ({"path": {"length": 14.0, "unseen": 8.0}}, "29 % of the ways"),
    ],
)
def test_what_is_wrong_with_one_load_is_said_of_that_load(load: dict[str, Any], words: str) -> None:
    (said,) = remarks({}, load)
    assert words in said
    assert "2" in said
    assert "\n" not in said


def test_a_face_that_the_model_never_saw_is_named() -> None:
    steep = faces(0.5, 1.1, 1.2)
    (said,) = remarks_on(document({}, {}, {}), PILE, SITE, faces=steep, seen=SEEN)
    assert "loads 2, 3" in said
    assert "not trained on" in said
    assert remarks_on(document({}, {}, {}), PILE, SITE, faces=steep) == []


@pytest.mark.parametrize(("fall", "said"), [(0.0, False), (0.01, False), (0.06, True)])
def test_a_floor_that_is_not_level_is_said(fall: float, said: bool) -> None:
    """The floor falls along x by so many metres a metre; the dig is on the west of the pile."""
    ground = (-fall * X).astype(np.float32)
    pile = Pile(HEIGHT + ground, 0.1, (-15.0, -15.0), ground=ground)
    load = {"x": -4.0, "y": 0.0, "heading": 0.0}
    found = remarks_on(document(load), pile, SITE, seen=SEEN)
    assert any("floor ahead of load 1 is not level, off by up to 0.2 m" in f for f in found) is said
    # In the simulator the floor is seen.
    assert not any("not level" in one for one in remarks_on(document(load), pile, SITE))


def test_a_truck_on_the_pile_or_on_unseen_ground_is_said() -> None:
    on = SITE.replace(receiver=Receiver(*(jnp.float32(v) for v in (4.0, 0.0, math.pi))))
    (said,) = remarks({}, site=on)
    assert "stands on the pile" in said
    unseen = PILE.replace(valid=X < 8.0)
    (said,) = remarks({}, pile=unseen)
    assert "saw nothing" in said


def test_a_pile_steeper_than_its_soil_is_said_with_the_choice() -> None:
    steep = np.maximum(4.0 - np.hypot(X, Y), 0.0).astype(np.float32)
    (said,) = remarks({}, pile=Pile(steep, 0.1, (-15.0, -15.0)))
    assert "45 degrees" in said
    assert "--soil NAME@45" in said
