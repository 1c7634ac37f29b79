"""The toes of all piles of a map, and places shared out among them."""

import numpy as np
import pytest
from cones import on_map

import wlplan
from wlplan.errors import InputError
from wlplan.studies.diggability import diggability_map
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.terrain.toes import poses_around, toes_of
from wlplan.types import Action, Performance, Pile, Pose

LARGE, SMALL, HEAP = (7.0, 8.0), (20.0, 8.0), (14.0, 1.5)


def test_each_pile_has_its_toe_the_largest_first() -> None:
    toes = toes_of(on_map((SMALL, 3.0), (LARGE, 5.0)))
    for toe, middle, radius in zip(toes, (LARGE, SMALL), (5.0, 3.0), strict=True):
        away = np.hypot(*(toe.contour.points - middle).T)
        # The toe is where the surface stands 0.15 m high.
        np.testing.assert_allclose(away, radius - 0.15 / 0.577, atol=0.05)
        assert (toe.part.x, toe.part.y) == pytest.approx(middle, abs=0.1)


def test_a_single_pile_has_the_toe_that_it_has_alone() -> None:
    pile = on_map((LARGE, 5.0))
    (toe,) = toes_of(pile)
    alone = toe_contour(pile)
    np.testing.assert_array_equal(toe.contour.points, alone.points)
    np.testing.assert_array_equal(toe.contour.accessible, alone.accessible)


def test_what_is_too_small_for_a_bucket_is_left_out() -> None:
    (toe,) = toes_of(on_map((LARGE, 5.0), (HEAP, 1.2)))
    assert toe.part.x == pytest.approx(LARGE[0], abs=0.1)
    with pytest.raises(InputError, match="Nothing to dig"):
        toes_of(on_map((HEAP, 1.2)))
    with pytest.raises(InputError, match="Nothing to dig"):
        toes_of(on_map())


def test_a_pile_stands_in_the_way_to_another() -> None:
    near = on_map((LARGE, 5.0), ((15.5, 8.0), 3.0))
    largest = toes_of(near)[0].contour
    # Where the other one is in the lane, no bucket starts.
    east = (largest.points[:, 0] > LARGE[0] + 4.0) & (abs(largest.points[:, 1] - 8.0) < 1.0)
    west = largest.points[:, 0] < LARGE[0] - 4.0
    assert not largest.accessible[east].any()
    assert largest.accessible[west].all()


def test_places_are_shared_out_by_length() -> None:
    contours = [toe.contour for toe in toes_of(on_map((LARGE, 5.0), (SMALL, 3.0)))]
    for locations in (2, 9, 40, 41):
        pose, number = poses_around(contours, locations)
        assert len(pose.x) == len(number) == locations
        counts = np.bincount(number)
        assert counts.min() >= 1
        if locations >= 40:
            assert counts[0] / counts[1] == pytest.approx(4.74 / 2.74, rel=0.1)
        for k, middle in enumerate((LARGE, SMALL)):
            away = np.hypot(*(np.stack([pose.x, pose.y])[:, number == k].T - middle).T)
            assert away.max() < 5.0
    with pytest.raises(InputError, match="1 dig locations asked for on 2 piles"):
        poses_around(contours, 1)


def test_a_map_goes_around_all_piles_and_around_one_as_before() -> None:
    def world(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
        return pile, Performance(pose.x, pose.y, pose.heading)

    both, one = on_map((LARGE, 5.0), (SMALL, 3.0)), on_map((LARGE, 5.0))
    x = np.asarray(diggability_map(world, both, locations=30).pose.x)
    assert (x < 13.0).any()
    assert (x > 16.0).any()
    alone = diggability_map(world, one, locations=30).pose
    expected = edge_poses(toe_contour(one), 30)
    for name in ("x", "y", "heading"):
        np.testing.assert_array_equal(
            getattr(alone, name), np.asarray(getattr(expected, name), np.float32)
        )
    # By default of the package, too.
    np.testing.assert_array_equal(wlplan.diggability_map(world, one, locations=30).pose.x, alone.x)
