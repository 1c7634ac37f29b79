"""The pictures of the page of a plan, each with words for who does not see it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from wlplan.constants import QUANTITIES
from wlplan.report import figures
from wlplan.report.figures.key import KeyLine
from wlplan.report.figures.plan import PlanOnPile, key_of
from wlplan.report.figures.relief import height_above_ground
from wlplan.report.figures.style import BLUE, ORANGE
from wlplan.report.figures.totals import BAND
from wlplan.report.template import Gallery, Picture
from wlplan.types import Performance, Pile

# Maps of single steps at most, and pixels an inch of the pictures.
_STEPS, _DPI = 8, 150
# Names of eight directions, counter-clockwise from east.
_SIDES = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


def galleries_of(
    shown: PlanOnPile,
    after: Pile,
    *,
    heights: Float[np.ndarray, "n nx ny"] | None = None,
    predicted: Performance | None = None,
    simulated: Performance,
    deviation: Performance | None = None,
    after_title: str | None = None,
) -> list[Gallery]:
    """The maps, the pile every few loads, and the charts.

    Args:
        shown: The plan on its pile.
        after: The pile that is left.
        heights: As each load leaves them [m]; None: not known, and no steps are shown.
        predicted: By the world that planned, leaves [N]; None: not known.
        simulated: As it was played, leaves [N].
        deviation: Standard deviation of the error of what was predicted, leaves [N]; None: unknown.
        after_title: Title of the map of what is left; by default the number of loads.
    """
    count = len(shown.digs)
    found = [
        Gallery(
            "The work, and the pile that is left",
            (
                _picture(figures.work_figure(shown), _work_said(shown)),
                _picture(figures.left_figure(shown, after, after_title), _left_said(shown, after)),
            ),
            columns=2,
            key=key_of(shown),
        )
    ]
    if heights is not None and count > 1:
        found.append(_steps(shown, heights))
    return [*found, _charts(predicted, simulated, deviation)]


def _picture(figure: Any, alt: str) -> Picture:
    return Picture(figures.png_bytes(figure, dpi=_DPI), alt)


def _steps(shown: PlanOnPile, heights: Float[np.ndarray, "n nx ny"]) -> Gallery:
    """The pile before every few loads, with these."""
    count = len(shown.digs)
    every = math.ceil(count / _STEPS)
    pictures = []
    for first in range(0, count, every):
        rows = slice(first, min(first + every, count))
        pile = shown.before
        if first:
            pile = pile.replace(height=heights[first - 1])
        digs = shown.digs[rows]
        last = f" to {rows.stop}" if rows.stop > first + 1 else ""
        pictures.append(
            _picture(
                figures.step_figure(shown, pile, rows),
                f"The pile before load {first + 1}, with the digs of load {first + 1}{last} "
                f"{_side(shown, digs)}.",
            )
        )
    few = "each load" if every == 1 else f"every {every} loads"
    return Gallery(
        f"The pile before {few}",
        pictures,
        columns={3: 3, 5: 5, 6: 3}.get(len(pictures), 4),
        caption="What stands there before these loads, and where they dig. Dashed: the toe as it "
        "was at first.",
        small=True,
    )


def _charts(
    predicted: Performance | None, simulated: Performance, deviation: Performance | None
) -> Gallery:
    pictures = []
    both = (simulated, None, None) if predicted is None else (predicted, simulated, deviation)
    for accumulated in (False, True):
        for name in QUANTITIES:
            figure = figures.total_figure(name, accumulated, *both)
            pictures.append(_picture(figure, _chart_said(name, accumulated, predicted, simulated)))
    key = []
    if predicted is not None:
        key = [KeyLine("line", BLUE, "predicted"), KeyLine("dashed", ORANGE, "simulated")]
        if deviation is not None:
            key.append(KeyLine("band", BLUE, BAND))
    title = "Simulated, load by load" if predicted is None else "Predicted beside simulated"
    return Gallery(title, pictures, columns=3, key=key)


def _work_said(shown: PlanOnPile) -> str:
    count = len(shown.digs)
    highest = float(height_above_ground(shown.before).max())
    words = (
        f"Map of the pile before the first load, {highest:.1f} m high, with {count} "
        f"dig{'s'[: count != 1]} as arrows {_side(shown, shown.digs)}"
    )
    if shown.has_ways:
        words += ", the ways back in reverse and forward to the truck"
    places = [
        f"{one.name} that is loaded from {shown.frame.place(*one.stand)}" for one in shown.trucks
    ]
    return f"{words}; {', '.join(places)}." if places else f"{words}."


def _left_said(shown: PlanOnPile, after: Pile) -> str:
    before, left = (float(height_above_ground(pile).sum()) for pile in (shown.before, after))
    taken = 100.0 * (1.0 - left / before) if before else 0.0
    return (
        f"Map of the pile that is left: {taken:.0f} % of it is gone {_side(shown, shown.digs)}; "
        f"it is {float(height_above_ground(after).max()):.1f} m high."
    )


def _side(shown: PlanOnPile, digs: Float[np.ndarray, "n 2"]) -> str:
    """On which side of the pile digs are, in words."""
    soil = np.maximum(height_above_ground(shown.before), 0.0)
    if not soil.sum():
        return ""
    cells = np.array([(soil.sum(axis=1 - k) * np.arange(soil.shape[k])).sum() for k in (0, 1)])
    middle = np.asarray(shown.before.origin, float) + shown.before.cell_size * cells / soil.sum()
    away = digs - middle
    towards = away / np.maximum(np.hypot(*away.T), 1e-9)[:, None]
    mean = towards.mean(axis=0)
    # Digs on all sides cancel each other.
    if np.hypot(*mean) < 0.5:
        return "all around"
    return f"in its {_SIDES[round(math.atan2(mean[1], mean[0]) / (math.pi / 4.0)) % 8]}"


def _chart_said(
    name: str, accumulated: bool, predicted: Performance | None, simulated: Performance
) -> str:
    title, unit, digits = QUANTITIES[name]
    parts = {"predicted": predicted, "simulated": simulated}
    said = []
    for part, performance in parts.items():
        if performance is None:
            continue
        values = np.atleast_1d(np.asarray(getattr(performance, name), float))
        if accumulated:
            said.append(f"{part} {values.sum():.{digits}f} {unit} at the end")
        else:
            said.append(f"{part} {values.min():.{digits}f} to {values.max():.{digits}f} {unit}")
    what = "accumulated over the loads" if accumulated else "of each load"
    return f"{title.capitalize()} {what}: {', '.join(said)}."
