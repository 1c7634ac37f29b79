"""What is printed: text that no name of a file can turn into something else, on streams that last.

A name may hold what clears a terminal or sets its title, or no character at all. And whoever reads
may have gone: no work is lost for that.
"""

from __future__ import annotations

import contextlib
import os
import sys

from wlplan.errors import shown


def say(text: str) -> None:
    """Print a line of a result on stdout."""
    print(shown(text))


def tell(text: str) -> None:
    """Print a line on stderr, at once, if anybody reads it."""
    with contextlib.suppress(OSError, ValueError):
        print(shown(text), file=sys.stderr, flush=True)


def mend_streams() -> None:
    """Have streams that are closed lead nowhere.

    Whatever is opened next would take their place, and what a library prints would go into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # The lowest number that is free: this one.
            os.open(os.devnull, os.O_RDWR)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))
