"""The one error that bad input raises; the command line prints it as a single line."""

from __future__ import annotations

import unicodedata

# Kinds of characters that no one sees: controls, directions of writing, surrogates, breaks.
_UNSEEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


class InputError(ValueError):
    """Input that cannot be used: says in one line what is wrong and what to do about it."""


def shown(text: object) -> str:
    """A text as it may be printed: what is no character, or steers a terminal, as an escape."""
    return "".join(
        c.encode("unicode_escape").decode() if unicodedata.category(c) in _UNSEEN else c
        for c in str(text)
    )


def one_line(error: object) -> str:
    """The gist of a message: one line, at most 120 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:117] + "..."
