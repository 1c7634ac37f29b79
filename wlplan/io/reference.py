"""What the coordinates of a file mean: their unit, and the reference system that they are in."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
import warnings
from collections.abc import Iterator
from typing import Any

from wlplan.errors import InputError
from wlplan.io.libraries import library

METRE = 1.0
# Largest part by which a metre of a map may differ from one on the ground. UTM, state planes and
# the grids of countries stay below a thousandth; Web Mercator is 1.5 times too large at 48 degrees.
_MOST_DISTORTION = 0.01
_EPSG = re.compile(r"(?:EPSG:)?(\d{1,9})", re.IGNORECASE)
# Parameters of PROJ that name files; `@null` is none.
_FILES = re.compile(r"\+(\w*grids|init|file)=(?!@null\b)", re.IGNORECASE)
# How units are written in files, besides the names of the EPSG registry, in lower case.
_SPELLINGS = {
    **dict.fromkeys(("m", "meter", "meters", "metres"), "metre"),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetres"), "centimetre"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetres"), "millimetre"),
    **dict.fromkeys(("ft", "feet", "foot", "international foot", "international feet"), "foot"),
    **dict.fromkeys(
        ("us-ft", "ft-us", "ftus", "foot_us", "us survey feet", "us survey ft", "us foot"),
        "us survey foot",
    ),
}


@dataclasses.dataclass(frozen=True)
class Reference:
    """What the coordinates of a file mean.

    Attributes:
        name: Of the reference system, as "EPSG:25832" where the registry has it; None: not said.
        horizontal: Length of a unit of x and y [m]; None: not said.
        vertical: Length of a unit of z [m]; None: not said.
    """

    name: str | None = None
    horizontal: float | None = None
    vertical: float | None = None

    def factors(self) -> tuple[float, float, tuple[str, ...]]:
        """Metres a unit of x and y, and of z; and what had to be assumed, in words.

        A file that says nothing of z has it in the unit of x and y.
        """
        if self.horizontal is None and self.vertical is None:
            return METRE, METRE, ("the file names no unit: lengths are taken as metres",)
        horizontal = METRE if self.horizontal is None else self.horizontal
        vertical = horizontal if self.vertical is None else self.vertical
        notes = []
        if self.horizontal is None:
            notes.append("the file names no unit of x and y: they are taken as metres")
        if self.vertical is None and horizontal != METRE:
            notes.append(
                f"the file names no unit of its heights: they are taken as "
                f"{unit_name(horizontal)}, as x and y are"
            )
        found = [(axes, f) for axes, f in (("x and y", horizontal), ("z", vertical)) if f != METRE]
        notes += [f"{axes} converted from {unit_name(f)} to metres" for axes, f in found]
        return horizontal, vertical, tuple(notes)


def length_unit(name: str) -> float:
    """Metres in a unit of length, by its name or symbol.

    Raises:
        InputError: If no such unit is known.
    """
    wanted = _SPELLINGS.get(name.strip().lower(), name.strip().lower())
    for unit in _units():
        if unit.name.lower() == wanted:
            return float(unit.conv_factor)
    raise InputError(f"has lengths in {name!r}, a unit that is not known: convert it to metres.")


def length_unit_of_code(code: int) -> float:
    """Metres in a unit of length, by its number in the EPSG registry.

    Raises:
        InputError: If it is no unit of length.
    """
    for unit in _units():
        if unit.code == str(code):
            return float(unit.conv_factor)
    raise InputError(f"has lengths in unit {code} of EPSG, which is not one: convert it to metres.")


def unit_name(factor: float) -> str:
    """A unit of length in words, by its length [m]."""
    names = {1.0: "metres", 0.01: "centimetres", 0.001: "millimetres", 0.3048: "feet"}
    names[1200.0 / 3937.0] = "US survey feet"
    for length, name in names.items():
        # The two feet differ by 2e-6.
        if math.isclose(factor, length, rel_tol=1e-7):
            return name
    return f"units of {factor:.9g} m"


def reference_of(
    definition: Any, place: tuple[float, float], *, horizontal: float | None = None
) -> Reference:
    """What a reference system says about coordinates.

    Args:
        definition: The system as WKT, or its number in the EPSG registry, also as "EPSG:25832".
            Other ways to name one may name files, which are not opened.
        place: x and y of a point of the file, in its own unit.
        horizontal: That unit [m], where the file says it apart from the system.

    Raises:
        InputError: If coordinates in it are no lengths on the ground; or there is no pyproj.
    """
    with library("pyproj", install="wlplan[scan]") as pyproj, _offline(pyproj):
        try:
            if code := _EPSG.fullmatch(str(definition).strip()):
                system = pyproj.CRS.from_epsg(int(code[1]))
            else:
                system = pyproj.CRS.from_wkt(str(definition))
        except pyproj.exceptions.CRSError as error:
            raise InputError(
                "has a reference system that is not understood: assign the right one, or none."
            ) from error
        if system.is_bound:
            system = system.source_crs
        parts = system.sub_crs_list or [system]
        ground = parts[0].source_crs if parts[0].is_bound else parts[0]
        if ground.is_geocentric:
            raise InputError(
                f"has earth-centred coordinates ({ground.name}): project it to a metric system "
                f"such as UTM."
            )
        if ground.is_geographic:
            raise InputError(
                f"is in degrees ({ground.name}), not in metres: project it to a metric system "
                f"{_utm(*place)}."
            )
        axes = [axis for part in parts for axis in part.axis_info]
        plan = next((a for a in axes if a.direction.lower() not in ("up", "down")), None)
        if ground.is_projected and plan is not None:
            inside = 1.0 if horizontal is None else horizontal / plan.unit_conversion_factor
            _check_scale(pyproj, ground, (inside * place[0], inside * place[1]))
        if horizontal is None and plan is not None:
            horizontal = float(plan.unit_conversion_factor)
        up = next((a for a in axes if a.direction.lower() == "up"), None)
        if any(a.direction.lower() == "down" for a in axes):
            raise InputError(f"counts depths, not heights ({system.name}): turn z around.")
        authority = (system if len(parts) == 1 else ground).to_authority()
    return Reference(
        name=":".join(authority) if authority else system.name,
        horizontal=horizontal,
        vertical=None if up is None else float(up.unit_conversion_factor),
    )


@contextlib.contextmanager
def _offline(pyproj: Any) -> Iterator[None]:
    """Keep PROJ from fetching grids, whatever the environment of the process asks for."""
    before = pyproj.network.is_network_enabled()
    pyproj.network.set_network_enabled(active=False)
    try:
        yield
    finally:
        pyproj.network.set_network_enabled(active=before)


def _check_scale(pyproj: Any, system: Any, place: tuple[float, float]) -> None:
    """Refuse maps whose metres are not those on the ground."""
    with warnings.catch_warnings():
        # It says that parameters are lost in this notation.
        warnings.simplefilter("ignore")
        parameters = system.to_proj4()
    if _FILES.search(parameters):
        raise InputError(
            "has a reference system that names other files: assign the right one, or none."
        )
    projection = pyproj.Proj(system)
    longitude, latitude = projection(*place, inverse=True)
    if not (math.isfinite(longitude) and math.isfinite(latitude)):
        return
    scale = projection.get_factors(longitude, latitude).meridional_scale
    if math.isfinite(scale) and abs(scale - 1.0) > _MOST_DISTORTION:
        raise InputError(
            f"is in {system.name}, where a length on the map is {scale:.3g} times that on the "
            f"ground: project it to a system {_utm(longitude, latitude)}."
        )


def _utm(longitude: float, latitude: float) -> str:
    """The UTM zone of a place, for advice."""
    if not (abs(longitude) <= 180.0 and abs(latitude) <= 84.0):
        return "such as UTM"
    zone = min(int((longitude + 180.0) // 6.0) + 1, 60)
    return f"such as UTM (EPSG:{(32600 if latitude >= 0.0 else 32700) + zone} there)"


def _units() -> list[Any]:
    with library("pyproj", install="wlplan[scan]"):
        from pyproj.database import get_units_map

        return list(get_units_map(category="linear").values())
