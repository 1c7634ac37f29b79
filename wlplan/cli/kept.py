"""`wlplan cache`: what is kept of compiled programs."""

from __future__ import annotations

import click

from wlplan.cli.options import with_options
from wlplan.cli.outputs import json_text
from wlplan.cli.said import say


@click.command(
    short_help="Show or clear compiled programs.",
    epilog="\b\nExample: wlplan cache --clear",
)
@with_options(click.option("--clear", "is_to_clear", is_flag=True, help="Remove all that is kept."))
def cache(is_to_clear: bool, seed: int, as_json: bool) -> None:
    """Show where compiled programs are kept, so that commands start sooner, or remove them.

    They are kept apart by processor and versions, in a folder that nobody else can write, and
    dropped after a run that was cut short, since JAX may end with a fault as it loads a wrong one.
    WLPLAN_CACHE=DIR in the environment keeps them elsewhere, WLPLAN_CACHE=off nowhere. Nothing is
    random, so --seed changes nothing.
    """
    from wlplan.cli import programs

    cleared = programs.clear() if is_to_clear else None
    found = programs.cache()
    files = found.programs()
    size = sum(path.stat().st_size for path in files)
    fields = {
        "folder": None if found.folder is None else str(found.folder),
        "reason": found.reason or None,
        "programs": len(files),
        "bytes": size,
        "made_with": programs.made_with(),
        "cleared": cleared,
    }
    if as_json:
        click.echo(json_text(fields))
        return
    if cleared is not None:
        say(f"removed {cleared} files")
    if found.folder is None:
        say(f"programs are not kept: {found.reason}")
        return
    say(f"{len(files)} programs, {size / 1e6:.1f} MB, in {found.folder}")
    for name, value in programs.made_with().items():
        if value:
            say(f"  {name}: {value}")
