"""Numbers as people write them; a dash where there is none."""

from __future__ import annotations

import math
from numbers import Real

from wlplan.constants import PERCENT_90

__all__ = [
    "capitalise",
    "coordinate",
    "degrees",
    "difference",
    "half",
    "minutes",
    "nine_in_ten",
    "number",
    "percent",
    "plain",
    "share",
]

DASH, MINUS, NO_BREAK = "–", "−", "\u00a0"


def capitalise(text: object) -> str:
    """A text with a capital at its beginning, all else as it is."""
    return str(text)[:1].upper() + str(text)[1:]


def finite(value: object) -> float | None:
    """A value of a document as a number; None if it is missing or none."""
    return float(value) if isinstance(value, Real) and math.isfinite(value) else None


def number(value: object, digits: int = 2) -> str:
    """A number for people; a dash where there is none."""
    known = finite(value)
    return DASH if known is None else f"{known:,.{digits}f}".replace("-", MINUS)


def minutes(seconds: object) -> str:
    """A time for people; a dash where there is none."""
    known = finite(seconds)
    if known is None:
        return DASH
    whole, rest = divmod(round(known), 60)
    return f"{whole}{NO_BREAK}min {rest:02d}{NO_BREAK}s" if whole else f"{rest}{NO_BREAK}s"


def coordinate(value: object, offset: float) -> str:
    """A local coordinate in that of the scan [m]; a dash if it is missing."""
    known = finite(value)
    return DASH if known is None else f"{known + offset:.2f}".replace("-", MINUS)


def degrees(angle: object) -> int | None:
    """Whole degrees of an angle [rad]."""
    known = finite(angle)
    return None if known is None else round(math.degrees(known))


def half(value: object) -> str:
    """Half of an interval, to one digit that counts; a dash where there is none."""
    known = finite(value)
    if known is None:
        return DASH
    return f"{known:.1g}" if known < 1.0 else f"{known:,.0f}"


def nine_in_ten(deviation: object) -> str:
    """Half of the interval that holds nine in ten, of a standard deviation."""
    known = finite(deviation)
    return DASH if known is None else half(PERCENT_90 * known)


def difference(predicted: object, simulated: object) -> str:
    """How far a prediction is off, relative; a dash where that is unknown."""
    p, s = finite(predicted), finite(simulated)
    if p is None or not s:
        return DASH
    return f"{100.0 * (p / s - 1.0):+.1f}{NO_BREAK}%".replace("-", MINUS)


def percent(part: object) -> str:
    """A part in percent, to two digits that count; a dash where there is none."""
    known = finite(part)
    return DASH if known is None else f"{100.0 * known:.2g} %"


def share(part: object) -> str:
    """A probability in whole percent; a dash where there is none."""
    known = finite(part)
    return DASH if known is None else f"{100.0 * known:.0f}{NO_BREAK}%"


def plain(value: object) -> str:
    """A value of a document, lists without brackets and numbers without noise."""
    if isinstance(value, list | tuple):
        return ", ".join(plain(part) for part in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)
