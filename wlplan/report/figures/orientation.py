"""What tells a reader of a map where north is, and how far things are apart."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes

from wlplan.report.figures.style import INK

# Lengths of the bar to choose from [m]; the longest within this part of the map is taken.
_LENGTHS = (100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0)
_PART = 0.25
# Room for the bar and the arrow: parts of the shorter side of the map.
_ROOM, _EDGE = 0.2, 0.045


def draw_orientation(
    panel: Axes, view: Float[np.ndarray, "2 2"], busy: Float[np.ndarray, "n 2"]
) -> None:
    """A scale bar and an arrow to the north, in the corner where the least is drawn.

    Args:
        panel: The map.
        view: Its corners [m].
        busy: Points of what is drawn on it [m].
    """
    size = np.ptp(view, axis=0)
    short = float(size.min())
    length = next((one for one in _LENGTHS if one <= _PART * size[0]), _LENGTHS[-1])
    room = np.array([length + 4.0 * _EDGE * short, _ROOM * short])
    corners = [np.array([i, j]) for i in (0, 1) for j in (0, 1)]

    def crowd(corner: np.ndarray) -> int:
        middle = np.where(corner, view[1] - 0.5 * room, view[0] + 0.5 * room)
        return int((np.abs(busy - middle) < 0.5 * room).all(axis=-1).sum())

    right, top = min(corners, key=crowd)
    edge = _EDGE * short
    x = view[1, 0] - edge - length if right else view[0, 0] + edge
    y = view[1, 1] - 4.0 * edge if top else view[0, 1] + edge
    halo = [patheffects.withStroke(linewidth=3.0, foreground="white", alpha=0.85)]
    for part, colour in ((0.0, INK), (0.5, "white")):
        panel.plot(
            [x + part * length, x + (part + 0.5) * length],
            [y, y],
            color=colour,
            linewidth=3.2,
            solid_capstyle="butt",
            path_effects=[patheffects.withStroke(linewidth=4.8, foreground=INK)],
            zorder=11,
        )
    panel.text(
        x + 0.5 * length,
        y + 0.35 * edge,
        f"{length:g} m",
        ha="center",
        va="bottom",
        fontsize=8.5,
        color=INK,
        path_effects=halo,
        zorder=11,
    )
    panel.annotate(
        "N",
        xy=(x, y + 3.2 * edge),
        xytext=(x, y + 0.7 * edge),
        ha="center",
        va="bottom",
        fontsize=9,
        fontweight="bold",
        color=INK,
        arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 0.0, "shrinkB": 0.0, "lw": 1.6},
        path_effects=halo,
        zorder=11,
    )
