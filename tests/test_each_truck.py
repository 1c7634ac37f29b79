"""A place for each truck: planned, played again, written, read and drawn."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE, bowl_world, cone, wide_cone

from wlplan.errors import InputError
from wlplan.planning.amounts import Loads, Made, Trucks
from wlplan.planning.job import make_job, with_toe
from wlplan.planning.plan import plan_loads, play
from wlplan.planning.planners import Greedy
from wlplan.planning.playing import PlanResult
from wlplan.report import figures
from wlplan.report.document import plan_document
from wlplan.report.stands import stands_of
from wlplan.site.receiver import Receiver
from wlplan.site.receiver import stands_of as stands_of_receiver
from wlplan.site.site import Site
from wlplan.site.stands import stands
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose

GREEDY = Greedy(actions=8, refine_steps=10, refined=2, poses_per_metre=0.5)
# West and east of the cone.
PLACES = np.array([[-12.5, 4.0, 1.3], [12.5, -4.0, -1.84], [-12.5, 4.0, 1.3]])


def receivers(places: np.ndarray) -> Receiver:
    return Receiver(*(jnp.asarray(column, jnp.float32) for column in places.T))


def plan() -> LoadingPlan:
    """Five loads in the west for three trucks."""
    count = 5
    turn = math.pi + np.linspace(-0.3, 0.3, count)
    pose = Pose(
        *(
            jnp.asarray(v, jnp.float32)
            for v in (4.7 * np.cos(turn), 4.7 * np.sin(turn), turn - math.pi)
        )
    )
    action = Action(*(jnp.full(count, value, jnp.float32) for value in (0.3, 2.0, 0.5, 3.5)))
    return LoadingPlan(pose, action, jnp.asarray([0, 0, 1, 2, 2]))


def played(site: Site) -> PlanResult:
    return play(bowl_world, cone(), plan(), site=site, amount=Trucks(3, 6.0), objective="delivery")


def test_who_stands_where_in_words() -> None:
    assert stands(["a"]) == stands(["a", "a", "a"]) == [("truck", 0)]
    assert stands(["a", "b", "a", "c"]) == [("trucks 1, 3", 0), ("truck 2", 1), ("truck 4", 3)]
    assert stands_of_receiver(receivers(PLACES)) == [("trucks 1, 3", 0), ("truck 2", 1)]
    assert stands_of_receiver(SITE.placed_receiver) == [("truck", 0)]


def test_loads_go_to_the_place_of_their_truck() -> None:
    """Each load has the transport that it has where all trucks stand at that place."""
    both = played(Site(receiver=receivers(PLACES)))
    west, east = (
        played(Site(receiver=jax.tree.map(lambda leaf, k=k: leaf[k], receivers(PLACES))))
        for k in (0, 1)
    )
    for name in ("time", "work"):
        there, here, found = (np.asarray(getattr(r.transport, name)) for r in (east, west, both))
        np.testing.assert_allclose(found[[0, 1, 3, 4]], here[[0, 1, 3, 4]], rtol=1e-5)
        np.testing.assert_allclose(found[2], there[2], rtol=1e-5)
        # The way around the cone is longer.
        assert there[2] > 1.3 * here[2]


def test_places_and_trucks_have_to_fit() -> None:
    site = Site(receiver=receivers(PLACES[:2]))
    with pytest.raises(InputError, match="places for 2 trucks, but the plan is for 3"):
        played(site)
    with pytest.raises(InputError, match="but the plan is for 0"):
        play(bowl_world, cone(), plan().replace(truck=None), site=site)
    with pytest.raises(InputError, match="receiver for each of several trucks"):
        with_toe(make_job(bowl_world, cone(), site=site))


def test_what_does_not_go_with_trucks_is_told() -> None:
    with pytest.raises(InputError, match="the truck is 'best': give 'auto' or 'each'"):
        plan_loads(bowl_world, cone(), truck="best")
    for amount in (Loads(3), None):
        with pytest.raises(InputError, match="goes with an amount of trucks"):
            plan_loads(bowl_world, cone(), amount=amount, truck="each")


def test_trucks_are_planned_one_by_one() -> None:
    amount = Trucks(4, 20.0)
    for trucks, follows in ((0, 1), (2, 1), (3, 0)):
        part = amount.next_truck(Made(trucks=trucks), 4.0)
        assert part is not None
        one: Any = part[0]
        assert (one.count, one.follows) == (1, follows)
        assert part[1] >= 5 + 2
    assert amount.next_truck(Made(trucks=4), 4.0) is None


def sides_world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Digs are worth something in the east; once something is dug there only in the west."""
    after, performance = bowl_world(pile, pose, action)
    dug = jnp.maximum(pile.height[0, 0], jnp.where(pose.x > 0.0, 0.01, 0.0))
    after = after.replace(height=after.height.at[0, 0].set(dug))
    good = jnp.where(pile.height[0, 0] > 0.0, pose.x < -2.0, pose.x > 2.0)
    part = jnp.where(good, 1.0, 0.1)
    return after, performance.replace(mass=part * performance.mass)


