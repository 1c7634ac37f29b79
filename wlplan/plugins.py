"""Objects of other packages by name: `package.module:Name`."""

from __future__ import annotations

import importlib
from typing import Any

from wlplan.errors import InputError, one_line


def is_reference(text: str) -> bool:
    """Whether a text has the form `package.module:Name`."""
    module, colon, name = text.partition(":")
    return bool(colon) and all(part.isidentifier() for part in [*module.split("."), name])


def load_object(reference: str) -> Any:
    """What a reference `package.module:Name` names.

    Raises:
        InputError: If there is no such module or name, or importing it fails.
    """
    module_name, _, name = reference.partition(":")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        what = one_line(error)
        raise InputError(
            f"{reference}: {module_name} cannot be imported ({type(error).__name__}: {what}): "
            f"check the name, or put its folder on PYTHONPATH."
        ) from error
    try:
        return getattr(module, name)
    except AttributeError as error:
        raise InputError(f"{reference}: {module_name} has no {name}: check the name.") from error
