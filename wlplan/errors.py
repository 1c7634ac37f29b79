"""The one error that bad input raises; the command line prints it as a single line."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used: says in one line what is wrong and what to do about it."""


def one_line(error: object) -> str:
    """The gist of a message: one line, at most 120 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:117] + "..."
