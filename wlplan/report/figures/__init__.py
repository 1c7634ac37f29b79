"""Figures: a plan on its pile, predicted beside simulated totals, diggability maps.

A figure is a file of its own here, with one function that returns a matplotlib figure bound to no
screen and no global state. Maps are drawn in the world frame, in metres, north up; light falls from
the north-west. What figures share: `style` for colours and axes, `relief` for the pile under a map,
`digs` and `truck` for what lies on it, `png` for files.
"""

from wlplan.report.figures.diggability import Shade, diggability_figure, shades_figure
from wlplan.report.figures.plan import (
    PlanOnPile,
    left_figure,
    plan_figure,
    step_figure,
    work_figure,
)
from wlplan.report.figures.png import png_bytes, save_figure
from wlplan.report.figures.totals import total_figure, totals_figure

__all__ = [
    "PlanOnPile",
    "Shade",
    "diggability_figure",
    "left_figure",
    "plan_figure",
    "png_bytes",
    "save_figure",
    "shades_figure",
    "step_figure",
    "total_figure",
    "totals_figure",
    "work_figure",
]
