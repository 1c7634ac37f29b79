"""A plan as DXF, in metres: a layer each for digs, approaches, ways in either gear, trucks."""

from __future__ import annotations

import io

from wlplan.io.files import MADE_BY
from wlplan.report.exports import Played
from wlplan.report.exports import _parts as parts

LIBRARY = "ezdxf"
NAME = "plan.dxf"
# Layers and their colours, by the numbers that AutoCAD has for them.
LAYERS = {"DIGS": 5, "APPROACH": 5, "WAY_REVERSE": 8, "WAY_FORWARD": 7, "TRUCKS": 3}
_METRES = 6
# Height of the numbers [m].
_TEXT = 0.4


def content(played: Played) -> bytes:
    """The file."""
    from ezdxf import filemanagement

    drawing = filemanagement.new("R2010", units=_METRES)
    drawing.header.custom_vars.append("generator", MADE_BY)
    for name, colour in LAYERS.items():
        drawing.layers.add(name, color=colour)
    space = drawing.modelspace()
    for number, _, line in parts.digs(played.document):
        start, tip = (tuple(map(float, point)) for point in line)
        space.add_point(tip, dxfattribs={"layer": "DIGS"})
        text = {"layer": "DIGS", "height": _TEXT}
        space.add_text(str(number), dxfattribs=text).set_placement(tip)
        space.add_line(start, tip, dxfattribs={"layer": "APPROACH"})
    for _, name, points in parts.legs(played.document):
        layer = {"layer": f"WAY_{name.upper()}"}
        space.add_lwpolyline([tuple(map(float, point)) for point in points], dxfattribs=layer)
    for _, corners in parts.trucks(played.document):
        ring = [tuple(map(float, corner)) for corner in corners]
        space.add_lwpolyline(ring, close=True, dxfattribs={"layer": "TRUCKS"})
    buffer = io.StringIO()
    drawing.write(buffer)
    return buffer.getvalue().encode(drawing.output_encoding)
