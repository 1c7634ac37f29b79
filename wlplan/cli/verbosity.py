"""How much a command tells on stderr."""

from __future__ import annotations

from typing import Any

import click

# Under this name a context of click has what `-q` and `-v` ask for.
_ASKED = "wlplan.asked"


def quiet_or_verbose(command: Any) -> Any:
    """A decorator: the options `-q` and `-v`."""

    def keep(context: click.Context, option: click.Parameter, value: bool) -> None:
        if value:
            if context.meta.get(_ASKED, option.name) != option.name:
                raise click.UsageError("-q and -v are both given", context)
            context.meta[_ASKED] = option.name

    for short, long, text in (
        ("-v", "--verbose", "Tell on stderr what is compiled and where it is kept."),
        ("-q", "--quiet", "No progress and no notes on stderr."),
    ):
        command = click.option(
            short, long, is_flag=True, expose_value=False, callback=keep, help=text
        )(command)
    return command


def is_asked(name: str) -> bool:
    """Whether the present command was asked to be "quiet" or "verbose"."""
    context = click.get_current_context(silent=True)
    return context is not None and context.meta.get(_ASKED) == name
