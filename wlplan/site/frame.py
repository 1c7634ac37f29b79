"""How the frame of a pile relates to the coordinates of its survey.

Survey coordinates are too large for float32, so a pile that was read lies in a local frame, shifted
against that of its scan by whole kilometres and hundreds of metres. What a person reads or gives is
in the coordinates of the scan; everything inside is local. Only the standard library is needed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from wlplan.errors import InputError


@dataclasses.dataclass(frozen=True)
class Frame:
    """Where a local frame lies.

    Attributes:
        offset: x, y and z that are added to local coordinates to get those of the scan [m].
        crs: Reference system of the scan, such as "EPSG:25832"; None if it names none.
    """

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crs: str | None = None

    def local(self, x: float, y: float) -> tuple[float, float]:
        """X and y of the scan in the local frame [m]."""
        return x - self.offset[0], y - self.offset[1]

    def scan(self, x: float, y: float) -> tuple[float, float]:
        """Local x and y in the coordinates of the scan [m]."""
        return x + self.offset[0], y + self.offset[1]

    def place(self, x: float, y: float) -> str:
        """Local x and y as a person reads them, in the coordinates of the scan."""
        x, y = self.scan(x, y)
        return f"{x:.1f}, {y:.1f}"

    def shift_from(self, other: Frame) -> tuple[float, float]:
        """What is added to x and y in another frame to get them in this one [m].

        Raises:
            InputError: If both name their reference systems, and not the same.
        """
        if None not in (self.crs, other.crs) and self.crs != other.crs:
            raise InputError(
                f"is in {other.crs}, but the scan in {self.crs}: bring both into one reference "
                f"system."
            )
        return other.offset[0] - self.offset[0], other.offset[1] - self.offset[1]

    def fields(self) -> dict[str, Any]:
        """What plan.json says about it."""
        return {"offset": list(self.offset), "crs": self.crs}


LOCAL = Frame()
"""A frame that is that of the scan itself."""


def frame_recorded(document: Mapping[str, Any]) -> Frame:
    """The frame that a plan.json names; that of the scan itself if it names none.

    Raises:
        InputError: If what it says about it is no frame.
    """
    record = document.get("frame")
    if record is None:
        return LOCAL
    offset = record.get("offset") if isinstance(record, dict) else None
    crs = record.get("crs") if isinstance(record, dict) else None
    if (
        not isinstance(offset, list)
        or len(offset) != 3
        or not all(type(v) in (int, float) and abs(v) < 1e9 for v in offset)
        or not (crs is None or isinstance(crs, str))
    ):
        raise InputError(
            "`frame` has to hold `offset`, three numbers in metres, and `crs`, a name or null."
        )
    x, y, z = (float(value) for value in offset)
    assert math.isfinite(x + y + z)
    return Frame((x, y, z), crs)
