"""Soils and machines by name or from a TOML file, and what none of them may be.

A TOML file has the fields of `Soil` or `WheelLoader` by their names, in SI units, but for angles:
people write degrees, so the name of an angle ends in `_deg` and its value is in degrees, or degrees
a second. `preset = "sand"` says which preset the other fields come from; without it, gravel or the
WA320. Everything that is wrong is refused with the name of the field.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
import os
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from wlplan.constants import GRAVITY
from wlplan.errors import InputError
from wlplan.site.machine import MACHINES, WA320, WheelLoader
from wlplan.site.parameters import Range, ranges_of
from wlplan.site.soil import GRAVEL, SOILS, Soil

# Longest time step of the simulator [s].
_LONGEST_STEP = 0.02

_DEGREES = "_deg"
# A file of parameters has some hundred bytes.
_MOST_BYTES = 100_000

T = TypeVar("T", Soil, WheelLoader)


@dataclasses.dataclass(frozen=True)
class _Kind(Generic[T]):
    """What soils, or machines, have in common."""

    word: str
    presets: Mapping[str, T]
    base: T
    ranges: Mapping[str, Range]
    # Pairs of fields of which the first is not larger than the second.
    ordered: tuple[tuple[str, str], ...]


_SOIL: _Kind[Soil] = _Kind(
    "soil",
    SOILS,
    GRAVEL,
    ranges_of(Soil),
    # Where steel held the soil better than the soil itself does, the soil would shear beside it.
    (("steel_friction", "friction"), ("adhesion", "cohesion")),
)
_MACHINE: _Kind[WheelLoader] = _Kind(
    "machine",
    MACHINES,
    WA320,
    ranges_of(WheelLoader),
    (
        ("boom_low", "boom_carry"),
        ("boom_carry", "boom_high"),
        ("bucket_mass", "mass"),
        ("boom_mass", "mass"),
    ),
)


def soil_named(name_or_path: str | os.PathLike[str]) -> Soil:
    """A soil by the name of a preset or from a TOML file.

    Args:
        name_or_path: A name of `SOILS`, or the path of a file whose keys are fields of `Soil`: SI
            units, and angles in degrees as `friction_deg` and `steel_friction_deg`. `preset`
            names the soil that fields left out come from, by default gravel. A preset goes before
            a file of the same name: write `./sand` for that. `NAME@DEGREES` is that soil with
            another angle of repose, and so of internal friction.

    Returns:
        The soil, in SI units and radians.

    Raises:
        InputError: If there is no such preset or file, the file cannot be read, or a field is
            unknown, no finite number or outside its range. One line that names the field.
    """
    name, at, degrees = os.fspath(name_or_path).rpartition("@")
    if not at or os.path.exists(name_or_path):
        return _named(_SOIL, name_or_path)
    try:
        repose = math.radians(float(degrees))
    except ValueError:
        raise InputError(
            f"{_short(degrees)} is no angle of repose: give degrees, such as {name}@40."
        ) from None
    return soil_recorded({**dataclasses.asdict(_named(_SOIL, name)), "friction": repose})


def machine_named(name_or_path: str | os.PathLike[str]) -> WheelLoader:
    """A machine by the name of a preset or from a TOML file.

    Args:
        name_or_path: A name of `MACHINES`, or the path of a file whose keys are fields of
            `WheelLoader`: SI units, angles in degrees as `tilt_end_deg`, and angular speeds in
            degrees a second as `tilt_speed_deg`. `preset` names the machine that fields left out
            come from, by default the WA320.

    Returns:
        The machine, in SI units, radians, and radians a second.

    Raises:
        InputError: As of `soil_named`; also if the linkage or the speed controller cannot work.
    """
    return _named(_MACHINE, name_or_path)


def soil_recorded(parameters: object) -> Soil:
    """A soil from what a document, such as plan.json, recorded of it.

    Args:
        parameters: Fields of `Soil` by name, SI units and radians; one left out is gravel's.

    Raises:
        InputError: If it is no such mapping, or a field is unknown or makes no sense.
    """
    return _recorded(_SOIL, parameters)


def machine_recorded(parameters: object) -> WheelLoader:
    """A machine from what a document recorded of it, see `soil_recorded`.

    Raises:
        InputError: If it is no such mapping, or a field is unknown or makes no sense.
    """
    return _recorded(_MACHINE, parameters)


def check_soil(soil: Soil) -> None:
    """Refuses a soil that cannot be.

    Args:
        soil: Any soil.

    Raises:
        InputError: If a field is no finite number, outside its range, or at odds with another. One
            line with its name, its value and what it may be, angles in degrees.
    """
    _check(_SOIL, soil, str)


def check_machine(machine: WheelLoader) -> None:
    """Refuses a machine that cannot be, or that the simulator cannot play.

    Args:
        machine: Any machine.

    Raises:
        InputError: As of `check_soil`.
    """
    _check_machine(machine, str)


def _named(kind: _Kind[T], name_or_path: str | os.PathLike[str]) -> T:
    name = os.fspath(name_or_path)
    if name in kind.presets:
        return kind.presets[name]
    if os.path.isdir(name):
        raise InputError(f"{name}: is a folder: name a {kind.word} preset or a TOML file.")
    if not os.path.exists(name):
        raise InputError(
            f"{_short(name)}: no such {kind.word} preset or file"
            f"{_closest(name, kind.presets)}; presets: {', '.join(kind.presets)}."
        )
    try:
        return _from_toml(kind, Path(name))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error.__cause__


def _from_toml(kind: _Kind[T], path: Path) -> T:
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise InputError(f"is too large for a TOML file of a {kind.word}: name another.")
        document = tomllib.loads(content.decode("utf-8-sig"))
    except InputError:
        raise
    # Also a text that is not UTF-8, and integers of thousands of digits.
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read as TOML ({_line(error)}): check the file.") from error
    preset = document.pop("preset", None)
    base = kind.base
    if preset is not None:
        if not isinstance(preset, str) or preset not in kind.presets:
            raise InputError(
                f"preset is {_short(preset)}, which is no {kind.word}: choose one of "
                f"{', '.join(kind.presets)}."
            )
        base = kind.presets[preset]

    def label(field: str) -> str:
        return field + _DEGREES if kind.ranges[field].is_angular else field

    fields = {label(field): field for field in kind.ranges}
    changes = {}
    for key, value in document.items():
        if key in kind.ranges and key not in fields:
            raise InputError(
                f"{key} is an angle: write {key}{_DEGREES}, in {_in_words(kind.ranges[key])}."
            )
        if key not in fields:
            raise InputError(
                f"{_short(key)} is no field of a {kind.word}{_closest(key, fields)}: check the "
                f"spelling."
            )
        number = _number(key, value)
        changes[fields[key]] = math.radians(number) if key.endswith(_DEGREES) else number
    made = dataclasses.replace(base, **changes)
    _check_kind(kind, made, label)
    return made


def _recorded(kind: _Kind[T], parameters: object) -> T:
    if not isinstance(parameters, Mapping):
        raise InputError(f"the {kind.word} has no parameters: write the file again.")
    for key in parameters:
        if key not in kind.ranges:
            raise InputError(
                f"{_short(key)} is no field of a {kind.word}{_closest(str(key), kind.ranges)}: "
                f"write the file again."
            )
    made = dataclasses.replace(
        kind.base, **{key: _number(key, value) for key, value in parameters.items()}
    )
    _check_kind(kind, made, str)
    return made


def _check_kind(kind: _Kind[T], made: T, label: Callable[[str], str]) -> None:
    if isinstance(made, WheelLoader):
        _check_machine(made, label)
    else:
        _check(kind, made, label)


def _check(kind: _Kind[T], made: T, label: Callable[[str], str]) -> None:
    """Refuses values outside their ranges, or in the wrong order; `label` writes a field's name."""
    values = {}
    for field, allowed in kind.ranges.items():
        number = _number(label(field), getattr(made, field))
        # Rounded, or an angle at the very end of its range would be refused after conversion.
        value = round(math.degrees(number), 9) if allowed.is_angular else number
        if not allowed.low <= value <= allowed.high:
            raise InputError(
                f"{label(field)} is {_with_unit(value, allowed)}: give {allowed.low:g} to "
                f"{_with_unit(allowed.high, allowed)}."
            )
        values[field] = value
    for less, more in kind.ordered:
        if values[less] > values[more]:
            raise InputError(
                f"{label(less)} is {_with_unit(values[less], kind.ranges[less])}, more than "
                f"{label(more)}, {_with_unit(values[more], kind.ranges[more])}: change one of them."
            )


