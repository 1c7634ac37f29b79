"""Areas that a person draws: GeoJSON polygons in the coordinates of the scan."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from wlplan.errors import InputError, one_line
from wlplan.io.documents import parse_json
from wlplan.io.files import check_is_file, named

KINDS = ("obstacle", "no-go", "no-dig")
"""What an area may be: something stands there; nothing may drive there; nothing is dug there."""

FOR_TRUCKS = ("truck",)
"""The same of areas that trucks may stand in."""


@dataclasses.dataclass(frozen=True)
class Area:
    """An area of a site.

    Attributes:
        kind: One of `KINDS`, or of `FOR_TRUCKS`.
        rings: Corners of its outline and of its holes [m], in the coordinates of the scan.
        height: Of an obstacle over the floor [m]; None: as the scan saw it.
    """

    kind: str
    rings: tuple[Float[np.ndarray, "n 2"], ...]
    height: float | None = None

    def cells(
        self, shape: tuple[int, int], cell_size: float, origin: Float[np.ndarray, "2"]
    ) -> Bool[np.ndarray, "nx ny"]:
        """Cells whose centres lie inside.

        Args:
            shape: Of the grid.
            cell_size: Its spacing [m].
            origin: Centre of its first cell [m], in the coordinates of the scan.
        """
        inside = np.zeros(shape, bool)
        axes = [origin[k] + cell_size * np.arange(shape[k]) for k in (0, 1)]
        for ring in self.rings:
            first = [int(np.searchsorted(axes[k], ring[:, k].min())) for k in (0, 1)]
            stop = [int(np.searchsorted(axes[k], ring[:, k].max(), "right")) for k in (0, 1)]
            x, y = axes[0][first[0] : stop[0], None], axes[1][None, first[1] : stop[1]]
            crossed = np.zeros((x.size, y.size), bool)
            for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
                if y0 != y1:
                    # An edge is crossed on the way to the east where it spans the cell's north.
                    spans = (y0 > y) != (y1 > y)
                    crossed ^= spans & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
            # Even and odd: a hole takes out what its outline has put in.
            inside[first[0] : stop[0], first[1] : stop[1]] ^= crossed
        return inside


def read_areas(path: Path, kinds: tuple[str, ...] = KINDS) -> tuple[Area, ...]:
    """The polygons of a GeoJSON file.

    Args:
        path: File. Its coordinates are those of the scan; `properties` of a feature may hold
            `kind`, by default the first of those asked for, and `height` [m] of an obstacle.
        kinds: Kinds that the areas may be of.

    Raises:
        InputError: If it is none, holds no polygon, or one that is none.
    """
    check_is_file(path, "GeoJSON")
    with named(path):
        try:
            document = parse_json(path.read_bytes())
        except OSError as error:
            raise InputError(
                f"cannot be read ({one_line(error.strerror or error)}): check the file."
            ) from error
        except InputError as error:
            raise InputError(f"is not GeoJSON: it {error}") from error
        features = document.get("features") if isinstance(document, dict) else None
        if features is None and isinstance(document, dict):
            features = [document if "geometry" in document else {"geometry": document}]
        if not isinstance(features, list):
            raise InputError("is not GeoJSON: it holds no features.")
        areas = tuple(area for feature in features for area in _areas(feature, kinds))
        if not areas:
            raise InputError("holds no polygon: draw the areas as polygons.")
        return areas


def _areas(feature: Any, kinds: tuple[str, ...]) -> list[Area]:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    properties = feature.get("properties") if isinstance(feature, dict) else None
    properties = properties if isinstance(properties, dict) else {}
    kind = properties.get("kind", kinds[0])
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(
            f"has an area of kind {one_line(repr(kind))}: use one of {', '.join(kinds)}."
        )
    height = properties.get("height")
    if height is not None and not (_is_number(height) and 0.0 < height < 200.0):
        raise InputError(
            f"has an obstacle whose height is {one_line(repr(height))}: give metres above the "
            f"floor."
        )
    shape = geometry.get("type") if isinstance(geometry, dict) else None
    corners = geometry.get("coordinates") if isinstance(geometry, dict) else None
    if shape == "Polygon":
        corners = [corners]
    elif shape != "MultiPolygon":
        return []
    if not isinstance(corners, list):
        raise InputError("has a polygon without coordinates: draw it again.")
    return [Area(kind, _rings(polygon), height) for polygon in corners]


def _rings(polygon: Any) -> tuple[Float[np.ndarray, "n 2"], ...]:
    rings = []
    for ring in polygon if isinstance(polygon, list) else [None]:
        points = [p[:2] for p in ring if isinstance(p, list)] if isinstance(ring, list) else []
        if len(points) < 3 or not all(len(p) == 2 and all(map(_is_number, p)) for p in points):
            raise InputError("has a polygon with fewer than three corners: draw it again.")
        rings.append(np.array(points, np.float64))
    if not rings:
        raise InputError("has a polygon with fewer than three corners: draw it again.")
    return tuple(rings)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9
