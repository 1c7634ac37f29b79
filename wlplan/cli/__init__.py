"""The command line: `wlplan plan`, `simulate`, `diggability`, `collect`, `train`, and so on.

Results go to stdout, progress and remarks to stderr. Bad input ends with one line on stderr and
exit code 2. What is slow to import is imported inside the commands, so that help and usage errors
come at once.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import NoReturn

import click

from wlplan.cli import (
    benchmark,
    exporting,
    gradients,
    info,
    kept,
    learning,
    maps,
    planning,
    programs,
    serving,
)
from wlplan.cli.said import mend_streams, tell
from wlplan.errors import InputError

# Commands in which a person waits for what is compiled. What `collect` and `train` make is to be
# the same to the bit as from Python, so XLA is there as it is by default.
_IN_A_HURRY = ("plan", "simulate", "serve", "diggability")
# Commands in which nothing is compiled.
_WITHOUT_PROGRAMS = ("info", "cache")


class _InOrder(click.Group):
    """A group that lists its commands in the order in which they were added."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(
    cls=_InOrder,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="\b\nExample: wlplan plan --loads 5 --out plan/\n"
    "Options of a command: wlplan COMMAND --help",
)
@click.version_option(package_name="wlplan", message="%(prog)s %(version)s")
@click.pass_context
def wlplan(context: click.Context) -> None:
    """Plan the bucket loads of a wheel loader from a scan of the pile.

    PILE is a heightmap (.npz, GeoTIFF as .tif or .tiff, an ASCII grid as .asc, a grid_map in .bag,
    .mcap or .db3), a point cloud (.las, .laz, .ply, .pcd, .e57, text as .xyz, .csv or .txt) or a
    mesh (.obj, .stl). The word `bundled` stands for the pile that ships with the package. It is
    the default where PILE may be left out.
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())
    elif context.invoked_subcommand not in _WITHOUT_PROGRAMS:
        if context.invoked_subcommand in _IN_A_HURRY:
            programs.compile_fast()
        context.obj = programs.use_cache()


# In the order in which people use them, which is that of the help.
for _command in (
    *(info.info, planning.plan, planning.simulate, serving.serve, maps.diggability),
    *(learning.collect, learning.train, learning.evaluate, exporting.export),
    *(gradients.gradcheck, benchmark.bench, kept.cache),
):
    wlplan.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Words after `wlplan`; by default those of the process.

    Returns:
        Exit code: 0 done, 1 a fault of wlplan, 2 bad input or usage, 130 interrupted.
    """
    mend_streams()
    if "_WLPLAN_COMPLETE" in os.environ:  # the shell asks for completions
        wlplan.main(prog_name="wlplan")
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Tracing makes objects by the million and hardly a cycle: looking for them takes a twentieth.
    gc.set_threshold(100_000, 20, 20)
    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
        _quieten()
        try:
            with wlplan.make_context("wlplan", words) as context:
                wlplan.invoke(context)
            sys.stdout.flush()
            return 0
        except click.exceptions.Exit as stop:
            return stop.exit_code
        except click.ClickException as error:
            return _fail(_usage_message(error), 2)
        except InputError as error:
            return _fail(str(error), 2)
        except (KeyboardInterrupt, click.Abort):
            return _fail("interrupted: no half-written files are left; run it again.", 130)
        except BrokenPipeError:
            # The reader of our output has closed it: end quietly, also when Python flushes stdout.
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except MemoryError:
            return _fail("out of memory: use a smaller pile, or fewer loads or locations.", 2)
        except OSError as error:
            place = f"{error.filename}: " if error.filename else ""
            reason = error.strerror or str(error)
            return _fail(f"{place}{reason}: check the path and the free space.", 2)
        except Exception as error:
            if os.environ.get("WLPLAN_DEBUG"):
                traceback.print_exc()
            return _fail(
                f"this should not happen ({type(error).__name__}: {error}): please report it; "
                f"WLPLAN_DEBUG=1 shows where.",
                1,
            )


def run() -> NoReturn:
    """The command line as a process, which SIGTERM ends as Ctrl-C does.

    It does not wait for what is still compiled, which nobody needs any more.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    code = main()
    compiling = getattr(sys.modules.get("wlplan.parallel"), "is_compiling_ahead", None)
    if compiling is not None and compiling():
        programs.end()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
    sys.exit(code)


def _fail(message: str, code: int) -> int:
    text = " ".join(message.split())
    tell(f"error: {text if len(text) <= 600 else text[:597] + '...'}")
    return code


def _usage_message(error: click.ClickException) -> str:
    message = error.format_message().rstrip(".")
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "wlplan"
    return f"{message}: see `{command} --help`."


def _quieten() -> None:
    """Keep libraries from writing to stderr, and let stdout take any character."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    logging.getLogger("jax._src.xla_bridge").setLevel(logging.ERROR)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
