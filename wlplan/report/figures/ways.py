"""The ways of a loader on a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from wlplan.report.figures.style import INK


def draw_ways(panel: Axes, ways: Sequence[Float[np.ndarray, "_ 4"]]) -> None:
    """Ways to the truck: dashed in reverse, solid ahead.

    Args:
        panel: The map.
        ways: x [m], y [m], heading [rad] and gear of the points of each.
    """
    for way in ways:
        for gear, style in ((-1.0, (0, (3, 2))), (1.0, "solid")):
            leg = way[way[:, 3] == gear]
            panel.plot(
                leg[:, 0],
                leg[:, 1],
                linestyle=style,
                color=INK,
                linewidth=0.9,
                alpha=max(0.25, 0.8 / len(ways) ** 0.5),
                zorder=4,
            )
