"""A diggability map is one batched call that says what single calls of the world say."""

import math
from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np
import pytest

from wlplan.errors import InputError
from wlplan.studies.diggability import PAPER_ACTION, diggability_map
from wlplan.terrain.heightmap import sample
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import ToeContour, edge_poses, toe_contour
from wlplan.types import Action, Performance, Pile, Pose


@pytest.fixture(scope="module")
def pile() -> Pile:
    return seed_pile("conical", slope=math.radians(30.0), height=2.0, seed=3)


def world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """Looks at the pile a metre ahead; the pile after is expensive nonsense that nobody needs."""
    ahead = sample(
        pile.height, pile, pose.x + jnp.cos(pose.heading), pose.y + jnp.sin(pose.heading)
    )
    after = pile.replace(height=pile.height * action.k_bm)
    return after, Performance(ahead + action.delta_bm, 8.0 + pose.heading, 100.0 * action.k_bk)


def ring(count: int = 40, *, closed: bool = True, blocked: Iterable[int] = ()) -> ToeContour:
    """A circular toe of radius 5 m, or an open arc of it, with points that are not accessible."""
    turn = 2.0 * math.pi if closed else math.pi
    angle = np.linspace(0.0, turn, count, endpoint=not closed)
    accessible = np.ones(count, bool)
    accessible[list(blocked)] = False
    return ToeContour(
        points=5.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        heading=np.arctan2(-np.sin(angle), -np.cos(angle)),
        length=5.0 * turn,
        closed=closed,
        accessible=accessible,
    )


def test_the_map_says_what_single_calls_say(pile: Pile) -> None:
    found = diggability_map(world, pile, locations=7)
    for n in range(7):
        pose = Pose(*(leaf[n] for leaf in (found.pose.x, found.pose.y, found.pose.heading)))
        _, single = world(pile, pose, PAPER_ACTION)
        for name in ("mass", "time", "work"):
            np.testing.assert_allclose(
                getattr(found.performance, name)[n], getattr(single, name), rtol=1e-5
            )


def test_the_action_is_passed_on(pile: Pile) -> None:
    action = Action(0.1, 1.0, 0.2, 3.0)
    found = diggability_map(world, pile, locations=3, action=action)
    np.testing.assert_allclose(found.performance.work, 300.0, rtol=1e-6)


def test_every_leaf_has_one_value_a_location(pile: Pile) -> None:
    found = diggability_map(world, pile)
    for leaf in (found.pose.x, found.pose.heading, found.performance.mass, found.performance.work):
        assert leaf.shape == (150,)


def test_poses_lie_on_the_toe_and_look_inward(pile: Pile) -> None:
    pose = edge_poses(toe_contour(pile), 60)
    centre = np.asarray(pile.origin) + 0.05 * (np.array(pile.height.shape) - 1)
    inward = np.arctan2(centre[1] - pose.y, centre[0] - pose.x)
    assert np.abs(np.angle(np.exp(1j * (pose.heading - inward)))).max() < 0.8
    rise = sample(pile.height, pile, jnp.asarray(pose.x), jnp.asarray(pose.y))
    np.testing.assert_allclose(rise, 0.15, atol=0.02)


def test_poses_are_evenly_spaced_also_where_they_outnumber_the_points() -> None:
    for locations in (9, 200):
        pose = edge_poses(ring(), locations)
        step = np.hypot(np.diff(pose.x), np.diff(pose.y))
        assert step.max() < 1.02 * step.min()
        np.testing.assert_allclose(np.hypot(pose.x, pose.y), 5.0, atol=0.02)
        towards = np.arctan2(-np.asarray(pose.y), -np.asarray(pose.x))
        np.testing.assert_allclose(np.cos(pose.heading - towards), 1.0, atol=1e-5)


def test_no_pose_lies_where_a_bucket_cannot_start() -> None:
    contour = ring(blocked=range(5, 15))
    pose = edge_poses(contour, 100)
    angle = np.arctan2(pose.y, pose.x) % (2.0 * math.pi)
    step = 2.0 * math.pi / 40
    assert not ((angle > 4.01 * step) & (angle < 14.99 * step)).any()


def test_an_open_contour_is_not_bridged() -> None:
    pose = edge_poses(ring(closed=False), 100)
    assert np.min(pose.y) >= -1e-9
    np.testing.assert_allclose(np.hypot(pose.x, pose.y), 5.0, atol=0.02)


def test_a_toe_without_access_is_refused() -> None:
    with pytest.raises(InputError, match="start nowhere"):
        edge_poses(ring(blocked=range(40)), 10)


def test_the_number_of_locations_has_to_be_positive(pile: Pile) -> None:
    with pytest.raises(InputError, match="at least one"):
        diggability_map(world, pile, locations=0)
