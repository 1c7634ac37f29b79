"""Where the truck stands, when the planner chooses."""

import itertools
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from cones import bowl_world, wide_cone

from wlplan.errors import InputError
from wlplan.planning.job import make_job
from wlplan.planning.placement import truck_stands_on
from wlplan.planning.plan import plan_loads
from wlplan.planning.planners import Greedy
from wlplan.planning.spots import TRIED, best_spots
from wlplan.planning.watch import Watch
from wlplan.site.machine import WA320
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.types import Action, Performance, Pile, Pose

GREEDY = Greedy(actions=8, refine_steps=10, refined=2, poses_per_metre=0.5)


def eastern_world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Only digs in the east of a pile are worth anything."""
    after, performance = bowl_world(pile, pose, action)
    part = jnp.where(pose.x > 2.0, 1.0, 0.1)
    return after, performance.replace(mass=part * performance.mass)


def places_of(spots: list[Receiver]) -> np.ndarray:
    return np.array([[float(v) for v in (spot.x, spot.y, spot.heading)] for spot in spots])


def test_spots_are_near_what_yields_apart_and_on_nothing() -> None:
    pile = wide_cone()
    job, watch = make_job(eastern_world, pile, objective="delivery"), Watch()
    places = places_of(best_spots(job, seed=0, watch=watch))
    assert len(places) == TRIED
    # Every load that was evaluated is counted.
    assert watch.spent == pytest.approx((32 * 24 + 48 * 6) / 150 + 48 * 6 * 0.3)
    assert (places[:, 0] > 0.0).all()
    for one, other in itertools.combinations(places, 2):
        assert math.hypot(*(one[:2] - other[:2])) > 3.0
    on, _ = truck_stands_on(places, pile, np.asarray(pile.height) > 0.25, WA320)
    assert (on == 0.0).all()


@pytest.mark.slow
def test_a_plan_says_where_it_has_the_truck() -> None:
    pile: Any = wide_cone()
    west = Site(receiver=Receiver(*(jnp.float32(v) for v in (-9.0, 3.0, 1.2))))
    given = plan_loads(eastern_world, pile, loads=2, planner=GREEDY, site=west)
    assert given.receiver is not None
    assert float(given.receiver.x) == -9.0
    chosen = plan_loads(eastern_world, pile, loads=2, planner=GREEDY, site=west, truck="auto")
    assert chosen.receiver is not None
    assert float(chosen.receiver.x) > 0.0
    assert float(chosen.cost) < float(given.cost)
    assert chosen.spent > given.spent


def test_a_budget_that_ends_before_a_spot_is_found_is_told() -> None:
    with pytest.raises(InputError, match="too small for a first plan"):
        plan_loads(bowl_world, wide_cone(), loads=2, planner=GREEDY, truck="auto", budget=10)
