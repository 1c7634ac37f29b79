"""`wlplan serve`: a process that keeps all warm and answers over HTTP."""

from __future__ import annotations

import contextlib
import functools
import os
from typing import Any

import click

from wlplan.cli import programs
from wlplan.cli.inputs import check_models, model_fields, planner_named, site_named, world_named
from wlplan.cli.options import model_options, planner_option, site_options, world_option
from wlplan.cli.outputs import remark
from wlplan.cli.progress import Progress, Stopwatch
from wlplan.cli.verbosity import is_asked, quiet_or_verbose
from wlplan.errors import InputError
from wlplan.worlds.names import FOR_PLANNING

# Exit code after a second Ctrl-C.
_INTERRUPTED = 130
_INSTALL = "wlplan[serve]"


def _options(command: Any) -> Any:
    """A decorator: those of the server, of what it plans in, and how much it tells."""
    own = (
        click.option(
            "--host",
            default="127.0.0.1",
            show_default=True,
            help="Address to listen on. By default nobody but this machine can reach it.",
        ),
        click.option(
            "--port",
            type=click.IntRange(0, 65_535),
            default=8765,
            show_default=True,
            help="Port to listen on; 0: any that is free.",
        ),
        click.option(
            "--most-mb",
            type=click.IntRange(1, 4096),
            default=256,
            show_default=True,
            help="Largest request that is taken [MiB].",
        ),
        click.option(
            "--warm/--cold",
            default=True,
            show_default=True,
            help="Load the models and compile the search of a next load before listening.",
        ),
        world_option,
        planner_option,
        *site_options(),
        *model_options,
    )
    command = quiet_or_verbose(command)
    for option in reversed(own):
        command = option(command)
    return command


@click.command(
    short_help="Answer over HTTP, with a page to plan on.",
    epilog="\b\nExample: wlplan serve --port 8765",
)
@_options
def serve(
    host: str,
    port: int,
    most_mb: int,
    warm: bool,
    world_name: str,
    planner: str,
    soil: str | None,
    machine: str | None,
    model: str | None,
    pile_state: str | None,
) -> None:
    """Keep models and programs warm and answer over HTTP, until Ctrl-C.

    Open the address that is printed: drop a scan, click where the loader dumps, plan. Programs use
    POST /plan, /next-load and /scan. World and planner are what is used where a request names none.
    """
    check_models(model, pile_state, world_name)
    site = site_named(soil, machine)
    server = _library()
    kept = programs.cache_of_command()
    with contextlib.closing(server.bound(host, port)) as taken:
        with Progress(kept.seconds("serve")) as progress:
            progress.phase("starting")

            from wlplan.serve.app import make_app
            from wlplan.serve.service import Named, Service, Worlds
            from wlplan.serve.warming import warmed

            def make(name: str) -> Any:
                models = (model, pile_state) if name == world_name else (None, None)
                return world_named(name, site, *models)

            others = (name for name in FOR_PLANNING if name != world_name)
            service = Service(
                site,
                Worlds(make, (world_name, *others)),
                functools.partial(world_named, "simulator", site),
                Named(planner, planner_named(planner)),
                most_bytes=most_mb * 2**20,
                models=model_fields(model, pile_state),
            )
            if warm:
                with Stopwatch() as warming:
                    warmed(service, progress)
                kept.remember("serve", warming.compiling)
        ended = server.run(
            make_app(service, names=("localhost", host.lower()), log=_log),
            taken,
            service.desk,
            beginning=lambda: _say(host, taken.getsockname()[1], server.is_loopback(host)),
            note=remark,
        )
    print("stopped", flush=True)
    if not ended:
        programs.end()
        os._exit(_INTERRUPTED)


def _library() -> Any:
    """The part of the package that needs what is not always installed.

    Raises:
        InputError: If that is missing.
    """
    try:
        from wlplan.serve import server
    except ImportError as error:
        raise InputError(
            f"needs {error.name}, which is not installed: run `pip install '{_INSTALL}'`."
        ) from error
    return server


def _say(host: str, port: int, alone: bool) -> None:
    shown = f"[{host}]" if ":" in host else host
    print(f"http://{shown}:{port}/ answers: open it in a browser; Ctrl-C ends it", flush=True)
    if not alone:
        remark(
            f"whoever reaches port {port} of this machine can see the scans and plans that are "
            f"sent and keep it busy: there is no password and no encryption"
        )


def _log(line: str) -> None:
    if not is_asked("quiet"):
        print(line, flush=True)