def _check_machine(machine: WheelLoader, label: Callable[[str], str]) -> None:
    _check(_MACHINE, machine, label)
    # The bucket pin with the boom lowered, over the cutting edge, which is then on the ground.
    pin = machine.pivot_height + machine.boom_length * math.sin(machine.boom_low)
    if not 0.0 <= pin < machine.tip_radius:
        raise InputError(
            f"tip_radius is {machine.tip_radius:g} m, and {label('boom_low')}, boom_length and "
            f"pivot_height put the bucket pin {pin:.3g} m over the ground: the lowered bucket "
            f"needs 0 m or more, and less than tip_radius."
        )
    # A machine that does not hold its travel speed, or does not reach it on the way back, is one
    # for which the closed forms of approach and retreat are not meant (seen: cycles of 440 s).
    speed, distance = machine.travel_speed, machine.approach_distance
    holding = machine.rolling_resistance * machine.mass * GRAVITY * speed
    reaching = machine.mass * speed**3 / (3.0 * distance)
    least = max(holding, reaching)
    if machine.wheel_power < least:
        what = "hold" if holding >= reaching else "reach"
        within = "" if holding >= reaching else f" within {distance:g} m"
        raise InputError(
            f"wheel_power is {machine.wheel_power:g} W, too little for {machine.mass:g} kg to "
            f"{what} a travel_speed of {speed:.3g} m/s{within}: give at least {least:.3g} W."
        )
    # The time stepping of the speed diverges beyond.
    stiffest = machine.mass / _LONGEST_STEP
    if machine.speed_gain > stiffest:
        raise InputError(
            f"speed_gain is {machine.speed_gain:g} N s/m, too stiff for a mass of "
            f"{machine.mass:g} kg: give at most {stiffest:g} N s/m."
        )


def _number(label: str, value: Any) -> float:
    """A finite number as float; truth values do not count as numbers."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise InputError(f"{label} is {_short(value)}: give a number.")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{label} is not finite: give a finite number.")
    return number


def _with_unit(value: float, allowed: Range) -> str:
    space = "" if allowed.is_angular or not allowed.unit else " "
    return f"{value:g}{space}{allowed.unit}"


def _in_words(allowed: Range) -> str:
    return "degrees" if allowed.unit == "°" else "degrees a second"


def _closest(word: str, known: Mapping[str, Any]) -> str:
    """The known words nearest to another one, as a part of a sentence; nothing if none is near."""
    near = difflib.get_close_matches(word[:60].lower(), known, n=2, cutoff=0.5)
    return f" (did you mean {' or '.join(near)}?)" if near else ""


def _line(error: Exception) -> str:
    reason = error.strerror if isinstance(error, OSError) else None
    text = " ".join((reason or str(error)).split())
    return text if len(text) <= 120 else text[:117] + "..."


def _short(value: object) -> str:
    """A value as it was written, in one line of at most 40 characters."""
    try:
        text = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # thousands of digits or levels
        text = type(value).__name__
    return text if len(text) <= 40 else text[:37] + "..."
