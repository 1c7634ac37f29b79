"""What the characteristics of a local heightmap mean: mean normal, slope and incidence, drawn.

Paper, figure 2: the mean normal and the slope that it has, and the angle between the way into the
pile and the heading. Map and numbers are real: a place on a seed pile, dug askew.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.patches import Arc
from matplotlib.patheffects import withStroke

import wlplan
from experiments._common.grids import packed, unpacked
from experiments._common.results import main
from wlplan.constants import CELL_SIZE
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.relief import PILE
from wlplan.report.figures.style import BLUE, INK, ORANGE, add_arrow, new_figure, tidy
from wlplan.report.figures.surface import View, draw_surface
from wlplan.terrain.characteristics import characteristics
from wlplan.terrain.heightmap import sample_local
from wlplan.types import Pose

SEED = 2
# On the toe of a cone, the heading off the way to its middle by so much [rad].
ASKEW = math.radians(28.0)
_VIEW = View(azimuth=math.radians(55.0), elevation=math.radians(28.0))
_ARROW = 1.5


def run(preset: str) -> dict[str, Any]:
    """A local heightmap and its characteristics."""
    cells = 36
    pile = wlplan.seed_pile("conical", slope=math.radians(30.0), height=4.0, seed=SEED)
    if preset != "smoke":
        pile = wlplan.relax(pile)
    # 6.6 m south of the middle.
    pose = Pose(jnp.asarray(0.0), jnp.asarray(-6.6), jnp.asarray(0.5 * math.pi + ASKEW))
    local = sample_local(pile, pose, cells=cells)
    found = characteristics(local)
    height = np.asarray(local.height, np.float64)
    return {
        "askew_degrees": round(math.degrees(ASKEW), 1),
        "characteristics": {
            field.name: float(f"{float(getattr(found, field.name)):.4g}")
            for field in dataclasses.fields(found)
        },
        "mean_normal": np.round(mean_normal(height), 4).tolist(),
        "heights": packed(height[None]),
    }


def mean_normal(height: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "3"]:
    """The unit normal of the mean of all normals of a map of the paper's cells."""
    slopes = np.stack(np.gradient(height, CELL_SIZE))
    normals = np.stack([-slopes[0], -slopes[1], np.ones_like(height)])
    mean = (normals / np.linalg.norm(normals, axis=0)).mean(axis=(1, 2))
    unit: np.ndarray = mean / np.linalg.norm(mean)
    return unit


def draw(folder: Path) -> None:
    """From aside the normal and the slope, from above the incidence, and the two curvatures."""
    result = json.loads((folder / "characteristics_picture.json").read_text())
    height = unpacked(result["heights"])[0]
    normal, found = np.array(result["mean_normal"]), result["characteristics"]
    figure = new_figure(11.0, 3.6)
    aside, above, sections = figure.subplots(1, 3, width_ratios=(1.25, 1.0, 1.1))
    norm = Normalize(float(height.min()), float(height.max()))
    _draw_slope(aside, height, normal, found["slope"], norm)
    _draw_incidence(above, height, normal, found["incidence"], norm)
    _draw_curvatures(sections, height, found)
    write_bytes_atomic(folder / "characteristics_picture.png", png_bytes(figure, dpi=120))


