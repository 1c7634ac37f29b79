"""Figures come out for odd cases too, as valid PNG, and labels stay readable when crowded."""

import dataclasses
import itertools
import math
import struct
import zlib
from pathlib import Path
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Rectangle

from wlplan.errors import InputError
from wlplan.report import figures as plots
from wlplan.report.figures.digs import MOST_NUMBERED, number_places
from wlplan.report.figures.plan import PlanOnPile, has_unseen, key_of
from wlplan.report.figures.relief import brightness, shaped
from wlplan.report.pictures import galleries_of
from wlplan.site.receiver import Receiver
from wlplan.studies.diggability import DiggabilityMap
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import Action, LoadingPlan, Performance, Pile, Pose


@pytest.fixture(scope="module")
def pile() -> Pile:
    return seed_pile("conical", slope=math.radians(30.0), height=2.0, seed=1)


def receiver_at(x: float, y: float, heading: float = 0.5) -> Receiver:
    return Receiver(*(jnp.asarray(value) for value in (x, y, heading)))


def plan_at(x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> LoadingPlan:
    count = len(x)
    return LoadingPlan(
        Pose(*(jnp.asarray(values, jnp.float32) for values in (x, y, heading))),
        Action(*(jnp.full(count, value) for value in (0.5, 2.0, 0.5, 2.0))),
    )


def plan_of(pile: Pile, loads: int) -> LoadingPlan:
    pose = edge_poses(toe_contour(pile), 150)
    return plan_at(*(np.asarray(leaf)[:loads] for leaf in (pose.x, pose.y, pose.heading)))


def performance_of(loads: int, seed: int = 0) -> Performance:
    random = np.random.default_rng(seed)
    return Performance(*(jnp.asarray(random.uniform(1.0, 3.0, loads)) for _ in range(3)))


def size_of(png: bytes) -> tuple[int, int]:
    """Width and height of a PNG whose chunks are all intact."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at, kinds = 8, []
    while at < len(png):
        length, kind = struct.unpack(">I4s", png[at : at + 8])
        body = png[at + 4 : at + 8 + length]
        assert zlib.crc32(body) == struct.unpack(">I", png[at + 8 + length : at + 12 + length])[0]
        kinds.append(kind)
        at += length + 12
    assert kinds[-1] == b"IEND"
    return struct.unpack(">II", png[16:24])


def drawn(figure: Figure) -> Figure:
    width, height = size_of(plots.png_bytes(figure, dpi=40))
    assert min(width, height) > 100
    return figure


def on(pile: Pile, loads: int, **more: Any) -> PlanOnPile:
    return PlanOnPile(pile, plan_of(pile, loads), **more)


def way_from(x: float, y: float) -> np.ndarray:
    """Back by 4 m, and 6 m ahead and to the side."""
    back = [[x - s, y, 0.0, -1.0] for s in range(5)]
    return np.array([*back, *([x - 4.0 + s, y - s, 0.0, 1.0] for s in range(7))])


def numbers_on(figure: Figure) -> list[str]:
    return [t.get_text() for t in figure.axes[0].texts if t.get_text().isdigit()]


@pytest.mark.parametrize("loads", [1, 3, MOST_NUMBERED])
def test_a_plan_is_drawn(pile: Pile, loads: int) -> None:
    figure = drawn(plots.plan_figure(on(pile, loads), pile))
    assert numbers_on(figure) == [str(n) for n in range(1, loads + 1)]


def test_colours_say_the_order_of_many_digs(pile: Pile) -> None:
    figure = drawn(plots.plan_figure(on(pile, 80), pile))
    assert numbers_on(figure) == ["1", *(str(n) for n in range(10, 81, 10))]
    (dots,) = (one for one in figure.axes[0].collections if isinstance(one, PathCollection))
    brightness = np.asarray(dots.get_facecolor())[:, :3].sum(axis=1)
    assert len(brightness) == 80
    assert (np.diff(brightness) <= 0.0).all()
    assert brightness[0] > brightness[-1] + 1.0


def test_arrows_point_along_the_headings_and_end_at_the_digs(pile: Pile) -> None:
    shown = on(pile, 3)
    figure = plots.work_figure(shown)
    figure.canvas.draw()
    arrows = [one for one in figure.axes[0].patches if isinstance(one, FancyArrowPatch)]
    assert len(arrows) == 3
    for arrow, dig, heading in zip(arrows, shown.digs, shown.heading, strict=True):
        start, end = (np.array(point) for point in arrow._posA_posB)  # type: ignore[attr-defined]
        np.testing.assert_allclose(end, dig)
        ahead = np.array([math.cos(heading), math.sin(heading)])
        np.testing.assert_allclose(end - start, 5.0 * ahead, atol=1e-5)


def test_the_legs_of_a_way_are_told_apart_by_their_lines(pile: Pile) -> None:
    shown = on(pile, 2, receiver=receiver_at(-10.0, -3.0))
    ways = [way_from(*dig) for dig in shown.digs]
    kinds = [line.kind for line in key_of(shown)]
    assert "reverse" not in kinds
    known = dataclasses.replace(shown, ways=ways)
    assert {"reverse", "forward"} < {line.kind for line in key_of(known)}
    figure = drawn(plots.work_figure(known))
    styles = [
        one.get_linestyle()
        for one in figure.axes[0].lines
        if isinstance(one, Line2D) and len(np.asarray(one.get_xdata())) > 4
    ]
    assert styles == ["--", "-"] * 2


def test_a_truck_is_drawn_near_and_pointed_at_far_away(pile: Pile) -> None:
    for place, words in (((-12.0, -3.0), "truck"), ((300.0, 40.0), "m")):
        shown = on(pile, 3, receiver=receiver_at(*place))
        figure = drawn(plots.plan_figure(shown, pile))
        assert any(words in t.get_text() for t in figure.axes[0].texts)
        # The frame is tight.
        sides = [
            np.ptp(limits) for limits in (figure.axes[0].get_xlim(), figure.axes[0].get_ylim())
        ]
        assert min(np.array(sides) - np.ptp(shown.points, axis=0)) < 2.0
        assert max(sides) < 30.0


def test_the_frame_holds_all_that_is_near(pile: Pile) -> None:
    shown = on(pile, 3, receiver=receiver_at(-10.0, -3.0))
    shown = dataclasses.replace(shown, ways=[way_from(*dig) for dig in shown.digs])
    (left, right), (low, high) = (
        plots.work_figure(shown).axes[0].get_xlim(),
        plots.work_figure(shown).axes[0].get_ylim(),
    )
    parts = [*(way[:, :2] for way in shown.ways), *(truck.body for truck in shown.trucks)]
    for part in (shown.digs, *parts):
        assert ((part > (left, low)) & (part < (right, high))).all()


def test_unseen_ground_is_in_the_key_where_there_is_some(pile: Pile) -> None:
    valid = np.ones(pile.height.shape, bool)
    valid[:20], valid[40:44, 50:60] = False, False
    hatched = on(pile.replace(valid=jnp.asarray(valid)), 2)
    drawn(plots.plan_figure(hatched, pile))
    assert "unseen" in [line.kind for line in key_of(hatched)]
    inside = np.array([[-3.0, -3.0], [3.0, 3.0]])
    assert not has_unseen(pile, inside)
    assert has_unseen(pile, 3.0 * inside)


def test_a_wall_is_in_the_key_and_another_colour_than_soil(pile: Pile) -> None:
    wall = np.zeros(pile.height.shape)
    wall[-6:-3, 10:-10] = 2.5
    walled = pile.replace(ground=jnp.asarray(wall), height=jnp.maximum(pile.height, wall))
    words = [line.words for line in key_of(on(walled, 2))]
    assert any("not soil" in one for one in words)
    assert not any("not soil" in line.words for line in key_of(on(pile, 2)))
    drawn(plots.plan_figure(on(walled, 2), walled))


def test_the_pile_of_every_few_loads_is_drawn(pile: Pile) -> None:
    shown = on(pile, 12)
    few = plots.step_figure(shown, pile, slice(2, 4))
    assert numbers_on(few) == ["3", "4"]
    assert few.axes[0].get_title() == "Loads 3 to 4"
    many = plots.step_figure(shown, pile, slice(0, 12))
    assert min(size_of(plots.png_bytes(many, dpi=100))) > 200
    assert numbers_on(many) == ["1", "12"]
    # All have one frame, in which the numbers lie.
    assert few.axes[0].get_xlim() == many.axes[0].get_xlim()


def test_the_gallery_of_a_plan_says_what_is_seen(pile: Pile) -> None:
    shown = on(pile, 5)
    heights = np.asarray(pile.height)[None] * np.linspace(1.0, 0.9, 5)[:, None, None]
    played = performance_of(5)
    found = galleries_of(shown, pile.replace(height=heights[-1]), heights=heights, simulated=played)
    assert [len(gallery.pictures) for gallery in found] == [2, 5, 6]
    assert "before each load" in found[1].title
    for gallery in found:
        for picture in gallery.pictures:
            size_of(picture.png)
    alts = [picture.alt for gallery in found for picture in gallery.pictures]
    assert len(set(alts)) == len(alts)
    assert "5 digs as arrows" in alts[0]
    assert "10 % of it is gone" in alts[1]
    mass = np.asarray(played.mass)
    assert alts[7] == f"Mass of each load: simulated {mass.min():.2f} to {mass.max():.2f} t."
    assert [len(one.pictures) for one in galleries_of(shown, pile, simulated=played)] == [2, 6]


def test_a_pile_that_runs_over_the_edge_of_the_map_is_drawn(pile: Pile) -> None:
    half = pile.replace(height=pile.height[: pile.height.shape[0] // 2])
    assert not toe_contour(half).closed
    drawn(plots.plan_figure(on(half, 5), half))


def test_a_pile_that_is_dug_away_is_drawn(pile: Pile) -> None:
    gone = pile.replace(height=pile.height * 0.0)
    drawn(plots.plan_figure(on(pile, 2), gone))


def test_crowded_numbers_lie_on_their_arrows_and_never_over_each_other() -> None:
    random = np.random.default_rng(0)
    digs = np.array([3.4, 0.0]) + random.normal(0.0, 0.3, (40, 2))
    heading = math.pi + random.normal(0.0, 0.2, 40)
    radius = 0.4
    places = number_places(digs, heading, radius, range(40))
    apart = [np.hypot(*(a - b)) for a, b in itertools.combinations(places, 2)]
    assert min(apart) > 2.0 * radius
    back = np.arctan2(*(digs - places).T[::-1])
    np.testing.assert_allclose(np.cos(back - heading), 1.0, atol=1e-9)
    assert len(number_places(digs, heading, radius, [0, 39])) == 2


def test_a_view_grows_towards_a_place_and_no_further_than_it_has_to() -> None:
    view = np.array([[0.0, 0.0], [10.0, 2.0]])
    for towards, low in ((np.array([5.0, 1.0]), -1.5), (np.array([5.0, 50.0]), 0.0), (None, -1.5)):
        grown = shaped(view, (0.5, 1.0), towards=towards)
        np.testing.assert_allclose(np.ptp(grown, axis=0), [10.0, 5.0])
        assert grown[0, 1] == pytest.approx(low)
    np.testing.assert_array_equal(shaped(view, (0.1, 1.0)), view)


def test_slopes_that_face_the_light_are_brighter() -> None:
    x = np.arange(20.0)[:, np.newaxis] * np.ones(20)
    level, west, east = (brightness(slope * x, 1.0) for slope in (0.0, 0.5, -0.5))
    np.testing.assert_allclose(level, 1.0)
    assert west.min() > 1.0 > east.max()


@pytest.mark.parametrize("loads", [1, 15])
def test_totals_are_drawn_with_and_without_a_simulation(loads: int) -> None:
    figure = drawn(plots.totals_figure(performance_of(loads), performance_of(loads, 1)))
    assert len(figure.axes) == 6
    assert "difference" in figure.axes[3].texts[0].get_text()
    drawn(plots.totals_figure(performance_of(loads)))


def test_a_chart_of_one_quantity_is_the_one_of_all_of_them() -> None:
    predicted, simulated = performance_of(15), performance_of(15, 1)
    whole = plots.totals_figure(predicted, simulated, performance_of(15, 2))
    for row, accumulated in enumerate((False, True)):
        for column, name in enumerate(("mass", "time", "work")):
            one = drawn(plots.total_figure(name, accumulated, predicted, simulated))
            for mine, its in zip(
                one.axes[0].lines, whole.axes[3 * row + column].lines, strict=True
            ):
                np.testing.assert_array_equal(mine.get_ydata(), its.get_ydata())
    # What the ensemble does not know is a band.
    assert len(whole.axes[0].collections) == 1
    assert not plots.totals_figure(predicted, simulated).axes[0].collections


def test_totals_of_empty_loads_are_drawn() -> None:
    nothing = Performance(*(jnp.zeros(3) for _ in range(3)))
    drawn(plots.totals_figure(nothing, nothing))


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_a_diggability_map_is_drawn_also_where_all_is_the_same(pile: Pile, spread: float) -> None:
    pose = edge_poses(toe_contour(pile), 30)
    performance = Performance(*(2.0 + spread * np.linspace(0.0, 1.0, 30) for _ in range(3)))
    figure = drawn(plots.diggability_figure(pile, DiggabilityMap(pose, performance)))
    assert sum(cast("Rectangle", patch).get_height() for patch in figure.axes[3].patches) == 30


def test_a_map_of_one_location_is_drawn(pile: Pile) -> None:
    pose = edge_poses(toe_contour(pile), 1)
    one = Performance(*(np.ones(1) for _ in range(3)))
    drawn(plots.diggability_figure(pile, DiggabilityMap(pose, one)))


def test_figures_are_saved_in_one_piece_or_not_at_all(tmp_path: Path) -> None:
    figure = plots.totals_figure(performance_of(2))
    plots.save_figure(tmp_path / "totals.png", figure, dpi=40)
    size_of((tmp_path / "totals.png").read_bytes())
    assert [path.name for path in tmp_path.iterdir()] == ["totals.png"]
    with pytest.raises(InputError, match="cannot be written"):
        plots.save_figure(tmp_path / "missing" / "totals.png", figure, dpi=40)


def test_the_same_figure_gives_the_same_bytes(pile: Pile) -> None:
    one, two = (plots.png_bytes(plots.plan_figure(on(pile, 2), pile), dpi=40) for _ in range(2))
    assert one == two
