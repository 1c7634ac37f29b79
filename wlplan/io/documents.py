"""JSON that somebody else may have written: only what JSON is, with numbers that are finite."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from wlplan.errors import InputError, one_line


def parse_json(content: str | bytes) -> Any:
    """What a JSON text holds.

    Python's own reader also takes NaN and infinity, numbers that are infinite as a float, and whole
    ones that no float is large enough for.

    Args:
        content: The text; bytes are taken as UTF-8.

    Raises:
        InputError: If it is no JSON, or a number in it is not finite or too large.
    """
    try:
        text = content.decode() if isinstance(content, bytes) else content
        return json.loads(text, parse_int=_whole, parse_float=_finite, parse_constant=_finite)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not valid JSON ({one_line(error)}): write it again.") from error


def check_kinds(record: Mapping[str, Any], kinds: Mapping[str, type | tuple[type, ...]]) -> None:
    """Refuses a record in which a field that is there has a value of another kind.

    Args:
        record: Content of a document.
        kinds: What the values of fields have to be, by their names; truth values are no numbers.

    Raises:
        InputError: If one is not.
    """
    for name, kind in kinds.items():
        value = record.get(name)
        if name in record and (not isinstance(value, kind) or isinstance(value, bool)):
            raise InputError(f"`{name}` is {one_line(repr(value))}: it is damaged; copy it again.")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise InputError(f"holds {one_line(text)}, which is not a finite number: write it again.")
    return value


def _whole(text: str) -> int:
    # As long as a text that no float has is, Python refuses to make a number of it.
    _finite(text)
    return int(text)