def _draw_slope(
    panel: Axes, height: np.ndarray, normal: np.ndarray, slope: float, norm: Normalize
) -> None:
    """The surface with its mean normal, the vertical, and the heading."""
    half = 0.5 * CELL_SIZE * (len(height) - 1)
    base = float(height.min()) - 0.15
    draw_surface(panel, height, CELL_SIZE, PILE, norm, corner=(0.0, -half), base=base, view=_VIEW)
    middle = np.array([half, 0.0, float(height[len(height) // 2, len(height) // 2])])
    ends = {"n": (normal, BLUE), "$e_z$": (np.array([0.0, 0.0, 1.0]), INK)}
    for name, (way, colour) in ends.items():
        _draw_vector(panel, middle, middle + _ARROW * way, name, colour)
    # The arc from the vertical to the normal.
    turn = np.linspace(0.0, 1.0, 20)[:, None]
    arc = turn * normal + (1.0 - turn) * np.array([0.0, 0.0, 1.0])
    arc = middle + 0.9 * arc / np.linalg.norm(arc, axis=1, keepdims=True)
    seen = _VIEW.project(arc)
    panel.plot(*seen.T, color=ORANGE, lw=1.4, zorder=6)
    panel.annotate(
        f"slope θ = {math.degrees(slope):.1f}°",
        (seen[-1, 0], seen[-1, 1]),
        xytext=(-10, -6),
        textcoords="offset points",
        color=ORANGE,
        fontsize=9,
        ha="right",
        zorder=7,
    )
    start = np.array([-1.3, 0.0, 0.0])
    _draw_vector(panel, start, np.array([-0.05, 0.0, 0.0]), "t", INK)
    panel.update_datalim(_VIEW.project(np.stack([start, middle + _ARROW * normal])))
    panel.autoscale_view()
    panel.set_title("mean normal n and slope θ", fontsize=9, color=INK)


def _draw_vector(panel: Axes, start: np.ndarray, end: np.ndarray, name: str, colour: str) -> None:
    a, b = _VIEW.project(np.stack([start, end]))
    add_arrow(panel, a, b, colour=colour, line=1.6, head=11.0, zorder=6, casing=True)
    panel.annotate(
        name, (b[0], b[1]), xytext=(4, 3), textcoords="offset points", color=colour, fontsize=10
    )


def _draw_incidence(
    panel: Axes, height: np.ndarray, normal: np.ndarray, incidence: float, norm: Normalize
) -> None:
    """The map from above; the heading goes up, and left is left."""
    along = CELL_SIZE * np.arange(len(height))
    right = 0.5 * along[-1] - along
    panel.pcolormesh(right, along, height, cmap=PILE, norm=norm)
    panel.contour(right, along, height, np.arange(-1.0, 4.0, 0.25), colors=INK, linewidths=0.4)
    # x runs ahead, y to the left: in the picture up and to the left.
    into = -normal[:2] / np.linalg.norm(normal[:2])
    middle = np.array([0.0, 0.5 * along[-1]])
    ways = {"t": (np.array([0.0, 1.0]), INK), "$-n_⊥$": (np.array([-into[1], into[0]]), BLUE)}
    for name, (way, colour) in ways.items():
        end = middle + _ARROW * way
        add_arrow(panel, middle, end, colour=colour, line=1.6, head=11.0, zorder=6, casing=True)
        panel.annotate(
            name,
            (end[0], end[1]),
            xytext=(5, 2),
            textcoords="offset points",
            color=colour,
            fontsize=10,
            path_effects=[withStroke(linewidth=2.5, foreground="white", alpha=0.85)],
        )
    angles = sorted(math.degrees(math.atan2(way[1], way[0])) for way, _ in ways.values())
    panel.add_patch(
        Arc(
            (middle[0], middle[1]),
            1.6,
            1.6,
            theta1=angles[0],
            theta2=angles[1],
            color=ORANGE,
            lw=1.4,
            zorder=6,
        )
    )
    panel.annotate(
        f"incidence α = {math.degrees(incidence):.1f}°",
        (middle[0], middle[1]),
        xytext=(0, -14),
        textcoords="offset points",
        color=ORANGE,
        fontsize=9,
        ha="center",
        path_effects=[withStroke(linewidth=2.5, foreground="white", alpha=0.85)],
    )
    panel.set_aspect("equal")
    panel.set_xlabel("to the right [m]", fontsize=8)
    panel.set_ylabel("ahead of the dig location [m]", fontsize=8)
    panel.set_title("heading t, and the way into the pile", fontsize=9, color=INK)
    tidy(panel, grid=False)


def _draw_curvatures(panel: Axes, height: np.ndarray, found: dict[str, float]) -> None:
    """Mean sections along and across the heading, and the fitted parabolas."""
    place = CELL_SIZE * (np.arange(len(height)) - 0.5 * (len(height) - 1))
    parts = (("x", "along", 1, BLUE), ("y", "across", 0, ORANGE))
    for axis, way, over, colour in parts:
        mean = height.mean(axis=over)
        curvature = found[f"curvature_{axis}"]
        # Of the mean section the fit has the same second derivative; level and slope as they are.
        rest = np.polynomial.Polynomial.fit(place, mean + 0.5 * curvature * place**2, 1)
        panel.plot(place, mean, color=colour, lw=2.4, alpha=0.35)
        label = f"{way} the heading: κ$_{axis}$ = {curvature:.3f} / m"
        panel.plot(
            place, rest(place) - 0.5 * curvature * place**2, color=colour, lw=1.2, label=label
        )
    panel.set_xlabel("from the middle of the map [m]", fontsize=8)
    panel.set_ylabel("mean height [m]", fontsize=8)
    panel.set_title("curvatures, positive where it bulges", fontsize=9, color=INK)
    panel.legend(fontsize=7.5, frameon=False)
    tidy(panel)


if __name__ == "__main__":
    main("characteristics_picture", run, draw)
