"""Figures: a plan on its pile, predicted beside simulated totals, diggability maps.

Every function returns a matplotlib figure that is bound to no screen and no global state. Maps
are drawn in the world frame, in metres, north up; light falls from the north-west.
"""

from wlplan.report.figures.figures import diggability_figure, plan_figure, totals_figure
from wlplan.report.figures.paper import png_bytes, save_figure

__all__ = ["diggability_figure", "plan_figure", "png_bytes", "save_figure", "totals_figure"]
