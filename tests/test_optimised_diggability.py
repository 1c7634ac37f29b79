"""The best heading and action of each location: where it is known, it is found."""

import json
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cones import cone
from pages import Page

import wlplan
from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.errors import InputError
from wlplan.planning.poses import MAX_OFFSET
from wlplan.report.diggability_document import Optimised, map_fields
from wlplan.report.diggability_page import render_map, shades_of
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.studies.diggability import PAPER_ACTION, foreseen_on_map
from wlplan.studies.map_costs import with_driving
from wlplan.studies.optimised_diggability import (
    LocalSearch,
    optimised_map,
    optimised_maps,
)
from wlplan.terrain.toe import ToeContour
from wlplan.types import Action, Performance, Pile, Pose, action_vector

LOCATIONS = 6
# The best action there is, and how far off the way to the middle the best heading is [rad].
BEST, OFF = np.array([0.3, 3.0, 0.5, 1.5]), 0.1
LEAST_TIME, MASS = 8.0, 4.0


def off_middle(pose: Pose) -> jax.Array:
    """How far a heading is off the way to the middle of the cone, which is at zero [rad]."""
    inward = jnp.arctan2(-pose.y, -pose.x)
    return jnp.arctan2(jnp.sin(pose.heading - inward), jnp.cos(pose.heading - inward))


def missed(action: Action) -> jax.Array:
    """Squared distance to the best action, in parts of the box."""
    span = np.array(ACTION_HIGH) - np.array(ACTION_LOW)
    squared: jax.Array = (((action_vector(action) - BEST) / span) ** 2).sum()
    return squared


