"""A plan as GeoJSON: digs, approaches, ways and trucks as features.

The coordinates are those of the scan, and the member `crs` names their reference system as GDAL and
QGIS read it, though RFC 7946 knows longitude and latitude alone: a site is staked out in metres.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from wlplan.io.files import MADE_BY
from wlplan.report.exports import Played
from wlplan.report.exports import _parts as parts
from wlplan.site.frame import frame_recorded

LIBRARY: str | None = None
NAME = "plan.geojson"
# Millimetres are more than anybody stakes out.
_DIGITS = 3


def content(played: Played) -> bytes:
    """The file."""
    features = []
    for number, load, line in parts.digs(played.document):
        facts = {"load": number, "heading_deg": round(float(np.degrees(load["heading"])), 1)}
        for name, value in (load.get("simulated") or {}).items():
            facts[name] = round(value, _DIGITS)
        features.append(_feature("Point", line[1], kind="dig", **facts))
        features.append(_feature("LineString", line, kind="approach", load=number))
    for number, name, points in parts.legs(played.document):
        features.append(_feature("LineString", points, kind=f"way, {name}", load=number))
    for name, corners in parts.trucks(played.document):
        ring = np.concatenate([corners, corners[:1]])
        features.append(_feature("Polygon", ring[None], kind="truck", name=name))
    crs = frame_recorded(played.document).crs
    named = {"crs": {"type": "name", "properties": {"name": crs}}} if crs else {}
    return json.dumps(
        {"type": "FeatureCollection", "generator": MADE_BY, **named, "features": features},
        allow_nan=False,
    ).encode()


def _feature(shape: str, points: np.ndarray, **properties: Any) -> dict[str, Any]:
    geometry = {"type": shape, "coordinates": np.round(points, _DIGITS).tolist()}
    return {"type": "Feature", "geometry": geometry, "properties": properties}
