"""The one error that bad input raises; the command line prints it as a single line."""


class InputError(ValueError):
    """Input that cannot be used: says in one line what is wrong and what to do about it."""
