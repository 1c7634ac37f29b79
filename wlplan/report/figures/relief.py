"""The map under everything: the relief of a pile, its contour lines, and what was not seen."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.patches import Rectangle

from wlplan.report.figures.style import INK
from wlplan.terrain.standing import standing
from wlplan.types import Pile

PILE = LinearSegmentedColormap.from_list(
    "pile", ["#e4e2dc", "#e8d3a8", "#d5a766", "#a97640", "#6b472b"]
)
STONE = LinearSegmentedColormap.from_list("stone", ["#eae9e6", "#b4b1ab"])

UNSEEN: dict[str, Any] = {
    "facecolor": "#f4f4f2",
    "edgecolor": "#d3d7db",
    "hatch": "////",
    "linewidth": 0.0,
}
"""How ground looks that the scan did not see."""

STANDS = "#5d6875"
"""Colour of walls and of all else that stands there and is not soil."""

# Rise above the ground that counts as pile [m], as for the toe contour.
RISE = 0.15
# Spacings of contour lines to choose from [m]; the widest that gives at least this many is taken.
_CONTOUR_STEPS = (2.0, 1.0, 0.5, 0.25, 0.1)
_LEAST_CONTOURS = 4
# Ground shown around the pile [m].
_MARGIN = 2.0
# Where light comes from on maps, counter-clockwise from east [rad].
_NORTH_WEST = math.radians(135.0)


def height_above_ground(pile: Pile) -> Float[np.ndarray, "nx ny"]:
    """Height of the surface above the ground [m]."""
    height: np.ndarray = np.asarray(pile.height, float) - np.asarray(pile.floor, float)
    return height


def _extent(pile: Pile) -> tuple[float, float, float, float]:
    """Outer borders of the grid [m]: left, right, bottom, top."""
    low = np.asarray(pile.origin, float) - 0.5 * pile.cell_size
    high = low + pile.cell_size * np.array(pile.height.shape)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def view_of(pile: Pile, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2 2"]:
    """Lower left and upper right corner of what to show [m]: the pile, the points, a margin."""
    cells = np.argwhere(height_above_ground(pile) > RISE)
    if len(cells) == 0:
        cells = np.array([[0, 0], pile.height.shape])
    shown = np.asarray(pile.origin, float) + pile.cell_size * cells
    shown = np.concatenate([shown, points])
    return np.stack([shown.min(axis=0) - _MARGIN, shown.max(axis=0) + _MARGIN])


def grow_to_ratio(view: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    """Widen the shorter side of a view until neither is more than 1.4 times the other."""
    size = view[1] - view[0]
    grow = 0.5 * np.maximum(size.max() / 1.4 - size, 0.0)
    return np.stack([view[0] - grow, view[1] + grow])


def shaped(
    view: Float[np.ndarray, "2 2"],
    ratio: tuple[float, float],
    *,
    towards: Float[np.ndarray, "2"] | None = None,
) -> Float[np.ndarray, "2 2"]:
    """Widen one side of a view until its height over its width is within limits.

    Args:
        view: Lower left and upper right corner [m].
        ratio: The least and the largest.
        towards: A place to grow to, if it is not in the middle [m]; None: to both sides alike.
    """
    width, height = (float(side) for side in np.ptp(view, axis=0))
    least, most = ratio
    grow = np.array([max(height / most - width, 0.0), max(least * width - height, 0.0)])
    share = np.full(2, 0.5)
    if towards is not None:
        # The place comes to the middle, as far as that goes.
        want = (towards - view.mean(axis=0)) / np.maximum(grow, 1e-9) + 0.5
        share = np.clip(want, 0.0, 1.0)
    return np.stack([view[0] - (1.0 - share) * grow, view[1] + share * grow])


def brightness(
    height: Float[np.ndarray, "nx ny"], cell_size: float, *, light_from: float = _NORTH_WEST
) -> Float[np.ndarray, "nx ny"]:
    """Brightness of a lit surface, 1 where it is level.

    Args:
        height: Of the surface [m].
        cell_size: Grid spacing [m].
        light_from: Where the light comes from, counter-clockwise from +x [rad].
    """
    # Light at 40 degrees above the horizon; slopes are drawn 1.3 times as steep.
    elevation, exaggeration = math.radians(40.0), 1.3
    east, north = np.gradient(exaggeration * height, cell_size)
    light = np.array([math.cos(light_from), math.sin(light_from)]) * math.cos(elevation)
    facing = (math.sin(elevation) - east * light[0] - north * light[1]) / np.sqrt(
        1.0 + east**2 + north**2
    )
    shade: np.ndarray = np.clip(1.0 + 0.6 * (facing - math.sin(elevation)), 0.4, 1.13)
    return shade


def draw_pile(
    panel: Axes,
    pile: Pile,
    colours: LinearSegmentedColormap,
    norm: Normalize,
    *,
    contour_alpha: float = 0.55,
) -> None:
    """Shaded heights above the ground, contour lines, and hatching over unseen cells."""
    above = height_above_ground(pile)
    surface = np.asarray(pile.height, float)
    image = colours(norm(above))[..., :3]
    image[standing(np.asarray(pile.floor), pile.cell_size)] = to_rgb(STANDS)
    image = image * brightness(surface, pile.cell_size)[..., np.newaxis]
    panel.imshow(
        np.clip(image, 0.0, 1.0).transpose(1, 0, 2),
        origin="lower",
        extent=_extent(pile),
        interpolation="bilinear",
        zorder=1,
    )
    # Beyond the scan nothing was seen either.
    panel.add_patch(Rectangle((0.0, 0.0), 1.0, 1.0, transform=panel.transAxes, zorder=0, **UNSEEN))
    x, y = _axes_of(pile)
    step = contour_step(float(norm.vmax or 0.0))
    levels = np.arange(step, float(above.max()), step)
    if levels.size:
        panel.contour(
            x, y, above.T, levels, colors=INK, linewidths=0.5, alpha=contour_alpha, zorder=2
        )
    if pile.valid is not None and not np.asarray(pile.valid).all():
        _hatch(panel, pile, ~np.asarray(pile.valid))


def _hatch(panel: Axes, pile: Pile, unseen: Bool[np.ndarray, "nx ny"]) -> None:
    # A border of seen cells closes the outline of unseen ones at the edge of the map.
    flags = np.pad(unseen.astype(float), 1)
    x, y = _axes_of(pile)
    x, y = (np.concatenate([[2 * a[0] - a[1]], a, [2 * a[-1] - a[-2]]]) for a in (x, y))
    grey = panel.contourf(
        x,
        y,
        flags.T,
        levels=[0.5, 1.5],
        colors=[UNSEEN["facecolor"]],
        hatches=[UNSEEN["hatch"]],
        zorder=3,
    )
    grey.set_edgecolor(UNSEEN["edgecolor"])
    grey.set_linewidth(UNSEEN["linewidth"])


def draw_toe(panel: Axes, pile: Pile, style: str) -> None:
    """Outline of where a pile stands or stood."""
    above = height_above_ground(pile)
    if above.max() > RISE:
        panel.contour(
            *_axes_of(pile),
            above.T,
            levels=[RISE],
            colors=[INK],
            linewidths=1.1,
            linestyles=style,
            zorder=4,
        )


def _axes_of(pile: Pile) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]]:
    """Positions of the cell centres along x and y [m]."""
    origin = np.asarray(pile.origin, float)
    nx, ny = pile.height.shape
    return origin[0] + pile.cell_size * np.arange(nx), origin[1] + pile.cell_size * np.arange(ny)


def contour_step(highest: float) -> float:
    """Spacing of contour lines on a pile of that height [m]."""
    return next((s for s in _CONTOUR_STEPS if highest / s >= _LEAST_CONTOURS), _CONTOUR_STEPS[-1])
