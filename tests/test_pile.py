"""Laws and closed forms of seed piles, resampling, the toe contour and the estimated ground."""

import math
from typing import Any

import numpy as np
import pytest
from laws import volume

from wlplan.errors import InputError
from wlplan.site.machine import WA320
from wlplan.terrain.floor import estimate_ground, fill_unseen
from wlplan.terrain.resampling import resample
from wlplan.terrain.seed_piles import SEED_PILES, seed_pile
from wlplan.terrain.toe import toe_contour
from wlplan.types import Pile

CELL = 0.1
SLOPE = math.radians(30.0)


def grid(side: float = 20.0, cell: float = CELL) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of a square map centred at the origin [m]."""
    line = cell * (np.arange(round(side / cell) + 1)) - 0.5 * side
    return np.meshgrid(line, line, indexing="ij")


def cone(
    x: np.ndarray,
    y: np.ndarray,
    height: float = 3.0,
    slope: float = SLOPE,
    centre: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    return height - math.tan(slope) * np.hypot(x - centre[0], y - centre[1])


def pile_of(
    height: np.ndarray,
    ground: np.ndarray | None = None,
    valid: np.ndarray | None = None,
    cell: float = CELL,
    side: float = 20.0,
) -> Pile:
    return Pile(
        height=np.asarray(height, np.float32),
        cell_size=cell,
        origin=(-0.5 * side, -0.5 * side),
        ground=None if ground is None else np.asarray(ground, np.float32),
        valid=valid,
    )


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    angle: np.ndarray = np.abs((a - b + math.pi) % (2.0 * math.pi) - math.pi)
    return angle


def assert_one_line(error: pytest.ExceptionInfo[InputError]) -> None:
    assert "\n" not in str(error.value)
    assert len(str(error.value)) > 20


# --- floor


def test_without_a_ground_the_floor_is_at_level_zero() -> None:
    height = np.full((50, 60), 2.0)
    np.testing.assert_allclose(pile_of(height, ground=height - 0.5).floor, 1.5)
    assert not pile_of(height).floor.any()


# --- seed piles


@pytest.mark.parametrize(("kind", "slope"), [*SEED_PILES, ("prism", SLOPE)])
def test_seed_piles_outlast_thirty_loadings_and_fit_the_grid(kind: str, slope: float) -> None:
    pile = seed_pile(kind, slope=slope)
    height = np.asarray(pile.height)
    assert max(height.shape) <= 221
    assert height.min() == 0.0
    if kind != "prism":
        assert volume(pile) > 2.0 * 30 * 2.0
    margin = round(3.0 / CELL)
    inner = np.zeros_like(height, dtype=bool)
    inner[margin:-margin, margin:-margin] = True
    assert not height[~inner].any()  # level ground at 0 all around
    contour = toe_contour(pile)
    assert contour.closed
    assert contour.accessible.all()


def test_there_are_six_seed_piles() -> None:
    assert len(set(SEED_PILES)) == 6


@pytest.mark.parametrize("kind", ["triangular", "conical", "wedge", "prism"])
@pytest.mark.parametrize("degrees", [20.0, 30.0])
def test_the_face_has_its_slope(kind: str, degrees: float) -> None:
    pile = seed_pile(kind, slope=math.radians(degrees), noise=0.0)
    height = np.asarray(pile.height)
    middle = height[:, height.shape[1] // 2]
    half_way = np.flatnonzero(middle > 0.5 * middle.max())[0]  # on the face that rises along +x
    slope = (middle[half_way + 2] - middle[half_way - 2]) / (4 * CELL)
    assert math.degrees(math.atan(slope)) == pytest.approx(degrees, abs=0.1)


@pytest.mark.parametrize("kind", ["triangular", "conical", "prism"])
def test_piles_without_noise_are_symmetric(kind: str) -> None:
    height = np.asarray(seed_pile(kind, slope=SLOPE, noise=0.0).height)
    np.testing.assert_allclose(height, height[::-1], atol=1e-5)
    np.testing.assert_allclose(height, height[:, ::-1], atol=1e-5)


def test_volume_of_a_ridge_in_closed_form() -> None:
    height, length, run = 2.0, 6.0, 2.0 / math.tan(SLOPE)
    end = height / math.tan(math.radians(32.0))
    want = height * run * length + math.pi * run * end * height / 3.0
    pile = seed_pile("triangular", slope=SLOPE, height=height, length=length, noise=0.0)
    assert volume(pile) == pytest.approx(want, rel=0.01)


def test_noise_is_seeded_and_has_its_amplitude() -> None:
    plain = seed_pile("conical", slope=SLOPE, noise=0.0)
    first, again, other = (seed_pile("conical", slope=SLOPE, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.height, again.height)
    assert np.abs(first.height - other.height).max() > 0.05
    change = np.asarray(first.height - plain.height)
    assert 0.02 < change[np.asarray(plain.height) > 0.5].std() < 0.2
    assert np.abs(change).max() <= 0.2 * (1 + 1 / 2 + 1 / 4)


def test_the_same_seed_gives_the_same_surface_at_every_cell_size() -> None:
    fine, coarse = (seed_pile("conical", slope=SLOPE, cell_size=cell) for cell in (0.1, 0.2))
    offset = (np.asarray(coarse.origin) - np.asarray(fine.origin)) / 0.1
    i, j = np.rint(offset).astype(int)
    shared = np.asarray(coarse.height)[2:-2, 2:-2]
    picked = np.asarray(fine.height)[i + 4 :: 2, j + 4 :: 2][: shared.shape[0], : shared.shape[1]]
    np.testing.assert_allclose(shared, picked, atol=1e-4)


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "cubic"},
        {"slope": 0.0},
        {"slope": 30.0},  # degrees by mistake
        {"slope": math.nan},
        {"height": -1.0},
        {"length": 3.0},  # a cone has no crest
        {"cell_size": 0.0},
        {"noise": -0.1},
    ],
)
def test_seed_piles_refuse_bad_parameters(change: dict[str, Any]) -> None:
    parameters = {"kind": "conical", "slope": SLOPE, **change}
    with pytest.raises(InputError) as error:
        seed_pile(parameters.pop("kind"), **parameters)
    assert_one_line(error)


# --- resampling


@pytest.mark.parametrize("cell", [0.05, 0.07, 0.2, 0.33])
def test_resampling_keeps_the_volume(cell: float) -> None:
    pile = seed_pile("triangular", slope=SLOPE, seed=3)
    assert volume(resample(pile, cell)) == pytest.approx(float(volume(pile)), rel=1e-3)


@pytest.mark.parametrize("cell", [0.05, 0.07, 0.2, 0.33])
def test_resampling_keeps_affine_surfaces(cell: float) -> None:
    x, y = grid(8.0)
    pile = pile_of(1.0 + 0.3 * x - 0.2 * y, ground=0.3 * x - 0.2 * y, side=8.0)
    new = resample(pile, cell)
    x, y = (
        np.asarray(new.origin)[axis] + cell * np.arange(new.height.shape[axis]) for axis in (0, 1)
    )
    want = 1.0 + 0.3 * x[:, np.newaxis] - 0.2 * y
    np.testing.assert_allclose(new.height, want, atol=1e-5)
    np.testing.assert_allclose(np.asarray(new.ground), want - 1.0, atol=1e-5)


@pytest.mark.parametrize("cell", [0.05, 0.2])
def test_resampling_covers_the_same_area(cell: float) -> None:
    pile = pile_of(np.zeros((80, 60)))
    new = resample(pile, cell)
    np.testing.assert_allclose(np.array(new.height.shape) * cell, [8.0, 6.0], atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(new.origin) - 0.5 * cell, np.asarray(pile.origin) - 0.5 * CELL, atol=1e-5
    )


def test_resampling_to_the_same_spacing_changes_nothing() -> None:
    pile = seed_pile("conical", slope=SLOPE)
    assert resample(pile, CELL) is pile


@pytest.mark.parametrize("cell", [0.05, 0.07, 0.2, 0.33])
def test_a_new_cell_is_valid_if_all_that_contribute_are(cell: float) -> None:
    """Heights of unseen cells must not reach a valid one, and seen ones far off stay valid."""
    valid = np.ones((80, 80), bool)
    valid[30:40, 50:55] = valid[0, 0] = False
    pile = pile_of(np.where(valid, 1.0, 1e6), valid=valid)
    new = resample(pile, cell)
    np.testing.assert_allclose(np.asarray(new.height)[np.asarray(new.valid)], 1.0, rtol=1e-6)
    unseen = float(np.sum(~np.asarray(new.valid))) * cell**2
    assert 0.01 * 51 <= unseen <= 0.01 * 51 + (2 * 15 + 8) * CELL * 2 * max(cell, CELL)


@pytest.mark.parametrize("cell", [0.0, -0.1, math.nan, math.inf, 100.0])
def test_resampling_refuses_a_useless_spacing(cell: float) -> None:
    with pytest.raises(InputError) as error:
        resample(seed_pile("conical", slope=SLOPE), cell)
    assert_one_line(error)


# --- toe contour


def test_the_toe_of_a_cone_is_a_circle() -> None:
    centre = (1.0, -0.5)
    contour = toe_contour(pile_of(np.maximum(cone(*grid(), centre=centre), 0.0)), rise=0.15)
    radius = (3.0 - 0.15) / math.tan(SLOPE)
    away = contour.points - np.array(centre)
    np.testing.assert_allclose(np.hypot(*away.T), radius, atol=0.01)
    inward = np.arctan2(-away[:, 1], -away[:, 0])
    assert np.degrees(angle_between(contour.heading, inward)).max() < 1.0
    assert contour.length == pytest.approx(2.0 * math.pi * radius, rel=0.01)
    assert contour.closed
    assert contour.accessible.all()


def test_points_are_a_fixed_step_apart_with_the_pile_on_the_left() -> None:
    contour = toe_contour(pile_of(np.maximum(cone(*grid()), 0.0)))
    step = np.roll(contour.points, -1, axis=0) - contour.points
    np.testing.assert_allclose(np.hypot(*step.T), 0.1, rtol=0.02)
    left = np.arctan2(step[:, 0], -step[:, 1])
    assert np.degrees(angle_between(contour.heading, left)).max() < 10.0


def test_the_toe_on_tilted_ground() -> None:
    x, y = grid()
    ground = math.tan(math.radians(4.0)) * (0.6 * x + 0.8 * y)
    height = ground + np.maximum(cone(x, y), 0.0)
    contour = toe_contour(pile_of(height, ground=ground))
    np.testing.assert_allclose(
        np.hypot(*contour.points.T), (3.0 - 0.15) / math.tan(SLOPE), atol=0.01
    )
    inward = np.arctan2(-contour.points[:, 1], -contour.points[:, 0])
    assert np.degrees(angle_between(contour.heading, inward)).max() < 1.0


def test_headings_do_not_follow_ripples_of_the_toe() -> None:
    x, y = grid()
    height = np.maximum(cone(x, y) + 0.1 * np.sin(20.0 * np.arctan2(y, x)), 0.0)
    contour = toe_contour(pile_of(height))
    inward = np.arctan2(-contour.points[:, 1], -contour.points[:, 0])
    assert np.degrees(angle_between(contour.heading, inward)).max() < 10.0


def test_the_largest_pile_by_volume_is_traced_without_its_hollow() -> None:
    x, y = grid()
    tall = cone(x, y, height=3.0, centre=(-4.0, 0.0))
    tall = np.where(np.hypot(x + 4.0, y) < 0.8, 0.0, tall)  # a hollow down to the ground
    wide_and_flat = np.where(np.hypot(x - 5.5, y) < 3.5, 0.2, 0.0)
    contour = toe_contour(pile_of(np.maximum(np.maximum(tall, wide_and_flat), 0.0)))
    away = np.hypot(contour.points[:, 0] + 4.0, contour.points[:, 1])
    np.testing.assert_allclose(away, (3.0 - 0.15) / math.tan(SLOPE), atol=0.05)


def test_of_a_pile_over_the_edge_of_the_map_the_part_inside_is_kept() -> None:
    x, y = grid()
    contour = toe_contour(pile_of(np.maximum(cone(x, y, centre=(-10.0, 0.0)), 0.0)))
    radius = (3.0 - 0.15) / math.tan(SLOPE)
    assert not contour.closed
    np.testing.assert_allclose(
        np.hypot(contour.points[:, 0] + 10, contour.points[:, 1]), radius, atol=0.01
    )
    assert contour.length == pytest.approx(math.pi * radius, rel=0.01)
    assert not contour.accessible[[0, -1]].any()  # half of the bucket would be outside
    assert contour.accessible[len(contour.points) // 2]


def test_points_that_the_scan_did_not_see_are_not_accessible() -> None:
    x, y = grid()
    valid = x < 2.0
    contour = toe_contour(pile_of(np.maximum(cone(x, y), 0.0), valid=valid))
    np.testing.assert_array_equal(
        contour.accessible[np.abs(contour.points[:, 0] - 2.0) > 0.2],
        contour.points[np.abs(contour.points[:, 0] - 2.0) > 0.2, 0] < 2.0,
    )


def test_points_without_pile_ahead_are_not_accessible() -> None:
    x, y = grid()
    tongue = np.where((np.abs(y) < 0.3) & (x > 0.0) & (x < 8.0), 0.4, 0.0)
    contour = toe_contour(pile_of(np.maximum(np.maximum(cone(x, y), tongue), 0.0)))
    on_side = (contour.points[:, 0] > 6.0) & (contour.points[:, 0] < 6.5)
    assert not contour.accessible[on_side].any()


@pytest.mark.parametrize(
    ("height", "why"),
    [
        (np.zeros((100, 100)), "level"),
        (0.1 * np.ones((100, 100)), "below the rise"),
        (np.pad(np.full((15, 15), 5.0), 40), "narrower than the bucket"),
        (np.pad(np.full((30, 10), 0.2), 40), "less than a cubic metre"),
    ],
)
def test_nothing_to_dig(height: np.ndarray, why: str) -> None:
    with pytest.raises(InputError, match="Nothing to dig") as error:
        toe_contour(pile_of(height))
    assert_one_line(error)


# --- ground


def test_the_ground_under_a_cone_on_level_ground_is_exact() -> None:
    x, y = grid()
    for slope in (math.radians(20.0), math.radians(35.0)):
        for level in (0.0, 1.25):
            ground = estimate_ground(level + np.maximum(cone(x, y, 2.5, slope), 0.0), CELL)
            np.testing.assert_allclose(ground, level, atol=1e-9)


@pytest.mark.parametrize("degrees", [3.0, 5.0])
@pytest.mark.parametrize("slope", [20.0, 30.0])
def test_the_ground_under_a_cone_on_tilted_ground_is_exact(degrees: float, slope: float) -> None:
    x, y = grid()
    plane = math.tan(math.radians(degrees)) * (0.8 * x - 0.6 * y)
    surface = np.maximum(plane, cone(x, y, 2.5, math.radians(slope)))
    np.testing.assert_allclose(estimate_ground(surface, CELL), plane, atol=1e-6)


def undulating(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.1 * np.sin(2.0 * math.pi * x / 9.0) * np.cos(2.0 * math.pi * y / 7.0)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_ground_under_a_cone_on_undulating_ground(noise: float) -> None:
    x, y = grid()
    ground = undulating(x, y)
    surface = np.maximum(ground, cone(x, y)) + noise * np.random.default_rng(0).normal(size=x.shape)
    found = estimate_ground(surface, CELL)
    assert np.sqrt(np.mean((found - ground) ** 2)) < 0.05
    true_volume = np.sum(np.maximum(ground, cone(x, y)) - ground)
    assert np.sum(surface - found) == pytest.approx(true_volume, rel=0.02)


def test_the_ground_is_never_above_the_surface_and_equals_it_off_the_pile() -> None:
    x, y = grid()
    random = np.random.default_rng(1)
    surface = np.maximum(undulating(x, y), cone(x, y)) + 0.02 * random.normal(size=x.shape)
    ground = estimate_ground(surface, CELL)
    assert (ground <= surface).all()
    far = np.hypot(x, y) > 3.0 / math.tan(SLOPE) + 1.0
    np.testing.assert_array_equal(ground[far], surface[far])


def test_ground_without_a_pile_is_the_surface() -> None:
    x, y = grid(10.0)
    np.testing.assert_array_equal(estimate_ground(undulating(x, y), CELL), undulating(x, y))


def test_stones_and_kerbs_are_part_of_the_ground() -> None:
    x, y = grid()
    kerb = np.where(np.abs(x + 8.0) < 0.1, 0.2, 0.0)
    ground = estimate_ground(np.maximum(kerb, cone(x, y)), CELL)
    np.testing.assert_allclose(ground, kerb, atol=1e-9)


def test_the_ground_under_a_flat_topped_pile_and_a_pile_at_the_edge() -> None:
    x, y = grid()
    flat_top = np.clip(cone(x, y, 5.0), 0.0, 1.8)
    np.testing.assert_allclose(estimate_ground(flat_top, CELL), 0.0, atol=1e-9)
    corner = np.maximum(cone(x, y, centre=(-9.0, -9.0)), 0.0)
    np.testing.assert_allclose(estimate_ground(corner, CELL), 0.0, atol=1e-9)


def test_a_map_with_no_ground_in_sight_gets_a_level_one() -> None:
    x, _ = grid(6.0)
    surface = 5.0 + math.tan(SLOPE) * x
    np.testing.assert_array_equal(estimate_ground(surface, CELL), surface.min())


def test_a_large_pile_is_solved_on_coarser_grids() -> None:
    x, y = grid(40.0)
    plane = 0.03 * x
    surface = np.maximum(plane, cone(x, y, 9.0))
    np.testing.assert_allclose(estimate_ground(surface, CELL), plane, atol=1e-6)


def test_unseen_cells_are_filled_smoothly() -> None:
    x, y = grid(10.0)
    surface = 0.2 * x - 0.1 * y
    valid = np.hypot(x, y) > 2.0
    filled = fill_unseen(np.where(valid, surface, np.nan), valid)
    np.testing.assert_allclose(filled, surface, atol=1e-9)  # a plane is harmonic
    rough = np.where(valid, np.sin(3.0 * x) * np.sin(2.0 * y), np.nan)
    filled = fill_unseen(rough, valid)
    np.testing.assert_array_equal(filled[valid], rough[valid])
    assert filled.min() >= np.nanmin(rough)
    assert filled.max() <= np.nanmax(rough)


def test_a_large_hole_is_filled_too() -> None:
    x, y = grid(40.0)
    valid = np.maximum(np.abs(x), np.abs(y)) > 16.0
    filled = fill_unseen(np.where(valid, 0.05 * x + 1.0, np.nan), valid)
    np.testing.assert_allclose(filled, 0.05 * x + 1.0, atol=0.01)


def test_a_map_that_was_not_seen_at_all_is_refused() -> None:
    with pytest.raises(InputError) as error:
        fill_unseen(np.zeros((5, 5)), np.zeros((5, 5), bool))
    assert_one_line(error)


def test_the_bucket_the_headings_are_smoothed_over_is_the_machines() -> None:
    assert WA320.bucket_width == pytest.approx(2.7)
