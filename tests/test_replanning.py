"""The next load after every scan."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE, bowl_world, cone

import wlplan
from wlplan.errors import InputError
from wlplan.planning.amounts import MISFIT_COST, Tonnes, Trucks
from wlplan.planning.load_search import LoadSearch
from wlplan.planning.plan import plan_loads
from wlplan.planning.planners import Greedy
from wlplan.planning.replanning import Replanner, in_map, next_load
from wlplan.site.receiver import Receiver
from wlplan.types import Pile

SETTINGS: dict[str, Any] = {"actions": 8, "refine_steps": 30, "refined": 4, "poses_per_metre": 0.5}
SEARCH = LoadSearch(**SETTINGS)


def replanner(**options: Any) -> Replanner:
    return Replanner(bowl_world, **{"site": SITE, "search": SEARCH, "extent": 18.0, **options})


def part_of(pile: Pile, cells: int) -> Pile:
    """A scan that ends so many cells earlier in x."""
    return pile.replace(height=pile.height[:-cells])


@pytest.mark.slow
def test_a_scan_of_another_extent_needs_no_compiling(caplog: pytest.LogCaptureFixture) -> None:
    def compilations(planner: Replanner, pile: Pile) -> list[str]:
        caplog.clear()
        with jax.log_compiles():
            planner.next_load(pile)
        return [r.getMessage() for r in caplog.records if "XLA compilation" in r.getMessage()]

    jax.clear_caches()
    planner = replanner()
    assert compilations(planner, cone())
    # The second load is told of the first.
    planner.next_load(cone())
    assert not compilations(planner, part_of(cone(radius=3.0), 17))
    # Nor does a planner that is made anew.
    assert not compilations(replanner(), part_of(cone(), 5))


def test_it_is_the_greedy_plan_load_by_load() -> None:
    pile = cone()
    plan = plan_loads(bowl_world, pile, loads=1, planner=Greedy(**SETTINGS), site=SITE, seed=3)
    first = replanner(seed=3).next_load(pile)
    told, planned = jax.tree.leaves((first.pose, first.action)), jax.tree.leaves(plan.plan)
    np.testing.assert_allclose(told, [leaf[0] for leaf in planned], rtol=1e-4)
    assert float(first.performance.mass) == pytest.approx(
        float(plan.rollout.performance.mass[0]), rel=1e-4
    )


def test_what_is_beyond_the_scan_is_unseen_and_no_pile() -> None:
    pile = part_of(cone(), 17).replace(ground=jnp.full((144, 161), 0.0))
    whole = in_map(pile, wlplan.Site(), 18.0)[0]
    assert whole.height.shape == (180, 180)
    np.testing.assert_array_equal(whole.height[:144, :161], pile.height)
    valid = np.asarray(whole.valid)
    assert valid[:144, :161].all()
    assert not valid[144:].any()
    assert not valid[:, 161:].any()
    assert float((whole.height - whole.floor)[~valid].max()) == 0.0


@pytest.mark.slow
def test_trucks_are_filled_by_what_the_scale_says() -> None:
    planner = replanner(amount=Trucks(1, 8.0))
    pile, told, costs = cone(), [], []
    while not planner.is_done:
        load = planner.next_load(pile)
        pile, performance = bowl_world(pile, load.pose, load.action)
        costs.append(float(load.cost))
        # The bucket holds less than the world says, so it takes a load more.
        told.append(0.7 * float(performance.mass))
        planner.loaded(told[-1])
        assert len(told) < 8
    # The last was to fit, and holds less than the world said. Where it is short beyond what is
    # tolerated, that costs less than the cheapest bucket did.
    assert MISFIT_COST * max(0.95 * 8.0 - sum(told), 0.0) < min(costs)
    assert sum(told) <= 1.10 * 8.0
    with pytest.raises(InputError, match="the job is done"):
        planner.next_load(pile)


def test_an_operator_may_send_the_truck_off() -> None:
    planner = replanner(amount=Trucks(2, 8.0))
    planner.next_load(cone())
    assert planner.loaded(5.0, left=True)
    planner.next_load(cone())
    assert planner.loaded(4.0, left=True)
    assert planner.is_done


@pytest.mark.slow
def test_tonnes_end() -> None:
    planner = replanner(amount=Tonnes(4.0))
    planner.next_load(cone())
    planner.loaded(2.5)
    assert not planner.is_done
    planner.next_load(cone())
    planner.loaded(2.5)
    assert planner.is_done


def test_the_truck_stays_where_it_was_put() -> None:
    planner = Replanner(bowl_world, search=SEARCH, extent=18.0)
    assert planner.receiver is None
    planner.next_load(cone())
    first = planner.receiver
    assert first is not None
    planner.next_load(cone(radius=3.0))
    assert planner.receiver == first
    moved = Receiver(first.x + 2.0, first.y, first.heading)
    planner.next_load(cone(radius=3.0), receiver=moved)
    assert planner.receiver == moved


def test_the_function_is_one_load_of_a_planner() -> None:
    one = next_load(bowl_world, cone(), site=SITE, extent=18.0)
    assert math.isfinite(float(one.cost))
    assert float(one.performance.mass) > 2.0


def test_mistakes_are_one_clear_line() -> None:
    with pytest.raises(InputError, match=r"16\.1 by 16\.1 m, and the largest is 10 m"):
        replanner(extent=10.0).next_load(cone())
    planner = replanner()
    with pytest.raises(InputError, match="no load was planned yet"):
        planner.loaded(3.0)
    planner.next_load(cone())
    for mass in (math.nan, -1.0):
        with pytest.raises(InputError, match="give tonnes"):
            planner.loaded(mass)
