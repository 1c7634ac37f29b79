"""Settings of a request: the options of `wlplan plan` by the same names, with `_` for `-`.

They come in the query, as text, or as a JSON object. No setting names a file or a module.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from wlplan.constants import (
    DEFAULT_LOADS,
    EXCHANGES,
    MOST_LOADS,
    MOST_REMAINING,
    MOST_TONNES,
    MOST_TRUCKS,
    PAYLOADS,
)
from wlplan.errors import InputError, one_line
from wlplan.planning.objectives import OBJECTIVES

if TYPE_CHECKING:
    from wlplan.planning.amounts import Amount

_UPS = ("x", "y", "z", "-x", "-y", "-z")
_LONGEST = 200


class Kind(NamedTuple):
    """What a setting may be."""

    check: Callable[[Any], Any]  # the value, made of that of JSON; raises ValueError: what it is
    is_text: bool = False  # whether the text of a query is the value itself


def _number(low: float, high: float, *, above: bool = False) -> Kind:
    """A number in a range; `above`: without its lower end."""
    words = (
        f"a number above {low:g}, up to {high:g}" if above else f"a number from {low:g} to {high:g}"
    )

    def check(value: Any) -> float:
        number = _finite(value, words)
        if not (low < number if above else low <= number) or number > high:
            raise ValueError(words)
        return number

    return Kind(check)


def _whole(low: int, high: int) -> Kind:
    words = f"a whole number from {low} to {high}"

    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError(words)
        return value

    return Kind(check)


def _numbers(words: str, least: int, most: int) -> Kind:
    """A list of finite numbers."""

    def check(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or not least <= len(value) <= most:
            raise ValueError(words)
        return tuple(_finite(one, words) for one in value)

    return Kind(check)


def _finite(value: Any, words: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not abs(value) < 1e12:
        raise ValueError(words)
    return float(value)


def _one_of(names: Collection[str]) -> Kind:
    def check(value: Any) -> str:
        if value not in tuple(names):
            raise ValueError(f"one of {', '.join(names)}")
        return str(value)

    return Kind(check, is_text=True)


def _text(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= _LONGEST:
        raise ValueError(f"a text of at most {_LONGEST} characters")
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def _truck(words: str, *others: str) -> Kind:
    """A place, or one of some words."""
    place = _numbers(words, 2, 3)
    return Kind(lambda value: value if value in others else place.check(value))


def _areas(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("a GeoJSON object")
    return value


AMOUNT = {
    "loads": _whole(1, MOST_LOADS),
    "tonnes": _number(0.0, MOST_TONNES, above=True),
    "trucks": _whole(1, MOST_TRUCKS),
    "payload": _number(*PAYLOADS),
    "exchange": _number(*EXCHANGES),
    "empty": Kind(_flag),
    "remaining": _number(0.0, MOST_REMAINING),
}
"""How much is to be loaded."""

READING = {
    "band": _whole(1, 65_535),
    "crop": _numbers("[x0, y0, x1, y1]", 4, 4),
    "layer": Kind(_text, is_text=True),
    "up": _one_of(_UPS),
    "ground": _number(-1e4, 1e4),
    "pile": _numbers("[x, y]", 2, 2),
    "include": _numbers("[x, y]", 2, 2),
}
"""How a scan is read: arguments of `wlplan.io.read_scan`."""

AREAS = {"keep_out": Kind(_areas), "truck_area": Kind(_areas)}
"""Likewise, but for what is a file there: the GeoJSON itself."""

SCAN = {"scan": Kind(_text, is_text=True), "name": Kind(_text, is_text=True), **READING, **AREAS}
"""Which scan, and how it is read."""


def choices(worlds: Collection[str], planners: Collection[str]) -> dict[str, Kind]:
    """What has to be one of some names.

    Args:
        worlds: Names of the worlds.
        planners: Those of the planners.
    """
    return {
        "world": _one_of(worlds),
        "planner": _one_of(planners),
        "objective": _one_of(tuple(OBJECTIVES)),
    }


_PLACE = "[x, y] or [x, y, heading in degrees]"
NEXT_LOAD = {"truck": _truck(_PLACE), "seed": _whole(0, 2**31 - 1)}
"""What else goes with a next load: where the loader dumps, and the seed."""

PLANNING = {
    **AMOUNT,
    **NEXT_LOAD,
    "truck": _truck(f"{_PLACE}, auto or each", "auto", "each"),
    "referee": Kind(_flag),
    "background": Kind(_flag),
}
"""What else goes with a plan."""


def from_query(query: Mapping[str, str], kinds: Mapping[str, Kind]) -> dict[str, Any]:
    """Settings of a query: numbers as they are, lists with commas, objects as JSON.

    Raises:
        InputError: If one is unknown, or no such value.
    """
    return from_json(
        {
            name: text if name in kinds and kinds[name].is_text else _value(text)
            for name, text in query.items()
        },
        kinds,
    )


def from_json(values: Mapping[str, Any], kinds: Mapping[str, Kind]) -> dict[str, Any]:
    """Settings of a JSON object; `null` counts as not given.

    Args:
        values: The object.
        kinds: What may be given, by name.

    Raises:
        InputError: If one is unknown, or no such value.
    """
    found = {}
    for name, value in values.items():
        if name not in kinds:
            raise InputError(
                f"there is no setting {one_line(repr(name))} here: use {', '.join(kinds)}."
            )
        if value is None:
            continue
        try:
            found[name] = kinds[name].check(value)
        except ValueError as error:
            raise InputError(f"{name} is {one_line(repr(value))}: give {error}.") from error
    return found


def object_of(content: bytes) -> dict[str, Any]:
    """The JSON object of a request.

    Raises:
        InputError: If it is none.
    """
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is not valid JSON ({one_line(error)}).") from error
    if not isinstance(found, dict):
        raise InputError("the request is no JSON object: give settings by name.")
    return found


def _value(text: str) -> Any:
    """The value that a text of a query stands for."""
    for attempt in (text, f"[{text}]"):
        try:
            return json.loads(attempt)
        except (ValueError, RecursionError):
            continue
    return text


def amount_of(settings: Mapping[str, Any]) -> Amount:
    """How much is to be loaded.

    Args:
        settings: Checked ones, of `AMOUNT` and others.

    Raises:
        InputError: If they do not go together.
    """
    from wlplan.planning.amounts import Empty, Loads, Tonnes, Trucks

    given = {name: settings[name] for name in AMOUNT if settings.get(name) not in (None, False)}
    named = [name for name in ("loads", "tonnes", "trucks", "empty") if name in given]
    if len(named) > 1:
        raise InputError(f"{' and '.join(named)} do not go together: give one of them.")
    if ("trucks" in given) != ("payload" in given):
        raise InputError("trucks and payload go together: give both.")
    for name, other in (("exchange", "trucks"), ("remaining", "empty")):
        if name in given and other not in given:
            raise InputError(f"{name} goes with {other}.")
    if "tonnes" in given:
        return Tonnes(given["tonnes"])
    if "trucks" in given:
        filled = Trucks(given["trucks"], given["payload"])
        return filled.replace(exchange=given["exchange"]) if "exchange" in given else filled
    if "empty" in given:
        return Empty(given["remaining"] / 100.0) if "remaining" in given else Empty()
    return Loads(given.get("loads", DEFAULT_LOADS))


def finite(value: object) -> float | None:
    """A number for JSON; None for one that is not finite."""
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