@pytest.mark.slow
def test_each_truck_stands_where_its_loads_are() -> None:
    pile: Any = wide_cone()
    amount = Trucks(2, 1.6)
    one, each = (
        plan_loads(sides_world, pile, amount=amount, planner=GREEDY, truck=name)
        for name in ("auto", "each")
    )
    assert one.receiver is not None
    assert np.ndim(one.receiver.x) == 0
    assert each.receiver is not None
    x = np.asarray(each.receiver.x)
    assert x.shape == (2,)
    assert x[0] > 0.0 > x[1]
    assert np.asarray(each.plan.truck).max() == 1
    again = play(
        sides_world,
        pile,
        each.plan,
        amount=amount,
        objective="delivery",
        site=Site(receiver=each.receiver),
    )
    np.testing.assert_allclose(again.transport.time, each.transport.time, rtol=1e-3)
    assert float(again.transport.time.sum()) < float(one.transport.time.sum())


def document_of(result: PlanResult, site: Site) -> dict[str, Any]:
    return plan_document(
        cone(), result, site=site, amount=Trucks(3, 6.0), objective="delivery", pile={"file": "a"}
    )


def test_a_plan_says_where_each_truck_stands() -> None:
    site = Site(receiver=receivers(PLACES))
    document = document_of(played(site), site)
    found = [[truck[name] for name in ("x", "y", "heading")] for truck in document["trucks"]]
    np.testing.assert_allclose(found, PLACES, atol=1e-5)
    assert document["receiver"]["x"] == -12.5
    assert [who for who, _ in stands_of(document)] == ["trucks 1, 3", "truck 2"]
    # A path ends where its truck is loaded from, and clear of that truck.
    for load, truck in zip(document["loads"], (0, 0, 1, 2, 2), strict=True):
        np.testing.assert_allclose(load["path"]["points"][-1][:3], PLACES[truck], atol=2e-3)
        assert load["clearance"] > 0.0


def test_old_plans_name_one_place() -> None:
    place = {"x": 1.0, "y": 2.0, "heading": 0.5}
    for document in ({"receiver": place}, {"receiver": place, "trucks": [{"loads": [0]}] * 2}):
        assert stands_of(document) == [("truck", place)]
    assert stands_of({"trucks": [place, place]}) == [("truck", place)]
    none: list[dict[str, Any]] = [{}, {"receiver": None}, {"trucks": 3, "receiver": 4}]
    for nothing in none:
        assert stands_of(nothing) == []


def test_a_truck_is_judged_by_the_soil_when_it_comes() -> None:
    """The second truck stands where the first loads were dug."""
    pile = cone()
    before = pile.replace(height=pile.height.at[120:160, 60:100].add(0.5))
    # On the ground that was covered only before anything was dug.
    places = np.array([[-12.5, 4.0, 1.3], [8.2, -4.2, 0.5 * math.pi], [-12.5, 4.0, 1.3]])
    site = Site(receiver=receivers(places))
    result = played(site)
    notes = [note for note in document_of(result, site)["notes"] if "stands on the pile" in note]
    assert notes == []
    covered = plan_document(
        before, result.replace(ways=None), site=site, amount=Trucks(3, 6.0), objective="delivery"
    )
    assert [note for note in covered["notes"] if "8.2, -4.2 stands on the pile" in note]
    known = plan_document(before, result, site=site, amount=Trucks(3, 6.0), objective="delivery")
    assert not [note for note in known["notes"] if "stands on the pile" in note]


def test_all_places_are_drawn() -> None:
    shown = figures.PlanOnPile(cone(), plan(), receiver=receivers(PLACES))
    figure = figures.plan_figure(shown, cone())
    words = [text.get_text() for text in figure.axes[0].texts]
    assert "trucks 1, 3" in words
    assert "truck 2" in words
