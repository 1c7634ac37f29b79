"""The ledger of a plan: does the mass that was loaded weigh what left the pile?"""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

# Relative error above which a ledger does not count as closed.
LEDGER_TOLERANCE = 1e-4


def volume_lost(ledger: Mapping[str, Any]) -> float:
    """Volume that left the pile [m^3]; nan if the ledger lacks an entry for it.

    Args:
        ledger: With `volume_before` and `volume_after` [m^3].
    """
    return _entry(ledger, "volume_before") - _entry(ledger, "volume_after")


def ledger_error(ledger: Mapping[str, Any]) -> float:
    """How far the mass loaded is off what the volume lost weighs, relative; 0 is closed.

    Args:
        ledger: With `volume_before` and `volume_after` [m^3], `density` [tonne/m^3] and
            `mass_removed` [tonne].

    Returns:
        The error, relative to the larger of the two masses; nan if the ledger lacks an entry.
    """
    lost = _entry(ledger, "density") * volume_lost(ledger)
    mass = _entry(ledger, "mass_removed")
    return abs(mass - lost) / max(abs(mass), abs(lost), 1e-3)


def _entry(ledger: Mapping[str, Any], name: str) -> float:
    value = ledger.get(name)
    return float(value) if isinstance(value, Real) else math.nan
