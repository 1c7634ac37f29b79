"""Where the trucks of a plan.json stand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlplan.site.stands import stands

# Of the loader as it dumps: x [m], y [m] and heading [rad].
_FIELDS = ("x", "y", "heading")


def stands_of(document: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Who stands at each of the different places, in words, and the place; none if none is named.

    Args:
        document: Content of a plan.json; what `trucks` says counts before `receiver`.
    """
    trucks = document.get("trucks")
    places = [truck for truck in trucks if _is_place(truck)] if isinstance(trucks, list) else []
    if not places or len(places) < len(trucks or ()):
        # One that lacks a number is for the page to show so.
        receiver: Any = document.get("receiver")
        places = [receiver] if isinstance(receiver, Mapping) and receiver else []
    keys = [tuple(str(place.get(name)) for name in _FIELDS) for place in places]
    return [(who, places[truck]) for who, truck in stands(keys)] if places else []


def _is_place(record: object) -> bool:
    return isinstance(record, Mapping) and all(name in record for name in _FIELDS)
