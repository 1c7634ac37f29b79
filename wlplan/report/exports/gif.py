"""A film of the pile as it is dug, load by load, as GIF."""

from __future__ import annotations

import io
import math

import numpy as np
from matplotlib.colors import Normalize
from PIL import Image

from wlplan.io.files import MADE_BY
from wlplan.report.exports import Played
from wlplan.report.figures.digs import order_colours
from wlplan.report.figures.relief import (
    PILE,
    draw_pile,
    draw_toe,
    grow_to_ratio,
    height_above_ground,
    view_of,
)
from wlplan.report.figures.style import add_arrow, frame_map, map_panels
from wlplan.report.figures.truck import Truck, draw_truck
from wlplan.report.figures.ways import draw_ways
from wlplan.report.legs import approach, approach_distance, way
from wlplan.report.stands import stands_of
from wlplan.site.frame import frame_recorded
from wlplan.site.receiver import Receiver

LIBRARY: str | None = None
NAME = "plan.gif"
# Pictures at most, how long each is shown [ms], and pixels an inch.
_MOST, _SHOWN, _DPI = 60, 700, 80


def content(played: Played) -> bytes:
    """The film: before each load its dig and its way, and at last what is left."""
    loads, count = played.document["loads"], len(played.document["loads"])
    every = math.ceil((count + 1) / _MOST)
    shown = [*range(0, count, every), count]
    digs = np.array([[load["x"], load["y"]] for load in loads], float)
    trucks = [
        Truck(Receiver(stand["x"], stand["y"], stand["heading"]), name)
        for name, stand in stands_of(played.document)
    ]
    points = [digs, *(truck.body for truck in trucks), *(way(load)[:, :2] for load in loads)]
    view = grow_to_ratio(view_of(played.before, np.concatenate(points)))
    norm = Normalize(0.0, max(float(height_above_ground(played.before).max()), 0.1))
    pictures = [_picture(played, n, view, norm, trucks) for n in shown]
    buffer = io.BytesIO()
    # The last one stays a little.
    shown_for = [_SHOWN] * (len(pictures) - 1) + [4 * _SHOWN]
    pictures[0].save(
        buffer,
        "GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=shown_for,
        loop=0,
        comment=MADE_BY.encode(),
    )
    return buffer.getvalue()


def _picture(
    played: Played, n: int, view: np.ndarray, norm: Normalize, trucks: list[Truck]
) -> Image.Image:
    """The pile after n loads, with the next one."""
    loads = played.document["loads"]
    figure, (panel,) = map_panels(view, 1)
    pile = played.before if n == 0 else played.before.replace(height=played.heights[n - 1])
    draw_pile(panel, pile, PILE, norm)
    title = f"Load {n + 1} of {len(loads)}" if n < len(loads) else f"After {len(loads)} loads"
    frame_map(panel, view, title, frame_recorded(played.document))
    draw_toe(panel, played.before, "dashed")
    for truck in trucks:
        draw_truck(panel, truck, view)
    if n < len(loads):
        colours = order_colours(len(loads))[n : n + 1]
        draw_ways(panel, [way(loads[n])], colours)
        lane = approach(loads[n], approach_distance(played.document))
        add_arrow(panel, *lane, colour=colours[0], line=2.0, head=12.0, zorder=8)
    buffer = io.BytesIO()
    # All pictures have to be of one size.
    figure.savefig(buffer, format="png", dpi=_DPI)
    return Image.open(buffer).convert("RGB").quantize(128, dither=Image.Dither.NONE)