def bowl(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """The same load everywhere; it takes longer the further the decisions are off the best."""
    time = LEAST_TIME + 40.0 * missed(action) + 200.0 * (off_middle(pose) - OFF) ** 2
    return pile, Performance(MASS + 0.0 * pose.x, time, 300.0 + 0.0 * pose.x)


def eager(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """The further a heading is turned to the left, the faster."""
    time = LEAST_TIME + 40.0 * missed(action) - 5.0 * off_middle(pose)
    return pile, Performance(MASS + 0.0 * pose.x, time, 300.0 + 0.0 * pose.x)


def spike(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Nothing comes near the paper's action."""
    apart = jnp.abs(action_vector(action) - action_vector(PAPER_ACTION)).max()
    time = jnp.where(apart < 1e-6, LEAST_TIME, 20.0) + 0.0 * pose.x
    return pile, Performance(MASS + 0.0 * pose.x, time, 300.0 + 0.0 * pose.x)


def ring(radius: float = 5.0, count: int = 400, first: float = 0.0) -> ToeContour:
    """A circular toe around zero, whose inward normals lead to it; it begins at an angle [rad]."""
    angle = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False) + first
    return ToeContour(
        points=radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        heading=np.arctan2(-np.sin(angle), -np.cos(angle)),
        length=2.0 * math.pi * radius,
        closed=True,
        accessible=np.ones(count, bool),
    )


def mapped(world: Any, **options: Any) -> Any:
    """An `OptimisedMap`; of type Any, since what a map has depends on how it was made."""
    return optimised_map(world, cone(), locations=LOCATIONS, contour=ring(), **options)


@pytest.fixture(scope="module")
def found() -> Any:
    return mapped(bowl, search=LocalSearch(steps=60))


def test_the_best_decisions_are_found(found: Any) -> None:
    np.testing.assert_allclose(found.offset, OFF, atol=0.01)
    span = np.array(ACTION_HIGH) - np.array(ACTION_LOW)
    off = (np.asarray(action_vector(found.best.action)) - BEST) / span
    assert np.abs(off).max() < 0.05
    np.testing.assert_allclose(found.best.performance.time, LEAST_TIME, rtol=0.02)
    np.testing.assert_allclose(found.best.rate, 3600.0 * MASS / LEAST_TIME, rtol=0.02)


def test_the_gain_is_that_of_the_closed_form(found: Any) -> None:
    fixed = LEAST_TIME + 40.0 * float(missed(PAPER_ACTION)) + 200.0 * OFF**2
    np.testing.assert_allclose(found.fixed.performance.time, fixed, rtol=1e-3)
    np.testing.assert_allclose(found.gain, 100.0 * (fixed / LEAST_TIME - 1.0), rtol=0.05)
    # Of the rate, it is so many per cent more t/h.
    np.testing.assert_allclose(found.gain, 100.0 * (found.best.rate / found.fixed.rate - 1.0), 1e-3)


def test_the_fixed_part_is_the_fixed_map(found: Any) -> None:
    fixed = wlplan.diggability_map(bowl, cone(), locations=LOCATIONS, contour=ring())
    for name in ("pose", "performance"):
        jax.tree.map(
            lambda mine, its: np.testing.assert_allclose(mine, its, rtol=1e-6),
            getattr(found.fixed, name),
            getattr(fixed, name),
        )
    np.testing.assert_array_equal(found.best.pose.x, found.fixed.pose.x)


def test_a_heading_stays_within_its_limit() -> None:
    offset = np.asarray(mapped(eager).offset)
    assert (offset <= MAX_OFFSET).all()
    assert (offset > 0.8 * MAX_OFFSET).all()


def test_headings_are_within_half_a_turn() -> None:
    # The inward normal of the first place is 3 degrees short of half a turn.
    contour = ring(first=math.radians(-33.0))
    found: Any = optimised_map(
        bowl, cone(), locations=LOCATIONS, contour=contour, search=LocalSearch(steps=60)
    )
    assert np.asarray(found.fixed.pose.heading + found.offset).max() > math.pi
    assert np.abs(found.best.pose.heading).max() <= math.pi
    turn = np.asarray(found.best.pose.heading) - np.asarray(found.fixed.pose.heading)
    np.testing.assert_allclose(np.cos(turn), np.cos(found.offset), atol=1e-5)


def test_the_best_is_never_worse_than_the_fixed_action() -> None:
    found = mapped(spike)
    np.testing.assert_array_equal(found.offset, 0.0)
    np.testing.assert_array_equal(found.gain, 0.0)
    for name, value in vars(PAPER_ACTION).items():
        np.testing.assert_allclose(getattr(found.best.action, name), value, rtol=1e-6)


def test_without_a_derivative_the_best_of_what_was_tried_is_taken(found: Any) -> None:
    tried = mapped(wlplan.world(bowl, differentiable=False), search=LocalSearch(steps=60))
    assert (tried.best.cost <= tried.fixed.cost).all()
    assert (np.asarray(found.best.cost) < tried.best.cost).all()
    assert not np.asarray(tried.offset).any()


def test_another_objective_finds_another_best() -> None:
    by_work = mapped(bowl, objective={"time": 1.0, "mine": lambda one: 9.0 * one.action.k_bm})
    assert (np.asarray(by_work.best.action.k_bm) < 1.0).all()
    assert (np.asarray(by_work.best.cost) < np.asarray(by_work.fixed.cost)).all()


def test_many_maps_in_one_call_are_what_they_are_alone() -> None:
    piles = [cone(), cone().replace(height=0.5 * np.asarray(cone().height))]
    rings = [ring(), ring(4.0)]
    search = LocalSearch(steps=60)
    both = optimised_maps(bowl, piles, locations=LOCATIONS, contours=rings, search=search)
    for pile, contour, one in zip(piles, rings, both, strict=True):
        alone = optimised_map(bowl, pile, locations=LOCATIONS, contour=contour, search=search)
        jax.tree.map(lambda mine, its: np.testing.assert_allclose(mine, its, rtol=1e-5), one, alone)


def test_maps_of_several_sizes_and_none_are_refused() -> None:
    small = Pile(np.zeros((8, 8), np.float32), 0.1)
    with pytest.raises(InputError, match="maps of one size"):
        optimised_maps(bowl, [cone(), small])
    with pytest.raises(InputError, match="at least one"):
        optimised_maps(bowl, [])
    with pytest.raises(InputError, match="knows"):
        mapped(bowl, objective={"stall": 1.0})


@pytest.mark.slow
def test_with_a_receiver_the_driving_counts() -> None:
    site = Site(receiver=Receiver(*(jnp.float32(v) for v in (0.0, -12.0, math.pi / 2.0))))
    found = mapped(bowl, site=site)
    fixed = wlplan.diggability_map(bowl, cone(), locations=LOCATIONS, contour=ring())
    driven: Any = with_driving(bowl, cone(), fixed, site)
    np.testing.assert_allclose(found.fixed.transport.time, driven.transport.time, rtol=1e-3)
    # The farther side of the pile is farther from the truck.
    assert np.argmax(driven.transport.time) == np.argmax(np.asarray(driven.pose.y))
    assert (found.fixed.rate < fixed.rate).all()
    assert (np.asarray(found.best.cost) <= np.asarray(found.fixed.cost)).all()
    performance = driven.performance
    np.testing.assert_allclose(
        driven.cost,
        2.0 * 4.29 / np.hypot(performance.mass, 0.1)
        + (performance.time + driven.transport.time) / 46.3
        + (performance.work + driven.transport.work) / 1033.0
        + 2.0 * driven.transport.touching,
        rtol=1e-4,
    )


def test_what_a_world_foresees_is_said_at_each_action(found: Any) -> None:
    knows = wlplan.world(
        bowl,
        stall_probability=lambda pile, pose, action: action.k_bm / 5.0,
        uncertainty=lambda pile, pose, action: Performance(
            0.1 + 0.0 * pose.x, action.k_bk, 9.0 + 0.0 * pose.x
        ),
    )
    at_best: Any = foreseen_on_map(knows, cone(), found.best)
    np.testing.assert_allclose(at_best.stall_probability, found.best.action.k_bm / 5.0, rtol=1e-6)
    np.testing.assert_allclose(at_best.deviation.time, found.best.action.k_bk, rtol=1e-6)
    plain: Any = wlplan.diggability_map(bowl, cone(), locations=LOCATIONS, contour=ring())
    assert foreseen_on_map(bowl, cone(), plain) == (None, None)
    everywhere: Any = foreseen_on_map(knows, cone(), plain)
    np.testing.assert_allclose(
        everywhere.stall_probability, float(PAPER_ACTION.k_bm) / 5.0, rtol=1e-6
    )


def test_the_file_and_the_page_say_what_was_found(found: Any) -> None:
    optimised = Optimised(found.fixed, np.asarray(found.offset), found.gain, "rate")
    fields = map_fields(found.best.replace(cost=None), PAPER_ACTION, optimised=optimised)
    assert json.loads(json.dumps(fields)) == fields
    first = fields["locations"][0]
    assert first["action"]["k_bm"] == pytest.approx(float(found.best.action.k_bm[0]))
    assert first["fixed"]["time"] == pytest.approx(float(found.fixed.performance.time[0]))
    assert fields["summary"]["rate"]["mean"] == pytest.approx(float(found.best.rate.mean()))
    document = {
        "frame": {"offset": [0.0, 0.0, 0.0], "crs": None},
        "notes": [],
        "pile": {},
        **fields,
    }
    shades = shades_of(document)
    assert set(shades) == {"mass", "time", "work", "rate", "fixed", "gain"}
    np.testing.assert_allclose(shades["gain"].values, found.gain)
    page = Page(render_map(document, cone()))
    for words in ("best heading and action of each place, by rate", "one action everywhere"):
        assert words in " ".join(page.text.split())
    assert len(page.links) == 6


@pytest.mark.slow
def test_in_the_shipped_world_the_best_is_worth_it() -> None:
    pile = wlplan.relax(wlplan.seed_pile("conical", slope=math.radians(30.0), height=4.0, seed=1))
    found: Any = optimised_map(wlplan.load_world("hybrid"), pile, locations=20)
    assert np.isfinite(found.gain).all()
    assert (found.gain > 20.0).all()
    action = np.asarray(action_vector(found.best.action))
    assert ((action >= ACTION_LOW) & (action <= ACTION_HIGH)).all()
    assert (np.abs(found.offset) <= MAX_OFFSET).all()
    thorough = optimised_map(
        wlplan.load_world("hybrid"),
        pile,
        locations=20,
        search=LocalSearch(offsets=(-0.5, 0.0, 0.5), actions=48, refined=3, steps=100, rate=0.2),
    )
    assert found.best.rate.mean() > 0.97 * thorough.best.rate.mean()
