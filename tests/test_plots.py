"""Figures come out for odd cases too, as valid PNG, and labels stay readable when crowded."""

import itertools
import math
import struct
import zlib
from pathlib import Path
from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from wlplan.errors import InputError
from wlplan.report import figures as plots
from wlplan.report.figures.digs import (
    MOST_NUMBERED,
    _first_crossing,
    _on_pile,
    label_places,
)
from wlplan.report.figures.relief import _relief
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


@pytest.mark.parametrize("loads", [1, 3, MOST_NUMBERED])
def test_a_plan_is_drawn(pile: Pile, loads: int) -> None:
    figure = drawn(plots.plan_figure(pile, pile, plan_of(pile, loads)))
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == [str(n) for n in range(1, loads + 1)]


def test_colours_say_the_order_of_many_digs(pile: Pile) -> None:
    figure = drawn(plots.plan_figure(pile, pile, plan_of(pile, 80)))
    assert not figure.axes[0].texts
    (dots,) = (one for one in figure.axes[0].collections if isinstance(one, PathCollection))
    brightness = np.asarray(dots.get_facecolor())[:, :3].sum(axis=1)
    assert len(brightness) == 80
    assert (np.diff(brightness) <= 0.0).all()
    assert brightness[0] > brightness[-1] + 1.0


def test_a_truck_is_drawn_near_and_pointed_at_far_away(pile: Pile) -> None:
    for place, words in (((-12.0, -3.0), "truck"), ((300.0, 40.0), "m")):
        figure = drawn(
            plots.plan_figure(pile, pile, plan_of(pile, 3), receiver=receiver_at(*place))
        )
        assert all(any(words in t.get_text() for t in panel.texts) for panel in figure.axes[:2])
        width = np.ptp(figure.axes[0].get_xlim())
        assert width < 60.0


def test_unseen_cells_are_hatched(pile: Pile) -> None:
    valid = np.ones(pile.height.shape, bool)
    valid[:20], valid[40:44, 50:60] = False, False
    hatched = plots.plan_figure(pile.replace(valid=jnp.asarray(valid)), pile, plan_of(pile, 2))
    drawn(hatched)
    assert "not seen" in hatched.get_supxlabel()
    assert "not seen" not in plots.plan_figure(pile, pile, plan_of(pile, 2)).get_supxlabel()


def test_a_pile_that_runs_over_the_edge_of_the_map_is_drawn(pile: Pile) -> None:
    half = pile.replace(height=pile.height[: pile.height.shape[0] // 2])
    assert not toe_contour(half).closed
    drawn(plots.plan_figure(half, half, plan_of(half, 5)))


def test_a_pile_that_is_dug_away_is_drawn(pile: Pile) -> None:
    drawn(plots.plan_figure(pile, pile.replace(height=pile.height * 0.0), plan_of(pile, 2)))


def test_crowded_labels_do_not_overlap_nor_cover_the_pile(pile: Pile) -> None:
    random = np.random.default_rng(0)
    digs = np.array([3.4, 0.0]) + random.normal(0.0, 0.3, (40, 2))
    heading = math.pi + random.normal(0.0, 0.2, 40)
    radius = 0.4
    labels = label_places(digs, heading, radius, pile)
    apart = [np.hypot(*(a - b)) for a, b in itertools.combinations(labels, 2)]
    assert min(apart) > 2.0 * radius
    assert not _on_pile(labels, pile).any()
    assert _first_crossing(digs, labels) is None


def test_crossing_lines_are_found() -> None:
    starts, ends = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0, 1.0], [0.0, 1.0]])
    assert _first_crossing(starts, ends) == (0, 1)
    assert _first_crossing(starts, ends[::-1]) is None


def test_slopes_that_face_the_light_are_brighter() -> None:
    x = np.arange(20.0)[:, np.newaxis] * np.ones(20)
    level, west, east = (_relief(slope * x, 1.0) for slope in (0.0, 0.5, -0.5))
    np.testing.assert_allclose(level, 1.0)
    assert west.min() > 1.0 > east.max()


@pytest.mark.parametrize("loads", [1, 15])
def test_totals_are_drawn_with_and_without_a_simulation(loads: int) -> None:
    figure = drawn(plots.totals_figure(performance_of(loads), performance_of(loads, 1)))
    assert len(figure.axes) == 6
    assert "difference" in figure.axes[3].texts[0].get_text()
    drawn(plots.totals_figure(performance_of(loads)))


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
    one, two = (
        plots.png_bytes(plots.plan_figure(pile, pile, plan_of(pile, 2)), dpi=40) for _ in range(2)
    )
    assert one == two
