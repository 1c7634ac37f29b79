"""What a job is asked for with, by name: a site, and a pile as it was read from a file.

Places that a person gives are in the coordinates of the scan. Light to import, so that help comes
at once.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlplan.errors import InputError
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.soil import GRAVEL, Soil

if TYPE_CHECKING:
    from wlplan.site.frame import Frame
    from wlplan.site.receiver import Receiver
    from wlplan.site.site import Site
    from wlplan.terrain.toe import ToeContour
    from wlplan.types import Pile

Note = Callable[[str], None]
"""Is told what is worth knowing but no error."""

# Widest cells, in parts of the bucket, that need no note.
_FINE = 0.2


def unsaid(text: str) -> None:
    """A `Note` that nobody reads."""
    del text


@dataclasses.dataclass(frozen=True)
class NamedSite:
    """What is dug and what digs, each with the name that it goes by."""

    soil_name: str = "gravel"
    soil: Soil = GRAVEL
    machine_name: str = "wa320"
    machine: WheelLoader = WA320

    def fields(self) -> dict[str, Any]:
        """What plan.json and the like say about it: names, and all values in SI units."""
        return {
            "soil": {"name": self.soil_name, "parameters": dataclasses.asdict(self.soil)},
            "machine": {"name": self.machine_name, "parameters": dataclasses.asdict(self.machine)},
        }

    def with_receiver(
        self, named: NamedPile, truck: tuple[float, ...] | None = None, *, note: Note = unsaid
    ) -> Site:
        """The site with its receiver.

        Args:
            named: The pile.
            truck: x [m] and y [m] in the coordinates of the scan and, if given, heading [degree];
                None for the default place.
            note: Told if the place was given in the local frame.

        Raises:
            InputError: If the place lies on the pile, far away from it or outside the area for
                trucks, or there is no room in that.
        """
        from wlplan.planning.placement import place_receiver

        receiver = None
        if truck is not None:
            receiver = place_receiver(
                named.pile,
                named.local(truck[0], truck[1], note=note),
                math.radians(truck[2]) if len(truck) == 3 else None,
                machine=self.machine,
                contour=named.contour,
                closed=named.closed,
                area=named.truck_area,
                frame=named.frame,
            )
        return self._beside(named, receiver)

    def with_receivers(
        self,
        named: NamedPile,
        trucks: list[tuple[float, float, float]],
        *,
        note: Note = unsaid,
    ) -> Site:
        """The site with a receiver for each truck, where a plan has them.

        Args:
            named: The pile.
            trucks: x [m] and y [m] in the coordinates of the scan and heading [degree] of each.
            note: As of `with_receiver`.

        Raises:
            InputError: If one of them is outside the area for trucks.
        """
        import numpy as np

        from wlplan.site.receiver import Receiver
        from wlplan.xla import floats

        places = [
            (*named.local(x, y, note=note), math.radians(heading)) for x, y, heading in trucks
        ]
        return self._beside(named, Receiver(*(floats(column) for column in np.array(places).T)))

    def _beside(self, named: NamedPile, receiver: Receiver | None) -> Site:
        from wlplan.planning.placement import beside
        from wlplan.site.site import Site

        site = Site(
            machine=self.machine,
            soil=self.soil,
            receiver=receiver,
            keep_out=named.closed,
            truck_area=named.truck_area,
            frame=named.frame,
        )
        return beside(site, named.pile, named.contour)


@dataclasses.dataclass(frozen=True)
class NamedPile:
    """A pile that was read.

    Attributes:
        pile: In its local frame.
        contour: Its toe.
        frame: How the local frame lies to the coordinates of the scan.
        closed: Cells that nothing may drive on; None if there are none.
        truck_area: Polygons that trucks may stand in, in the local frame; None: anywhere.
        fields: What plan.json says about the pile.
    """

    pile: Pile
    contour: ToeContour
    frame: Frame
    closed: Any
    truck_area: Any
    fields: dict[str, Any]

    def local(self, x: float, y: float, *, note: Note = unsaid) -> tuple[float, float]:
        """A place that a person gave, in the local frame [m].

        It counts as one in the coordinates of the scan, but for one that lies far away from it
        and, shortened as the local frame is, beside the pile: that is noted.
        """
        given, local = (x, y), self.frame.local(x, y)
        if self._is_near(given) and not self._is_near(local):
            where = self.frame.place(x, y)
            note(f"{x:g},{y:g} is far from the scan: it is taken as shortened for {where}")
            return given
        return local

    def _is_near(self, place: tuple[float, float]) -> bool:
        size = self.pile.cell_size * max(self.pile.height.shape)
        low = [float(value) for value in self.pile.origin]
        return all(abs(p - a - 0.5 * size) < size + 500.0 for p, a in zip(place, low, strict=True))


def read_named(
    path: Path,
    reading: Mapping[str, Any],
    machine: WheelLoader,
    *,
    name: str,
    note: Note = unsaid,
) -> NamedPile:
    """A pile with its toe.

    Args:
        path: The pile file.
        reading: Options of how it is read, as of `wlplan.io.read_scan`.
        machine: What digs.
        name: What it is called in plan.json and in complaints.
        note: Told what is worth knowing of the file.

    Raises:
        InputError: If it cannot be read or dug.
    """
    from wlplan.io import read_scan
    from wlplan.terrain.toe import check_accessible, toe_contour

    scan = read_scan(path, **reading)
    for text in (*scan.notes, *_coarse(scan.scanned_cell, machine, name)):
        note(text)
    pile = scan.pile
    contour = toe_contour(pile, machine=machine)
    check_accessible(contour.accessible)
    fields = {
        "file": name,
        "sha256": checksum(path),
        "cells": list(pile.height.shape),
        "cell_size": pile.cell_size,
        "origin": [float(value) for value in pile.origin],
        "notes": list(scan.notes),
        **reading,
    }
    contents = scan.contents
    return NamedPile(pile, contour, scan.frame, contents.closed, contents.truck_area, fields)


def _coarse(cell: float, machine: WheelLoader, name: str) -> tuple[str, ...]:
    """A note on cells that a bucket is few of.

    Raises:
        InputError: If a cell is wider than the bucket.
    """
    width = machine.bucket_width
    if cell > width:
        raise InputError(
            f"{name}: has cells of {cell:g} m, wider than the bucket, {width:g} m: no load can be "
            f"told from it; scan it finer."
        )
    if cell <= _FINE * width:
        return ()
    return (f"the cells are {cell:g} m wide, the bucket {width:g} m: the loads are rough guesses",)


def checksum(path: Path) -> str:
    """SHA-256 of a pile file.

    Raises:
        InputError: If it cannot be read.
    """
    from wlplan.io.files import check_is_file

    check_is_file(path, "pile")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
