"""Constants of nature and of the paper, each with its source; the quantities of a load."""

from __future__ import annotations

from typing import NamedTuple

# Standard gravity [m/s^2].
GRAVITY = 9.81

# Kilograms in a tonne, joules in a kilojoule.
KG_PER_TONNE = 1000.0
J_PER_KJ = 1000.0

# Grid spacing of the models and of the paper's terrain [m]. Paper, section 5.1.
CELL_SIZE = 0.1

# Dumping [s]. Follow-up: 5 s, without work.
DUMP_TIME = 5.0

PERCENT_90 = 1.6449
"""Standard deviations on either side that hold 90 % of a normal distribution."""

# Box of the action parameters, in the order of `Action`. Paper, section 6.2.
ACTION_LOW = (0.0, 0.0, 0.0, 0.0)
ACTION_HIGH = (0.7, 5.0, 0.7, 5.0)


class Quantity(NamedTuple):
    """How a quantity of a loading is written for people."""

    title: str
    unit: str
    digits: int  # after the point, in tables


QUANTITIES = {
    "mass": Quantity("mass", "t", 2),
    "time": Quantity("time", "s", 1),
    "work": Quantity("work", "kJ", 0),
}
"""The quantities of a `Performance`, by the names of its fields and in their order."""

# Most that may be asked for in one plan: more is a slip of the keyboard.
MOST_LOADS, MOST_TONNES, MOST_TRUCKS = 500, 2_000.0, 50
# What is asked for if nobody says how much.
DEFAULT_LOADS = 15
# Payloads of trucks [tonne] and waits for the next one [s] that there are.
PAYLOADS, EXCHANGES = (1.0, 500.0), (0.0, 3600.0)
# Most of a pile that may be asked to remain of it [%].
MOST_REMAINING = 99.0
