"""Surfaces from aside: the projection, what hides what, and colours that survive in the file."""

import io
import math

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap, Normalize
from PIL import Image

from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, bare_figure, new_figure
from wlplan.report.figures.surface import View, draw_surface

TWO = ListedColormap(["#0000ff", "#ff0000"])


def test_what_is_further_lies_higher_and_nothing_goes_aside_on_the_way() -> None:
    view = View(azimuth=math.radians(70.0), elevation=math.radians(30.0))
    ahead = np.array([math.cos(view.azimuth), math.sin(view.azimuth), 0.0])
    near, far, over = view.project(np.stack([0.0 * ahead, ahead, np.array([0.0, 0.0, 1.0])]))
    np.testing.assert_allclose(near, 0.0)
    np.testing.assert_allclose(far, [0.0, math.sin(view.elevation)], atol=1e-12)
    np.testing.assert_allclose(over, [0.0, math.cos(view.elevation)], atol=1e-12)
    assert view.depth(ahead) == pytest.approx(1.0)
    # What lies to the right of the way is to the right.
    right = np.array([ahead[1], -ahead[0], 0.0])
    np.testing.assert_allclose(view.project(right), [1.0, 0.0], atol=1e-12)


def test_seen_from_straight_above_it_is_a_map() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    seen = View(azimuth=math.radians(90.0), elevation=math.radians(90.0)).project(points)
    np.testing.assert_allclose(seen, points[:, :2], atol=1e-12)


def pixels(height: np.ndarray, values: np.ndarray, view: View) -> np.ndarray:
    """How many pixels are more blue and how many more red than anything else."""
    figure = new_figure(3.0, 3.0)
    panel = figure.subplots()
    draw_surface(panel, height, 0.1, TWO, Normalize(0.0, 1.0), values=values, view=view)
    image = np.asarray(Image.open(io.BytesIO(png_bytes(figure, dpi=60))).convert("RGB"), float)
    red, green, blue = np.moveaxis(image, -1, 0)
    return np.array([(blue > red + green + 50).sum(), (red > blue + green + 50).sum()])


@pytest.mark.parametrize("azimuth", [10.0, 100.0, 190.0, 280.0])
def test_a_ridge_hides_what_lies_behind_it(azimuth: float) -> None:
    view = View(azimuth=math.radians(azimuth), elevation=math.radians(25.0))
    x, y = np.meshgrid(*(np.arange(-20, 21) * 0.1,) * 2, indexing="ij")
    depth = view.depth(np.stack([x, y, 0.0 * x], axis=-1))
    ridge = np.maximum(1.5 - 3.0 * np.abs(depth), 0.0)
    behind = ((depth > 0.6) & (depth < 1.4)).astype(float)
    shown, hidden = pixels(0.0 * x, behind, view), pixels(ridge, behind, view)
    assert shown[1] > 400
    assert hidden[1] < 0.1 * shown[1]


@pytest.mark.parametrize("azimuth", [45.0, 135.0, 225.0, 315.0])
def test_the_two_borders_that_face_the_eye_are_cut(azimuth: float) -> None:
    panel = new_figure(2.0, 2.0).subplots()
    view = View(azimuth=math.radians(azimuth))
    height = np.zeros((4, 6))
    draw_surface(panel, height, 1.0, TWO, Normalize(0.0, 1.0), base=-1.0, view=view)
    (drawn,) = (one for one in panel.collections if isinstance(one, PolyCollection))
    assert len(drawn.get_paths()) == 3 * 5 + 3 + 5
    # A cut goes down: nothing of the surface lies lower in the picture.
    lows = [np.asarray(path.vertices)[:, 1].min() for path in drawn.get_paths()]
    assert int(np.argmin(lows)) >= 3 * 5


def test_colours_of_few_pixels_survive_where_they_are_asked_for() -> None:
    def kept(rare: bool) -> float:
        figure = bare_figure(4.0, 4.0)
        panel = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        browns = np.random.default_rng(0).uniform(0.2, 1.0, (300, 300, 1)) * np.array(
            [0.9, 0.7, 0.5]
        )
        panel.imshow(browns + np.random.default_rng(1).uniform(-0.1, 0.1, browns.shape))
        panel.plot([150.0], [150.0], "s", ms=3.0, color=BLUE)
        content = png_bytes(figure, dpi=100, rare_colours=rare)
        image = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), int)
        return float((image[..., 2] - image[..., 0]).max())

    assert kept(True) > 100.0
    assert kept(True) > kept(False)
