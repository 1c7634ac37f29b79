"""The ways of a loader on a map: approach, reverse and forward, told apart by their lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_hex

from wlplan.report.figures.style import add_arrow
from wlplan.report.legs import legs

LINES: dict[str, Any] = {"reverse": (0, (4, 2.2)), "forward": "solid"}
"""Line style of each leg; the approach is an arrow."""
# Width of their lines, and of these where there are many [point].
_WIDTH, _THIN = 1.3, 0.7
# Ways from this number on are many.
_MANY = 20


def draw_ways(
    panel: Axes,
    ways: Sequence[Float[np.ndarray, "_ 4"]],
    colours: Float[np.ndarray, "n 4"],
) -> None:
    """Ways to the truck: dashed in reverse, solid ahead.

    Args:
        panel: The map.
        ways: x [m], y [m], heading [rad] and gear of the points of each.
        colours: Of each, as of its dig.
    """
    many = len(ways) > _MANY
    for way, colour in zip(ways, colours, strict=True):
        for name, leg in legs(way).items():
            panel.plot(
                leg[:, 0],
                leg[:, 1],
                linestyle=LINES[name],
                color=to_hex(colour),
                linewidth=_THIN if many else _WIDTH,
                alpha=0.45 if many else 0.9,
                solid_capstyle="round",
                zorder=4,
            )
            if name == "forward" and not many:
                add_arrow(panel, *leg[-2:], colour=to_hex(colour), line=0.0, head=13.0, zorder=4)
