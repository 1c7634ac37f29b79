"""What mass, time, work and productivity do over two action parameters, on five shapes of pile.

The bucket's threshold and gain are swept, with which the outcomes of the data set vary most; the
boom's are in the middle of their ranges. Played on the same grid of actions, the shapes show what
slope, incidence and curvature do with all else equal.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments._common.resimulation import resimulate
from experiments._common.results import main
from wlplan.constants import ACTION_HIGH, CELL_SIZE, J_PER_KJ, KG_PER_TONNE
from wlplan.engines.simulator import Settings, dig
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import FAINT, new_figure
from wlplan.site.machine import WA320
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.terrain.heightmap import (
    PERFORMANCE_CELLS,
    PERFORMANCE_DISPLACEMENT,
    STATE_CELLS,
    STATE_DISPLACEMENT,
    local_axes,
)
from wlplan.types import LocalHeightmap

# Slope and incidence [degrees], curvature along and across [1/m]. The first is what the others are
# compared with.
SHAPES = {
    "plane": (25.0, 0.0, 0.0, 0.0),
    "gentle": (15.0, 0.0, 0.0, 0.0),
    "convex": (25.0, 0.0, 0.08, 0.08),
    "concave": (25.0, 0.0, -0.08, -0.08),
    "aslant": (25.0, 35.0, 0.0, 0.0),
}
# Not drawn: which of the two curvatures does what.
APART = {
    "convex along": (25.0, 0.0, 0.08, 0.0),
    "convex across": (25.0, 0.0, 0.0, 0.08),
    "concave along": (25.0, 0.0, -0.08, 0.0),
    "concave across": (25.0, 0.0, 0.0, -0.08),
}
# Values of the bucket's threshold and gain each; those of the boom.
POINTS = 21
BOOM = (0.5 * ACTION_HIGH[0], 0.5 * ACTION_HIGH[1])
OUTCOMES = {"mass": "t", "time": "s", "work": "kJ", "productivity": "t/min"}
# Length of the local map over which the mean slope of a curved surface is that of the plane [m].
_LENGTH = (PERFORMANCE_CELLS - 1) * CELL_SIZE


def surface(
    slope: float, incidence: float, curvature_x: float, curvature_y: float
) -> Float[np.ndarray, "52 52"]:
    """A surface over a level floor in the local frame of a dig pose [m].

    Args:
        slope: Mean slope over the local map [degrees].
        incidence: Angle between heading and the way up [degrees].
        curvature_x: Along the heading, convex positive [1/m].
        curvature_y: Across it; the mean height over the width of the bucket is kept [1/m].
    """
    along, left = local_axes(STATE_CELLS, STATE_DISPLACEMENT)
    turn = math.radians(incidence)
    up = math.cos(turn) * along[:, None] + math.sin(turn) * left
    height = math.tan(math.radians(slope)) * up
    height = height - 0.5 * curvature_x * (up * (up - _LENGTH))
    height = height - 0.5 * curvature_y * (left**2 - WA320.bucket_width**2 / 12.0)
    return np.maximum(np.where(up > 0.0, height, 0.0), 0.0)


def run(preset: str) -> dict[str, Any]:
    """Outcomes over the grid of actions, and each shape against the plane."""
    points = 3 if preset == "smoke" else POINTS
    thresholds, gains = (np.linspace(0.0, ACTION_HIGH[k], points) for k in (2, 3))
    grid = np.stack(np.meshgrid(thresholds, gains, indexing="ij"), axis=-1).reshape(-1, 2)
    actions = np.concatenate([np.tile(BOOM, (len(grid), 1)), grid], axis=1)
    shapes = SHAPES | APART
    surfaces = np.array([surface(*shape) for shape in shapes.values()])
    cycle = resimulate(
        lambda *inputs: dig(*inputs, settings=Settings()).replace(height=0.0),
        np.repeat(surfaces, len(grid), axis=0),
        np.tile(actions, (len(surfaces), 1)),
    )
    work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
    mass = cycle.mass / KG_PER_TONNE
    table = {
        "mass": mass,
        "time": cycle.time,
        "work": work / J_PER_KJ,
        "productivity": 60.0 * mass / cycle.time,
    }
    found = {name: values.reshape(len(shapes), points, points) for name, values in table.items()}
    return {
        "shapes": {
            name: _described(surfaces[k], {o: v[k] for o, v in found.items()}, thresholds, gains)
            for k, name in enumerate(SHAPES)
        },
        "against_the_plane": {
            name: {
                outcome: {
                    "mean_change": float(values[k].mean() / values[0].mean() - 1.0),
                    # Share of the actions with which it is more than on the plane.
                    "more": float((values[k] > values[0]).mean()),
                }
                for outcome, values in found.items()
            }
            for k, name in enumerate(shapes)
            if k > 0
        },
        "boom": {"delta_bm": BOOM[0], "k_bm": BOOM[1]},
        "delta_bk": thresholds.round(4).tolist(),
        "k_bk": gains.round(4).tolist(),
    }


def _described(
    height: np.ndarray, outcomes: dict[str, np.ndarray], thresholds: np.ndarray, gains: np.ndarray
) -> dict[str, Any]:
    """Characteristics of a surface, its landscape, and the most productive action."""
    first = round((STATE_DISPLACEMENT - PERFORMANCE_DISPLACEMENT) / CELL_SIZE)
    aside = (STATE_CELLS - PERFORMANCE_CELLS) // 2
    part = height[first:, aside:][:PERFORMANCE_CELLS, :PERFORMANCE_CELLS]
    shape = characteristics(
        LocalHeightmap(jnp.asarray(part, jnp.float32), CELL_SIZE, PERFORMANCE_DISPLACEMENT)
    )
    angles, curvatures = np.split(np.asarray(as_vector(shape), np.float64), 2)
    best = np.unravel_index(np.argmax(outcomes["productivity"]), outcomes["productivity"].shape)
    return {
        "slope_degrees": float(np.degrees(angles[0])),
        "incidence_degrees": float(np.degrees(angles[1])),
        "curvature_x": float(curvatures[0]),
        "curvature_y": float(curvatures[1]),
        "best": {
            "delta_bk": float(thresholds[best[0]]),
            "k_bk": float(gains[best[1]]),
            **{name: float(values[best]) for name, values in outcomes.items()},
        },
        "mean": {name: float(values.mean()) for name, values in outcomes.items()},
        **{name: [[float(f"{v:.4g}") for v in row] for row in o] for name, o in outcomes.items()},
    }


def draw(folder: Path) -> None:
    """One row an outcome, one column a shape; a dot where productivity is largest."""
    result = json.loads((folder / "action_landscape.json").read_text())
    figure = new_figure(12.5, 9.6)
    panels = figure.subplots(len(OUTCOMES), len(SHAPES), sharex=True, sharey=True)
    thresholds, gains = result["delta_bk"], result["k_bk"]
    for row, (outcome, unit) in zip(panels, OUTCOMES.items(), strict=True):
        tables = [np.array(shape[outcome]) for shape in result["shapes"].values()]
        low, high = (np.percentile(tables, mark) for mark in (1.0, 99.0))
        for axis, table, (name, shape) in zip(row, tables, result["shapes"].items(), strict=True):
            image = axis.pcolormesh(
                thresholds, gains, table.T, vmin=low, vmax=high, cmap="viridis", shading="nearest"
            )
            if np.ptp(table) > 0.0:
                lines = axis.contour(
                    thresholds, gains, table.T, levels=5, colors="white", linewidths=0.6
                )
                axis.clabel(lines, fontsize=6.5, fmt="%.4g")
            best = shape["best"]
            axis.plot(best["delta_bk"], best["k_bk"], "o", ms=5, mfc="white", mec="black")
            axis.tick_params(colors=FAINT, labelsize=8)
            if outcome == "mass":
                axis.set_title(
                    f"{name}\nθ {shape['slope_degrees']:.0f}°, α {shape['incidence_degrees']:.0f}°,"
                    f" κ {_signed(shape['curvature_x'])}, {_signed(shape['curvature_y'])} /m",
                    fontsize=9,
                )
        row[0].set_ylabel("bucket gain k$_{bk}$")
        figure.colorbar(image, ax=list(row), label=f"{outcome} [{unit}]", pad=0.01)
    for axis in panels[-1]:
        axis.set_xlabel("bucket threshold δ$_{bk}$")
    write_bytes_atomic(folder / "action_landscape.png", png_bytes(figure, dpi=110))


def _signed(value: float) -> str:
    """Two digits; zero has no sign."""
    return f"{value:+.2f}" if abs(value) >= 0.005 else "0"


if __name__ == "__main__":
    main("action_landscape", run, draw)
