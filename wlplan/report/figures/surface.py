"""Surfaces seen from above and aside: shaded, without perspective, cut off at their borders.

The points are projected here and drawn as flat patches from back to front: a figure of many
surfaces is then as quick and as tight as one of maps, and lines on a surface go through the same
projection.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize

from wlplan.report.figures.relief import brightness
from wlplan.report.figures.style import BLUE, ORANGE

# Colour of the cuts along the borders, which have no light of their own.
_CUT = np.array([0.80, 0.77, 0.72])
DIFFERENCE = LinearSegmentedColormap.from_list(
    "difference", [BLUE, "#9fbbdb", "#e9e6df", "#f0b98a", ORANGE]
)
"""Colours of what a surface is too low or too high by; where it is neither, one of stone."""

# Drawn this much wider than they are [point], or the white behind shows between patches.
_SEAM = 0.25


@dataclasses.dataclass(frozen=True)
class View:
    """From where a surface is looked at, from so far away that parallels stay parallel.

    Attributes:
        azimuth: Direction to which one looks, counter-clockwise from +x [rad].
        elevation: How far one looks down [rad].
        exaggeration: How many times as high as it is everything is drawn.
    """

    azimuth: float = math.radians(65.0)
    elevation: float = math.radians(32.0)
    exaggeration: float = 1.0

    @property
    def light_from(self) -> float:
        """Where the light comes from: over the left shoulder [rad]."""
        return self.azimuth + math.radians(120.0)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Where points are in the picture: to the right and up [m]."""
        along, aside = self._turned(points)
        up = self.exaggeration * points[..., 2]
        high = up * math.cos(self.elevation) + along * math.sin(self.elevation)
        return np.stack([aside, high], axis=-1)

    def depth(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """How far away along the ground points are [m]."""
        return self._turned(points)[0]

    def _turned(
        self, points: Float[np.ndarray, "*n 3"]
    ) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        x, y = points[..., 0], points[..., 1]
        return np.asarray(c * x + s * y), np.asarray(s * x - c * y)


FROM_BEHIND = View(azimuth=math.radians(50.0), elevation=math.radians(30.0))
"""For local heightmaps: the loader digs to the right and back."""


def draw_surface(
    panel: Axes,
    height: Float[np.ndarray, "nx ny"],
    cell_size: float,
    colours: Colormap,
    norm: Normalize,
    *,
    values: Float[np.ndarray, "nx ny"] | None = None,
    corner: tuple[float, float] = (0.0, 0.0),
    base: float | None = None,
    view: View = View(),
) -> None:
    """Draws a shaded surface and what its borders cut; the panel loses its axes.

    Args:
        panel: That is drawn into.
        height: Of the grid points [m].
        cell_size: Grid spacing [m].
        colours: Of the values.
        norm: Range of the values.
        values: What the colours say; by default the heights.
        corner: Where the first grid point lies [m].
        base: How deep the borders are cut [m]; None for no cuts.
        view: From where.
    """
    nx, ny = height.shape
    x = corner[0] + cell_size * np.arange(nx)
    y = corner[1] + cell_size * np.arange(ny)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), height], axis=-1).astype(float)
    seen = view.project(points)
    patches = np.stack([seen[:-1, :-1], seen[1:, :-1], seen[1:, 1:], seen[:-1, 1:]], axis=2)
    shown = _middles(height if values is None else values)
    # Where colours say something else than heights, light and shade must not hide them.
    contrast = 1.0 if values is None else 0.6
    raised = view.exaggeration * np.asarray(height, float)
    light = brightness(raised, cell_size, light_from=view.light_from)
    lit = 1.0 + contrast * (_middles(light) - 1.0)
    colour = colours(norm(shown))[..., :3] * lit[..., None]
    order = np.argsort(-_middles(view.depth(points)), axis=None)
    polygons, faces = patches.reshape(-1, 4, 2)[order], colour.reshape(-1, 3)[order]
    if base is not None:
        cuts, cut_faces = _cuts(points, base, view)
        polygons, faces = np.concatenate([polygons, cuts]), np.concatenate([faces, cut_faces])
    faces = np.clip(faces, 0.0, 1.0)
    panel.add_collection(
        PolyCollection(list(polygons), facecolors=faces, edgecolors=faces, linewidths=_SEAM),
        autolim=False,
    )
    panel.update_datalim(polygons.reshape(-1, 2))
    panel.autoscale_view()
    panel.set_aspect("equal")
    panel.set_axis_off()


def _middles(field: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "mx my"]:
    """Means of the corners of each patch."""
    parts = (field[:-1, :-1], field[1:, :-1], field[1:, 1:], field[:-1, 1:])
    middles: np.ndarray = np.mean(parts, axis=0, dtype=float)
    return middles


def _cuts(
    points: Float[np.ndarray, "nx ny 3"], base: float, view: View
) -> tuple[Float[np.ndarray, "m 4 2"], Float[np.ndarray, "m 3"]]:
    """The two borders that face the eye, down to a base, and their colours."""
    c, s = math.cos(view.azimuth), math.sin(view.azimuth)
    borders = (
        points[0 if c > 0.0 else -1],
        points[:, 0 if s > 0.0 else -1],
    )
    polygons, faces = [], []
    # Whatever faces the eye more has more light.
    for border, facing in zip(borders, (abs(c), abs(s)), strict=True):
        below = border.copy()
        below[:, 2] = np.minimum(base, border[:, 2])
        corners = [border[:-1], border[1:], below[1:], below[:-1]]
        polygons.append(view.project(np.stack(corners, axis=1)))
        faces.append(np.tile(_CUT * (0.82 + 0.18 * facing), (len(border) - 1, 1)))
    return np.concatenate(polygons), np.concatenate(faces)
