"""Amounts: when a truck leaves, what it costs, and plans for tonnes, trucks and whole piles."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE, bowl_world, cone, on_map

import wlplan
from wlplan.errors import InputError
from wlplan.planning.amounts import (
    MISFIT_COST,
    Amount,
    Done,
    Empty,
    Emptying,
    Loads,
    Made,
    Outlook,
    Tonnes,
    Trucks,
    amount_fields,
    amount_recorded,
    check_amount,
    nothing_done,
)
from wlplan.planning.job import make_job
from wlplan.planning.plan import _next_heap, plan_loads, play
from wlplan.planning.planners import Gradient, Greedy, Nominal
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.terrain.toes import toes_of
from wlplan.types import Action, Performance, Pile, Pose

AWAY = Site(receiver=Receiver(jnp.float32(14.0), jnp.float32(-6.0), jnp.float32(0.5 * math.pi)))
GREEDY = Greedy(actions=8, refine_steps=30, refined=4, poses_per_metre=0.5)


def outlook(spare: float = 0.0, price: float = 0.0) -> Outlook:
    """Loads of 3 t for 2, and of 3.2 t for a tenth more."""
    return Outlook(*(jnp.float32(v) for v in (2.0, 3.0, 2.2, 3.2, spare, price)))


def after(amount: Amount, *masses: float, leaves: Any = None) -> list[Any]:
    """The steps of some loads."""
    done, steps = nothing_done(jnp.float32), []
    for mass in masses:
        steps.append(amount.step(done, jnp.float32(mass), leaves))
        done = steps[-1].done
    return steps


def aboard(mass: float) -> Done:
    return nothing_done(jnp.float32).replace(aboard=jnp.float32(mass), mass=jnp.float32(mass))


def test_a_truck_leaves_when_it_is_full_and_the_next_is_waited_for() -> None:
    steps = after(Trucks(2, 10.0), 5.0, 4.4, 0.2, 10.0)
    assert [int(s.done.trucks) for s in steps] == [0, 0, 1, 2]
    # Of two trucks only one is followed by another.
    assert [float(s.wait) for s in steps] == [0.0, 0.0, 30.0, 0.0]
    np.testing.assert_allclose([float(s.done.aboard) for s in steps], [5.0, 9.4, 0.0, 0.0])
    assert bool(Trucks(2, 10.0).is_done(steps[-1].done))
    assert not bool(Trucks(3, 10.0).is_done(steps[-1].done))


@pytest.mark.parametrize(
    ("mass", "misfit", "cost"),
    [
        (9.5, 0.0, 0.0),
        (10.5, 0.0, 0.0),
        (9.0, 0.5, 0.5 * MISFIT_COST),
        (10.9, 0.4, 0.4 * MISFIT_COST),
        # Beyond 110 % a tonne costs a hundred more.
        (11.2, 0.7, 0.7 * MISFIT_COST + 0.2 * 100.0),
    ],
)
def test_what_a_truck_is_off_by_counts_beyond_the_tolerance(
    mass: float, misfit: float, cost: float
) -> None:
    (step,) = after(Trucks(1, 10.0), mass, leaves=jnp.asarray(True))
    assert float(step.misfit) == pytest.approx(misfit, abs=1e-5)
    assert float(step.cost) == pytest.approx(cost, abs=1e-3)


def test_buckets_to_fill_a_truck_are_counted() -> None:
    trucks = Trucks(1, 10.0)
    # 9.5 t are enough: with 3.2 t aboard two full buckets of 3.2 t do, 0.3 t of 0.4 t fuller.
    cost = float(trucks.to_go(aboard(3.2), outlook()))
    assert cost == pytest.approx(2 * 2.0 + 0.2 / 0.2 * 0.3, abs=1e-4)
    # With less aboard it takes three, or two and a truck that is a little short.
    cost = float(trucks.to_go(aboard(2.9), outlook()))
    assert cost == pytest.approx(min(3 * 2.0, 2 * 2.2 + MISFIT_COST * 0.2), abs=1e-4)
    # Of three loads, 9 t, 2.4 t are spared, which counts a little more than it is worth.
    cost = float(trucks.to_go(aboard(2.9), outlook(spare=0.1)))
    assert cost == pytest.approx(min(3 * 2.0 - 1.25 * 0.1 * 2.4, 6.4), abs=1e-4)
    # By price it is the tonnes that count.
    assert float(trucks.to_go(aboard(3.0), outlook(price=0.5))) == pytest.approx(3.5)


def test_a_truck_had_better_leave_when_a_bucket_more_is_worse() -> None:
    trucks = Trucks(1, 10.0)
    wanted = {9.6: True, 9.45: True, 5.0: False, 8.0: False, 0.0: False}
    for mass, leaves in wanted.items():
        assert bool(trucks.should_leave(aboard(mass), outlook())) == leaves, mass


def test_the_last_tonnes_are_counted_by_the_bucket() -> None:
    tonnes = Tonnes(100.0)
    far, near = aboard(10.0), aboard(98.0)
    assert float(tonnes.to_go(far, outlook())) == pytest.approx(90.0 * 2.0 / 3.0, rel=1e-5)
    # Two tonnes are a bucket, whatever it holds.
    assert float(tonnes.to_go(near, outlook())) == pytest.approx(2.0)


def test_of_loads_that_empty_a_pile_none_is_better_that_would_not_be_made() -> None:
    emptying = Emptying(mass=100.0, least=0.8, follows=True)

    def score(cost: float, mass: float) -> float:
        masses = jnp.float32(mass)
        counted = cost + emptying.shortfall(masses)
        return float(counted + emptying.to_go(aboard(90.0 + mass), outlook()))

    # It costs less a tonne than the other two.
    too_small = score(0.3, 0.7)
    assert all(too_small > score(cost, mass) for cost, mass in ((0.6, 0.8), (1.2, 1.5)))
    # Of those that are made the price decides.
    assert score(0.6, 0.8) > score(0.9, 1.5)
    assert float(Tonnes(100.0).shortfall(jnp.float32(0.1))) == 0.0
    assert float(jax.grad(Tonnes(100.0).shortfall)(jnp.float32(0.0))) == 0.0


def test_of_a_pile_that_is_emptied_nothing_follows_where_no_load_was_worth_it() -> None:
    found = Empty(0.1).of(cone(), SITE.soil).part(Made(), 4.5)
    assert found is not None
    assert found[1] == 16
    emptying: Any = found[0].replace(price=0.5, mass=54.0)

    def rest(loads: int, mass: float) -> float:
        done = aboard(mass).replace(loads=jnp.asarray(loads, jnp.int32))
        return float(emptying.rest(done))

    # It went on to its last row, or to the last tonne: what is left is done in the next part.
    assert rest(16, 40.0) == pytest.approx(0.5 * 14.0)
    assert rest(12, 55.0) == pytest.approx(-0.5)
    # It found no further load.
    assert rest(12, 40.0) == pytest.approx(MISFIT_COST * 14.0)
    of_tonnes: Any = Tonnes(54.0, follows=True, price=0.5)
    assert float(of_tonnes.rest(aboard(40.0))) == pytest.approx(0.5 * 14.0)


def test_parts_add_up_to_the_whole() -> None:
    trucks, made = Trucks(5, 24.0), Made()
    counts: list[int] = []
    while (part := trucks.part(made, 4.5)) is not None:
        some: Any = part[0]
        counts.append(int(some.count))
        # All waits but the last are part of some part.
        assert int(some.follows) == (made.trucks + counts[-1] < 5)
        made = Made(trucks=made.trucks + counts[-1])
    assert counts == [2, 2, 1]
    tonnes, masses, made = Tonnes(150.0), [], Made()
    while (part := tonnes.part(made, 4.5)) is not None:
        some = part[0]
        masses.append(float(some.mass))
        made = Made(mass=made.mass + masses[-1])
    assert masses == [54.0, 54.0, 42.0]


def test_trucks_are_filled_with_whole_buckets() -> None:
    result = plan_loads(bowl_world, cone(), amount=Trucks(2, 8.0), planner=GREEDY, site=SITE)
    masses, truck = np.asarray(result.rollout.performance.mass), np.asarray(result.plan.truck)
    loaded = [masses[truck == k].sum() for k in (0, 1)]
    assert all(0.95 * 8.0 - 1e-3 <= mass <= 1.05 * 8.0 + 1e-3 for mass in loaded)
    # A bucket holds three tonnes at most.
    assert [int((truck == k).sum()) for k in (0, 1)] == [3, 3]
    assert float(result.missing) == 0.0
    # The cheapest plans are at the edge of the tolerance, to a few hundred grams.
    assert float(np.sum(result.misfit)) < 2e-3
    wait = np.asarray(result.transport.wait)
    assert wait.tolist() == [0.0, 0.0, 30.0, 0.0, 0.0, 0.0]
    # Played as it is, it is the same.
    again = play(bowl_world, cone(), result.plan, amount=Trucks(2, 8.0), site=SITE)
    np.testing.assert_allclose(again.rollout.performance.mass, masses, rtol=1e-5)
    np.testing.assert_array_equal(again.transport.wait, wait)
    # A world where buckets hold less leaves the trucks short, and says so.
    short = play(less_world, cone(), result.plan, amount=Trucks(2, 8.0), site=SITE)
    assert float(np.sum(short.misfit)) == pytest.approx(0.95 * 16.0 - 0.8 * masses.sum(), rel=1e-3)


def less_world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    after, performance = bowl_world(pile, pose, action)
    return after, performance.replace(mass=0.8 * performance.mass)


def test_a_planner_that_knows_nothing_of_trucks_fills_them() -> None:
    planner = Nominal(actions=4, rows=2, refine_steps=0)
    result = plan_loads(bowl_world, cone(), amount=Trucks(1, 7.0), planner=planner, site=SITE)
    mass = float(result.rollout.performance.mass.sum())
    assert mass >= 0.95 * 7.0
    # No load is made once the truck has left.
    assert mass - float(result.rollout.performance.mass[-1]) < 0.95 * 7.0


@pytest.mark.slow
def test_a_descent_makes_no_truck_worse() -> None:
    planner = Gradient(starts=2, iterations=4, candidates=3, start=GREEDY)
    job: Any = {"amount": Trucks(1, 8.0), "site": SITE}
    base = plan_loads(bowl_world, cone(), planner=GREEDY, **job)
    better = plan_loads(bowl_world, cone(), planner=planner, **job)
    assert float(better.cost) <= float(base.cost) * (1.0 + 1e-5)
    assert float(np.sum(better.misfit)) <= 1e-3


@pytest.mark.slow
def test_tonnes_end_with_the_bucket_that_reaches_them() -> None:
    result = plan_loads(bowl_world, cone(), amount=Tonnes(7.0), planner=GREEDY, site=SITE)
    masses = np.asarray(result.rollout.performance.mass)
    assert masses.sum() >= 7.0 - 1e-3
    assert masses[:-1].sum() < 7.0
    assert result.plan.truck is None


@pytest.mark.slow
def test_the_referee_counts_what_is_done() -> None:
    """Its buckets hold a quarter more, so it takes fewer of them."""

    def fuller(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        after, performance = bowl_world(pile, pose, action)
        return after, performance.replace(mass=1.25 * performance.mass)

    few = Greedy(actions=6, refine_steps=4, refined=2, poses_per_metre=0.4)
    # Two parts.
    amount = Tonnes(70.0)
    plan = plan_loads(
        bowl_world, cone(), amount=amount, planner=few, site=SITE, referee=fuller, mend=False
    )
    assert plan.refereed is not None
    mass = np.asarray(plan.refereed.rollout.performance.mass)
    assert 70.0 <= mass.sum() < 70.0 + mass.max()
    assert float(plan.refereed.missing) == 0.0


@pytest.mark.slow
def test_a_pile_is_emptied_of_all_that_is_worth_a_load() -> None:
    pile = cone(radius=4.0)
    result = plan_loads(bowl_world, pile, amount=Empty(0.3), planner=GREEDY, site=SITE)
    masses = np.asarray(result.rollout.performance.mass)
    assert masses.min() >= 0.8
    left = float(wlplan_volume(result.rollout.pile)) / float(wlplan_volume(pile))
    assert left <= 0.3 + 1e-3


def barren_world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """After the first load there is next to nothing west of x = 14 m; a corner remembers it."""
    is_barren = (pose.x < 14.0) & (pile.height[0, 0] > 0.0)
    after, performance = bowl_world(pile, pose, action)
    mass = jnp.where(is_barren, 0.1, performance.mass)
    return after.replace(height=after.height.at[0, 0].set(0.01)), performance.replace(mass=mass)


def test_where_one_heap_gives_no_more_the_next_is_emptied() -> None:
    large, small = (7.0, 8.0), (20.0, 8.0)
    pile = on_map((large, 5.0), (small, 3.0))
    planner = Greedy(actions=8, refine_steps=0, refined=4, poses_per_metre=0.5)
    result = plan_loads(barren_world, pile, amount=Empty(0.9), planner=planner, site=AWAY)
    masses, x = np.asarray(result.rollout.performance.mass), np.asarray(result.plan.pose.x)
    assert x[0] < 14.0
    assert (x[1:] > 14.0).all()
    assert masses.min() >= 0.8
    assert float(result.missing) == 0.0
    # Loads that only have to be counted are made of the largest pile alone.
    result = plan_loads(barren_world, pile, loads=2, planner=planner, site=AWAY)
    assert (np.asarray(result.plan.pose.x) < 14.0).all()


@pytest.mark.parametrize(("least", "count"), [(1.2, 2), (1.3, 1)])
def test_a_ridge_that_holds_a_load_is_a_heap(least: float, count: int) -> None:
    pile = on_map(((7.0, 8.0), 5.0))
    # 0.72 m^3, 1.24 t: less than what counts as a pile elsewhere.
    pile = pile.replace(height=pile.height.at[190:230, 77:83].set(0.3))
    emptying = Empty(0.02, least=least).of(pile, SITE.soil)
    job = make_job(bowl_world, pile, site=SITE, objective="delivery", amount=emptying)
    for past in range(count):
        assert _next_heap(job, past) is not None
    with pytest.raises(InputError, match="no heap is left"):
        _next_heap(job, count)
    assert len(toes_of(pile)) == 1
    # Of other amounts the largest alone is dug.
    assert _next_heap(job.replace(amount=Tonnes(9.0)), 0) is None


def wlplan_volume(pile: Pile) -> float:
    return float(np.asarray(pile.height, np.float64).sum()) * pile.cell_size**2


@pytest.mark.parametrize(
    ("amount", "told"),
    [
        (Loads(0), "0 loads were asked for"),
        (Tonnes(-3.0), "mass of an amount is -3"),
        (Tonnes(math.nan), "mass of an amount is nan"),
        (Trucks(2, 0.0), "payload of an amount is 0"),
        (Trucks(0, 20.0), "count of an amount is 0"),
        (Trucks(2, 20.0, limit=1.0), "by less than the tolerance"),
        (Empty(1.0), "1 of the pile is to remain"),
    ],
)
def test_amounts_that_make_no_sense_are_refused(amount: Amount, told: str) -> None:
    with pytest.raises(InputError, match=told):
        check_amount(amount)


def test_loads_and_an_amount_are_one_too_many() -> None:
    with pytest.raises(InputError, match="give one of them"):
        plan_loads(bowl_world, cone(), loads=3, amount=Tonnes(3.0), site=SITE)


@pytest.mark.parametrize(
    "amount", [Loads(3), Tonnes(12.5), Trucks(2, 20.0, exchange=45.0), Empty(0.1)]
)
def test_an_amount_is_read_as_it_was_written(amount: Amount) -> None:
    fields = json.loads(json.dumps(amount_fields(amount)))
    again = amount_recorded(fields)
    assert type(again) is type(amount)
    assert again is not None
    assert amount_fields(again) == fields


@pytest.mark.slow
def test_a_budget_ends_the_search_with_what_there_is() -> None:
    whole = plan_loads(bowl_world, cone(), loads=4, planner=GREEDY, site=SITE)
    assert whole.stopped == ""
    result = plan_loads(
        bowl_world, cone(), loads=4, planner=GREEDY, site=SITE, budget=int(0.6 * whole.spent)
    )
    assert result.stopped == "budget"
    count = len(result.costs)
    assert 1 <= count < 4
    np.testing.assert_allclose(result.plan.pose.x, whole.plan.pose.x[:count], rtol=1e-5)
    with pytest.raises(InputError, match="too small for a first plan"):
        plan_loads(bowl_world, cone(), loads=4, planner=GREEDY, site=SITE, budget=1)


def test_an_interrupted_search_keeps_what_was_found() -> None:
    def progress(stage: str, done: int, *_: Any) -> None:
        if stage == "greedy" and done == 2:
            raise KeyboardInterrupt

    result = plan_loads(bowl_world, cone(), loads=4, planner=GREEDY, site=SITE, progress=progress)
    assert result.stopped == "interrupted"
    assert len(result.costs) == 2
    assert result.plan.truck is None

    def at_once(*_: Any) -> None:
        raise KeyboardInterrupt

    planner = Nominal(actions=2, rows=2, refine_steps=0)
    with pytest.raises(KeyboardInterrupt):
        plan_loads(bowl_world, cone(), loads=2, planner=planner, site=SITE, progress=at_once)


def test_a_plan_says_which_loads_each_truck_gets(tmp_path: Path) -> None:
    result = plan_loads(bowl_world, cone(), amount=Trucks(2, 8.0), planner=GREEDY, site=SITE)
    from wlplan.report.document import plan_document

    document = plan_document(cone(), result, site=SITE, amount=Trucks(2, 8.0))
    assert document["job"] == amount_fields(Trucks(2, 8.0))
    assert [truck["loads"] for truck in document["trucks"]] == [[0, 1, 2], [3, 4, 5]]
    wlplan.write_plan(tmp_path / "plan.json", document)
    plan, _ = wlplan.read_plan(tmp_path / "plan.json")
    np.testing.assert_array_equal(plan.truck, [0, 0, 0, 1, 1, 1])
    document["trucks"][1]["loads"] = [4, 3, 5]
    with pytest.raises(InputError, match="does not say in turn which loads"):
        wlplan.write_plan(tmp_path / "plan.json", document)
