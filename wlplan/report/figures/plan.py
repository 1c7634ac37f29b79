"""A plan on its pile: the numbered digs, and the pile that is left."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from wlplan.report.figures.digs import (
    LABEL_PART,
    MOST_NUMBERED,
    draw_digs,
    draw_many_digs,
    label_places,
)
from wlplan.report.figures.relief import (
    PILE,
    add_legend,
    draw_pile,
    draw_toe,
    grow_to_ratio,
    height_above_ground,
    view_of,
)
from wlplan.report.figures.style import BLUE, frame_map, map_panels
from wlplan.report.figures.truck import draw_area, draw_truck, trucks_of
from wlplan.report.figures.ways import draw_ways
from wlplan.site.frame import LOCAL, Frame
from wlplan.site.polygon import Polygon
from wlplan.site.receiver import Receiver
from wlplan.types import LoadingPlan, Pile


def plan_figure(
    before: Pile,
    after: Pile,
    plan: LoadingPlan,
    *,
    receiver: Receiver | None = None,
    ways: Sequence[Float[np.ndarray, "_ 4"]] = (),
    area: tuple[Polygon, ...] | None = None,
    frame: Frame = LOCAL,
    after_title: str | None = None,
) -> Figure:
    """The pile with its numbered digs, and the pile that is left, side by side.

    A dot marks the dig location, an arrow the heading, and the number on the outside the order; of
    more than twenty digs their colour.

    Args:
        before: Pile before the first loading.
        after: Pile after the last one, on the same grid.
        plan: N loadings in order, leaves [N].
        receiver: Where the loader dumps, drawn as a truck across its heading; leaves (K,) for
            trucks with places of their own.
        ways: Points of the way of each load: x [m], y [m], heading [rad] and gear.
        area: Polygons that trucks may stand in; None: anywhere.
        frame: What the coordinates on the axes are in.
        after_title: Title of the second panel; by default the number of loads.
    """
    digs = np.stack([np.asarray(plan.pose.x), np.asarray(plan.pose.y)], axis=-1).astype(float)
    heading = np.asarray(plan.pose.heading, float)
    view = view_of(before, digs)
    trucks = [] if receiver is None else trucks_of(receiver)
    seen = digs
    near = [part for truck in trucks if truck.is_near(view) for part in (truck.body, truck.way)]
    if near:
        seen = np.concatenate([digs, *near, *(way[:, :2] for way in ways)])
    # Labels are as large as the map allows, and the map widens to hold them.
    radius = LABEL_PART * float(np.ptp(view_of(before, seen), axis=0).max())
    many = len(digs) > MOST_NUMBERED
    labels = digs if many else label_places(digs, heading, radius, before)
    view = grow_to_ratio(view_of(before, np.concatenate([seen, labels])))

    figure, panels = map_panels(view, 2)
    highest = max(float(height_above_ground(pile).max()) for pile in (before, after))
    norm = Normalize(0.0, max(highest, 0.1))
    loads = "1 load" if len(digs) == 1 else f"{len(digs)} loads"
    titles = (f"Before, with {loads} planned", after_title or f"After {loads}")
    for panel, pile, title in zip(panels, (before, after), titles, strict=True):
        draw_pile(panel, pile, PILE, norm)
        frame_map(panel, view, title, frame)
        if area is not None:
            draw_area(panel, area)
        for truck in trucks:
            draw_truck(panel, truck, view)
    draw_ways(panels[0], ways)
    if many:
        draw_many_digs(figure, panels[0], digs, heading, radius)
    else:
        draw_digs(panels[0], digs, heading, labels, radius)
    for panel, line in zip(panels, ("solid", "dashed"), strict=True):
        draw_toe(panel, before, line)
    panels[1].plot(*digs.T, "o", color=BLUE, markersize=2.5, zorder=5)
    panels[1].tick_params(labelleft=False)
    panels[1].set_ylabel("")
    bar = figure.colorbar(
        ScalarMappable(norm, PILE), cax=panels[1].inset_axes((1.03, 0.0, 0.035, 1.0))
    )
    bar.set_label("height above the ground [m]")
    bar.outline.set_visible(False)
    drawn = "line: heading, colour: order" if many else "arrow: heading, number: order"
    add_legend(
        figure, before, f"dot: dig location, {drawn}", ways=bool(ways), area=area is not None
    )
    return figure
