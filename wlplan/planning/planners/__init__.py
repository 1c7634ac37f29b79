"""The planners. Each is a frozen dataclass, whose fields are its settings, in a file of its own.

A planner goes by the name of its file; its class has that name in capitals: `max_load.py` holds
`MaxLoad`. `NAMES` is read off the folder, so a new planner is a new file.
"""

import pkgutil
from typing import Any

import lazy_loader

from wlplan.errors import InputError

NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))
"""Names of the planners."""


def class_name(name: str) -> str:
    """The class that a planner's file holds: `max_load` is `MaxLoad`."""
    return "".join(part.capitalize() for part in name.split("_"))


def checked(value: Any) -> Any:
    """A planner that somebody else wrote, as it is.

    Raises:
        InputError: If it is none.
    """
    if isinstance(value, type) or not callable(getattr(value, "propose", None)):
        raise InputError(
            f"{value!r} is no planner: give a name, or an object with "
            f"propose(job, loads, *, seed, progress), such as wlplan.planners.Greedy()."
        )
    return value


__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submod_attrs={name: [class_name(name)] for name in NAMES}
)
