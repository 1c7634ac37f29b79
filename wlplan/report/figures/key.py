"""What the lines of a map mean: said once, for a figure and for a page."""

from __future__ import annotations

from typing import Any, NamedTuple

from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from wlplan.report.figures.relief import UNSEEN
from wlplan.report.figures.ways import LINES

_WIDTHS = {"arrow": 2.0, "reverse": 1.4, "forward": 1.4, "line": 1.3, "thin": 0.5}


class KeyLine(NamedTuple):
    """A line of a key.

    Attributes:
        kind: "arrow", "reverse", "forward", "line" or "thin" for lines, "solid" and "band" for
            areas in it, the second a pale one, "unseen" for hatching.
        colour: Of the line, "#rrggbb".
        words: What it means.
    """

    kind: str
    colour: str
    words: str


def handle(line: KeyLine) -> Line2D | Patch:
    """The line as a legend of matplotlib draws it."""
    if line.kind == "unseen":
        return Patch(**UNSEEN)
    if line.kind == "solid":
        return Patch(facecolor=line.colour)
    if line.kind == "band":
        return Patch(facecolor=line.colour, alpha=0.22)
    drawn: dict[str, Any] = {"linewidth": _WIDTHS[line.kind], "color": line.colour}
    if line.kind == "arrow":
        drawn |= {"marker": ">", "markersize": 5.0, "markevery": [-1]}
    return Line2D([0, 1], [0, 0], linestyle=LINES.get(line.kind, "solid"), **drawn)
