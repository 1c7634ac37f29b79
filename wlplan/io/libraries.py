"""Other people's libraries: imported where they are installed, and kept from writing to stderr."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
from collections.abc import Iterator
from types import ModuleType

from wlplan.errors import InputError


@contextlib.contextmanager
def library(name: str, *, install: str) -> Iterator[ModuleType]:
    """A library that may be missing, as a context in which it logs nothing.

    What it logs would be a second line about a file that we refuse in one.

    Args:
        name: Name of its module.
        install: What pip has to install to have it.

    Raises:
        InputError: If it is not installed.
    """
    logger, silence = logging.getLogger(name), logging.NullHandler()
    before = logger.disabled, logger.propagate
    # What its modules log goes through its own logger, and no further.
    logger.disabled, logger.propagate = True, False
    logger.addHandler(silence)
    try:
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            raise InputError(
                f"needs {name}, which is not installed: run `pip install {install}`."
            ) from error
        yield module
    finally:
        logger.disabled, logger.propagate = before
        logger.removeHandler(silence)


@contextlib.contextmanager
def mute_stderr() -> Iterator[None]:
    """Send what other languages' libraries write to the process's stderr to nowhere."""
    keep = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(keep, 2)
        os.close(keep)
        os.close(nowhere)
