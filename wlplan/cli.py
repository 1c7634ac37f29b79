"""The command line: `wlplan plan`, `simulate`, `diggability`, `gradcheck`, `collect`, and so on.

Results go to stdout, progress and remarks to stderr. Whatever is wrong with the input comes back as
one line on stderr and exit code 2. What is slow to import is imported inside the commands, so that
help and usage errors come at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import math
import os
import secrets
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wlplan.errors import InputError
from wlplan.units import ACTION_HIGH, ACTION_LOW

if TYPE_CHECKING:
    from rich.progress import TaskID

    from wlplan.gradcheck import GradientCheck
    from wlplan.planner import PlanResult
    from wlplan.transport import Receiver
    from wlplan.types import Performance, Pile, World

# Names that the modules behind define, repeated here to keep help fast; a test compares them.
WORLDS = ("low", "high", "hybrid", "simulator")
PLANNERS = ("gradient", "greedy", "nominal")
OBJECTIVES = ("efficiency", "productivity", "energy")

# What stands for the pile that ships with the package where a file is asked for.
BUNDLED = "bundled"

_PILE_ENDINGS = (".npz", ".tif", ".tiff", ".las", ".laz", ".ply")
# Most loads of a plan, most locations of a map, and most cycles of a data set, which is 27 GB.
_MOST_LOADS, _MOST_LOCATIONS, _MOST_CYCLES = 500, 10_000, 1_000_000
# Farthest that a truck may stand from the middle of the map [m].
_FARTHEST_TRUCK = 500.0
# Seconds between two lines of progress where no bar can be shown.
_PROGRESS_PAUSE = 10.0
_MAP_FORMAT = "wlplan.diggability/1"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Words after `wlplan`; by default those of the process.

    Returns:
        Exit code: 0 done, 1 a fault of ours, 2 bad input or usage, 130 interrupted.
    """
    if "_WLPLAN_COMPLETE" in os.environ:  # the shell asks for completions
        wlplan.main(prog_name="wlplan")
    words = list(sys.argv[1:] if arguments is None else arguments)
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
            return _fail("interrupted: nothing half-written is left; run it again.", 130)
        except BrokenPipeError:
            # Whoever read our output has closed it: end quietly, also when Python flushes stdout.
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


def _fail(message: str, code: int) -> int:
    text = " ".join(message.split())
    with contextlib.suppress(OSError, ValueError):
        print(f"error: {text if len(text) <= 600 else text[:597] + '...'}", file=sys.stderr)
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


# --- options


class _Numbers(click.ParamType):
    """Numbers with commas between them."""

    def __init__(self, form: str, least: int):
        self.name = form
        self._form = form
        self._counts = range(least, form.count(",") + 2)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self._form

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in self._counts or not all(math.isfinite(n) for n in numbers):
            self.fail(f"{value!r} is not of the form {self._form}, with finite numbers", param, ctx)
        return numbers


class _ActionNumbers(_Numbers):
    """The four parameters of the bucket-filling controller, inside their box."""

    def __init__(self) -> None:
        super().__init__("DELTA_BM,K_BM,DELTA_BK,K_BK", 4)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        numbers = super().convert(value, param, ctx)
        for name, number, low, high in zip(
            self.name.lower().split(","), numbers, ACTION_LOW, ACTION_HIGH, strict=True
        ):
            if not low <= number <= high:
                self.fail(
                    f"{name} is {number:g}, outside its range {low:g} to {high:g}", param, ctx
                )
        return numbers


def _options(*options: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Several click options at once, then those that every command has."""
    common = (
        click.option(
            "--seed",
            type=click.IntRange(0, 2**31 - 1),
            default=0,
            show_default=True,
            help="Seed of everything random.",
        ),
        click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout."),
    )

    def decorate(command: Any) -> Any:
        for option in reversed((*options, *common)):
            command = option(command)
        return command

    return decorate


_pile_argument = click.argument("pile_file", metavar="[PILE]", default=BUNDLED)
_world_option = click.option(
    "--world",
    "world_name",
    type=click.Choice(WORLDS),
    default="low",
    show_default=True,
    help="What predicts: a learned world or the simulator.",
)
_model_option = click.option(
    "--model",
    metavar="DIR",
    default=None,
    help="Model from `wlplan train` in place of the one that ships with the package.",
)
_truck_option = click.option(
    "--truck",
    type=_Numbers("X,Y[,HEADING_DEG]", 2),
    default=None,
    help="Where the loader stands when it dumps [m], in the frame of the scan, and which way it "
    "then heads; without a heading the one with the shortest ways. Default: 12 m west of the pile.",
)
_out_option = click.option(
    "--out", metavar="DIR", default=None, help="Folder to write to; made if it is missing."
)


@click.group(
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="wlplan", message="%(prog)s %(version)s")
@click.pass_context
def wlplan(context: click.Context) -> None:
    """Plan the bucket loads of a wheel loader from a scan of the pile.

    PILE is a height map (.npz, GeoTIFF) or a point cloud (.las, .laz, .ply) in metres; without it,
    or as the word `bundled`, the pile that ships with the package is used.
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


# --- plan


@wlplan.command()
@_pile_argument
@_options(
    click.option(
        "--loads",
        type=click.IntRange(1, _MOST_LOADS),
        default=15,
        show_default=True,
        help="Number of bucket loads.",
    ),
    _world_option,
    click.option(
        "--planner", type=click.Choice(PLANNERS), default="gradient", show_default=True, help="How."
    ),
    click.option(
        "--objective",
        type=click.Choice(OBJECTIVES),
        default="efficiency",
        show_default=True,
        help="What for.",
    ),
    click.option(
        "--referee/--no-referee",
        default=True,
        show_default=True,
        help="Let the simulator pick among the planner's best plans.",
    ),
    _truck_option,
    _model_option,
    _out_option,
)
def plan(
    pile_file: str,
    loads: int,
    world_name: str,
    planner: str,
    objective: str,
    referee: bool,
    truck: tuple[float, ...] | None,
    model: str | None,
    out: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Plan the next loads from PILE and play the plan in the simulator.

    With --out: plan.json, plan.png, totals.png and report.html, which shows everything.
    """
    _check_pile_name(pile_file)
    _check_model(model, world_name)
    folder = None if out is None else _checked_folder(out)

    from wlplan.io import plan_to_dict
    from wlplan.planner import plan_loads, play

    pile, source = _read_pile(pile_file)
    receiver = _receiver(pile, truck)
    world, simulator = _load_world(world_name, model), _load_world("simulator", None)
    with _Progress() as progress:
        with _Stopwatch() as planning:
            planned = _ready(
                plan_loads(
                    world,
                    pile,
                    loads=loads,
                    objective=objective,
                    planner=planner,
                    receiver=receiver,
                    seed=seed,
                    referee=simulator if referee and world_name != "simulator" else None,
                    progress=progress,
                )
            )
        with _Stopwatch() as playing:
            if world_name == "simulator":
                simulated = planned
            elif planned.refereed is not None:
                simulated = planned.refereed
            else:
                progress("simulator", 0, 1, None)
                simulated = _ready(
                    play(simulator, pile, planned.plan, objective=objective, receiver=receiver)
                )
                progress("simulator", 1, 1, None)

    document = plan_to_dict(
        planned.plan,
        predicted=planned.rollout.performance,
        simulated=simulated.rollout.performance,
        transport={"time": planned.transport_time, "work": planned.transport_work},
        pile=source,
        world=world_name,
        planner=planner,
        objective=objective,
        referee=referee,
        seed=seed,
        **({} if model is None else {"model": model}),
        receiver=_receiver_fields(receiver),
        total={
            "predicted": _totals(planned.rollout.performance, planned.cost),
            "simulated": _totals(simulated.rollout.performance, simulated.cost),
            "transport": {
                "time": _sum(planned.transport_time),
                "work": _sum(planned.transport_work),
            },
        },
        ledger=_ledger(pile, simulated, simulator),
    )
    text = _json_text(document)
    seconds = {"planning": planning.text()}
    if planned.refereed is None:
        seconds["simulator"] = playing.text()
    if folder is not None:
        _write_plan(folder, document, pile, planned, simulated, receiver, seconds)
    _remark_on_ledger(document["ledger"])
    if as_json:
        click.echo(text)
        return
    _print_plan(document)
    print("; ".join(f"{name} {text}" for name, text in seconds.items()))
    if folder is None:
        print("nothing written: --out DIR writes the plan, the figures and a report")
    else:
        print(f"written: {folder / 'report.html'}, and plan.json, plan.png, totals.png beside it")


def _write_plan(
    folder: Path,
    document: Mapping[str, Any],
    pile: Pile,
    planned: PlanResult,
    simulated: PlanResult,
    receiver: Receiver,
    seconds: Mapping[str, str],
) -> None:
    from wlplan import plots
    from wlplan.io import write_bytes_atomic, write_plan
    from wlplan.report import write_report

    count = len(document["loads"])
    maps = plots.png_bytes(
        plots.plan_figure(
            pile,
            simulated.rollout.pile,
            planned.plan,
            receiver=receiver,
            after_title=f"After {count} load{'s' if count > 1 else ''} in the simulator",
        )
    )
    totals = plots.png_bytes(
        plots.totals_figure(planned.rollout.performance, simulated.rollout.performance)
    )
    with _staged(folder) as staging:
        write_plan(staging / "plan.json", document)
        write_bytes_atomic(staging / "plan.png", maps)
        write_bytes_atomic(staging / "totals.png", totals)
        write_report(
            staging,
            document,
            figures=((maps, "The pile and the digs"), (totals, "Predicted beside simulated")),
            settings={f"{name}, wall clock": text for name, text in seconds.items()},
        )


# --- simulate


@wlplan.command()
@click.argument("pile_file", metavar="PILE")
@click.argument("plan_file", metavar="PLAN.json")
@_options(_truck_option)
def simulate(
    pile_file: str, plan_file: str, truck: tuple[float, ...] | None, seed: int, as_json: bool
) -> None:
    """Play PLAN.json in the simulator on PILE and compare with what was predicted.

    The truck is that of the plan, unless --truck is given. The simulator has no randomness, so
    --seed changes nothing.
    """
    _check_pile_name(pile_file)

    from wlplan.io import plan_to_dict, read_plan
    from wlplan.planner import play

    loading_plan, given = read_plan(plan_file)
    pile, source = _read_pile(pile_file)
    made_for = given.get("pile")
    if isinstance(made_for, dict) and made_for.get("sha256", source["sha256"]) != source["sha256"]:
        _remark("the plan was made for another pile file than this one")
    objective = given.get("objective")
    objective = objective if objective in OBJECTIVES else OBJECTIVES[0]
    receiver = _receiver(pile, truck if truck is not None else _truck_of(given))
    with _Progress() as progress, _Stopwatch() as playing:
        progress("simulator", 0, 1, None)
        simulator = _load_world("simulator", None)
        played = _ready(play(simulator, pile, loading_plan, objective=objective, receiver=receiver))
        progress("simulator", 1, 1, None)

    predicted = _predicted_of(given)
    total = {
        "simulated": _totals(played.rollout.performance, played.cost),
        "transport": {"time": _sum(played.transport_time), "work": _sum(played.transport_work)},
    }
    if predicted is not None:
        total = {"predicted": _given_totals(predicted, given), **total}
    document = plan_to_dict(
        loading_plan,
        predicted=predicted,
        simulated=played.rollout.performance,
        transport={"time": played.transport_time, "work": played.transport_work},
        pile=source,
        **{name: given[name] for name in _ORIGIN_FIELDS if name in given},
        objective=objective,
        receiver=_receiver_fields(receiver),
        total=total,
        ledger=_ledger(pile, played, simulator),
    )
    text = _json_text(document)
    _remark_on_ledger(document["ledger"])
    if as_json:
        click.echo(text)
        return
    _print_plan(document)
    print(f"simulator {playing.text()}")


def _truck_of(document: Mapping[str, Any]) -> tuple[float, ...] | None:
    """The truck that a plan was made for, as of the option; None if it names none."""
    record = document.get("receiver")
    values = [record.get(name) if isinstance(record, dict) else None for name in _RECEIVER_FIELDS]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return None
    x, y, heading = (float(v) for v in values if v is not None)
    return x, y, math.degrees(heading)


def _predicted_of(document: Mapping[str, Any]) -> Performance | None:
    """What a plan predicts of its loads; None unless it does of all of them."""
    import numpy as np

    from wlplan.types import Performance

    rows = []
    for load in document["loads"]:
        record = load.get("predicted")
        values = [record.get(q) if isinstance(record, dict) else None for q in _QUANTITIES]
        if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            return None
        rows.append(values)
    return Performance(*np.array(rows, dtype=float).T)


def _given_totals(predicted: Performance, document: Mapping[str, Any]) -> dict[str, float]:
    totals = _totals(predicted, math.nan)
    del totals["cost"]
    try:
        cost = document["total"]["predicted"]["cost"]
    except (KeyError, TypeError):
        cost = None
    return {**totals, "cost": float(cost)} if isinstance(cost, int | float) else totals


# --- diggability


@wlplan.command()
@_pile_argument
@_options(
    click.option(
        "--locations",
        type=click.IntRange(1, _MOST_LOCATIONS),
        default=150,
        show_default=True,
        help="Number of dig locations around the pile.",
    ),
    click.option(
        "--action",
        type=_ActionNumbers(),
        default="0.68,4.51,0.17,4.46",
        show_default=True,
        help="Parameters of the bucket-filling controller, the same everywhere.",
    ),
    _world_option,
    _model_option,
    _out_option,
)
def diggability(
    pile_file: str,
    locations: int,
    action: tuple[float, ...],
    world_name: str,
    model: str | None,
    out: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Map what one action would yield all around PILE.

    With --out: diggability.png and diggability.json. Nothing is random, so --seed changes nothing.
    """
    _check_pile_name(pile_file)
    _check_model(model, world_name)
    folder = None if out is None else _checked_folder(out)

    import numpy as np

    from wlplan.diggability import diggability_map
    from wlplan.types import Action

    pile, source = _read_pile(pile_file)
    world = _load_world(world_name, model)
    fixed = Action(*action)  # type: ignore[arg-type]
    with _Progress() as progress, _Stopwatch() as mapping:
        progress("diggability", 0, 1, None)
        found = _ready(diggability_map(world, pile, locations=locations, action=fixed))
        progress("diggability", 1, 1, None)

    records = {
        name: np.asarray(getattr(part, name), np.float64)
        for part in (found.pose, found.performance)
        for name in (field.name for field in dataclasses.fields(part))
    }
    summary = {
        q: {
            "least": float(records[q].min()),
            "median": float(np.median(records[q])),
            "most": float(records[q].max()),
        }
        for q in _QUANTITIES
    }
    names = [field.name for field in dataclasses.fields(Action)]
    document = {
        "format": _MAP_FORMAT,
        "pile": source,
        "world": world_name,
        "action": dict(zip(names, action, strict=True)),
        "summary": summary,
        "locations": [
            {name: float(values[n]) for name, values in records.items()} for n in range(locations)
        ],
    }
    text = _json_text(document)
    if folder is not None:
        from wlplan import plots
        from wlplan.io import write_bytes_atomic, write_text_atomic

        png = plots.png_bytes(plots.diggability_figure(pile, found))
        with _staged(folder) as staging:
            write_bytes_atomic(staging / "diggability.png", png)
            write_text_atomic(staging / "diggability.json", text + "\n")
    if as_json:
        click.echo(text)
        return
    table = _table(f"{locations} locations around {source['file']}, {world_name} world")
    for column in ("", "least", "median", "most", "most at x [m]", "y [m]", "heading [°]"):
        table.add_column(column, justify="left" if not column else "right")
    for q, (title, unit, digits) in _QUANTITIES.items():
        best = int(records[q].argmax())
        table.add_row(
            f"{title} [{unit}]",
            *(f"{value:.{digits}f}" for value in summary[q].values()),
            f"{records['x'][best]:.2f}",
            f"{records['y'][best]:.2f}",
            f"{math.degrees(records['heading'][best]):.0f}",
        )
    _print_table(table)
    print(f"map {mapping.text()}")
    if folder is not None:
        print(f"written: {folder / 'diggability.png'}, and diggability.json beside it")


# --- gradcheck

# Most loads whose gradient is checked: every component costs two rollouts, and in the simulator,
# with its fixed number of steps, a rollout takes ten times as long.
_MOST_CHECKED, _MOST_CHECKED_SIMULATOR = 50, 10
_CHECK_FORMAT = "wlplan.gradcheck/1"
_VERDICTS = {"ok": ("ok", None), "kink": ("kink", "yellow"), "wrong": ("WRONG", "bold red")}


@wlplan.command()
@_pile_argument
@_options(
    click.option(
        "--loads",
        type=click.IntRange(1, _MOST_CHECKED),
        default=5,
        show_default=True,
        help=f"Number of bucket loads; at most {_MOST_CHECKED_SIMULATOR} in the simulator.",
    ),
    _world_option,
    click.option(
        "--objective",
        type=click.Choice(OBJECTIVES),
        default="efficiency",
        show_default=True,
        help="What the plan costs.",
    ),
    click.option(
        "--step",
        type=click.FloatRange(1e-9, 1e-3),
        default=1e-6,
        show_default=True,
        help="Step of the differences, in m, rad or the unit of the action parameter.",
    ),
    click.option(
        "--tolerance",
        type=click.FloatRange(1e-9, 1.0),
        default=None,
        help="Relative error above which a component counts as wrong. Default: 1e-4; in the "
        "simulator, where the derivative of the earthmoving force is approximate, 3e-3.",
    ),
    _model_option,
    _out_option,
)
def gradcheck(
    pile_file: str,
    loads: int,
    world_name: str,
    objective: str,
    step: float,
    tolerance: float | None,
    model: str | None,
    out: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Compare the gradient of a plan's cost with central differences, in float64.

    The plan is random, along the toe of PILE, its digs so close that each feels those before. A
    component where the cost has a kink is named as such. Ends with exit code 1 if a component is
    wrong. With --out: gradcheck.json.
    """
    _check_pile_name(pile_file)
    _check_model(model, world_name)
    in_simulator = world_name == "simulator"
    if in_simulator and loads > _MOST_CHECKED_SIMULATOR:
        raise InputError(
            f"--loads {loads} takes too long in the simulator: ask for at most "
            f"{_MOST_CHECKED_SIMULATOR}, or check another world."
        )
    folder = None if out is None else _checked_folder(out)

    from wlplan.gradcheck import SIMULATOR_TOLERANCE, TOLERANCE, check_gradient, random_plan
    from wlplan.io import plan_to_dict
    from wlplan.objective import objective_named
    from wlplan.planner.job import Job

    if tolerance is None:
        tolerance = SIMULATOR_TOLERANCE if in_simulator else TOLERANCE
    pile, source = _read_pile(pile_file)
    world, receiver = _load_world(world_name, model), _receiver(pile, None)
    checked_plan = random_plan(pile, loads, seed=seed)
    with _Progress() as progress, _Stopwatch() as checking:
        check = check_gradient(
            Job(world, pile, receiver, objective_named(objective)),
            checked_plan,
            step=step,
            tolerance=tolerance,
            progress=lambda done, total: progress("components", done, total, None),
        )

    document = {
        "format": _CHECK_FORMAT,
        "pile": source,
        "world": world_name,
        **({} if model is None else {"model": model}),
        "objective": objective,
        "seed": seed,
        "receiver": _receiver_fields(receiver),
        "loads": plan_to_dict(checked_plan)["loads"],
        **check.as_dict(),
    }
    text = _json_text(document)
    if folder is not None:
        from wlplan.io import write_text_atomic

        with _staged(folder) as staging:
            write_text_atomic(staging / "gradcheck.json", text + "\n")
    if as_json:
        click.echo(text)
    else:
        _print_check(check, f"{loads} loads from {source['file']}, {world_name} world")
        print(f"gradient and differences {checking.text()}")
        if folder is not None:
            print(f"written: {folder / 'gradcheck.json'}")
    if check.with_verdict("wrong"):
        raise click.exceptions.Exit(1)


def _print_check(check: GradientCheck, title: str) -> None:
    """The components of a gradient as a table on stdout, with what is worth knowing of them."""
    table = _table(title)
    for column in ("load", "component", "reverse", "central", "rel. error", "verdict"):
        table.add_column(column, justify="left" if column == "component" else "right")
    for c, after in zip(check.components, (*check.components[1:], None), strict=True):
        table.add_row(
            str(c.load),
            c.component,
            f"{c.reverse:.6g}",
            f"{c.central:.6g}",
            f"{c.relative_error:.1e}",
            _VERDICTS[c.verdict][0],
            style=_VERDICTS[c.verdict][1],
            end_section=after is None or after.load != c.load,
        )
    _print_table(table)
    kinks, wrong = check.with_verdict("kink"), check.with_verdict("wrong")
    count = len(check.components)
    print(
        f"{count} components: {count - len(kinks) - len(wrong)} ok, {len(kinks)} at kinks "
        f"({100.0 * check.kink_fraction:.1f} %), {len(wrong)} wrong"
    )
    for word, named in (("at kinks", kinks), ("WRONG", wrong)):
        if named:
            print(f"{word}: {', '.join(f'load {c.load} {c.component}' for c in named)}")
    print(
        f"relative error, kinks left out: largest {check.largest_error:.1e}, "
        f"median {check.median_error:.1e}; tolerance {check.tolerance:g}"
    )


# --- data and models


@wlplan.command()
@_options(
    click.option(
        "--cycles",
        type=click.IntRange(1, _MOST_CYCLES),
        default=10_800,
        show_default=True,
        help="Number of loading cycles.",
    ),
    click.option("--out", metavar="DATA.zarr", required=True, help="Data set to write."),
)
def collect(cycles: int, out: str, seed: int, as_json: bool) -> None:
    """Play random loading cycles in the simulator and store them as training data.

    Interrupted, the same command goes on where it stopped.
    """
    _check_not_a_file(out)

    from wlplan.dataset import collect as collect_cycles

    with _Progress() as progress, _Stopwatch() as playing:
        collect_cycles(
            out,
            cycles=cycles,
            seed=seed,
            progress=lambda done, total: progress("cycles", done, total, None),
        )
    if as_json:
        click.echo(_json_text({"out": out, "cycles": cycles, "seed": seed}))
        return
    print(f"{cycles} cycles in {out}; {playing.text()}")


@wlplan.command()
@click.argument("kind", metavar="MODEL", type=click.Choice(("psi-low",)))
@_options(
    click.option("--data", metavar="DATA.zarr", required=True, help="Data set to train on."),
    click.option("--out", metavar="DIR", required=True, help="Folder of the model."),
    click.option(
        "--epochs",
        type=click.IntRange(1, 100_000),
        default=300,
        show_default=True,
        help="Passes over the data.",
    ),
)
def train(kind: str, data: str, out: str, epochs: int, seed: int, as_json: bool) -> None:
    """Train MODEL (psi-low) on a data set and report its errors on cycles that it has not seen."""
    _check_is_folder(data, "data set", "wlplan collect")
    _checked_folder(out)

    from wlplan.dataset import open_dataset
    from wlplan.training import train_psi_low

    dataset = open_dataset(data)
    with _Progress() as progress, _Stopwatch() as training:
        _, report = train_psi_low(
            dataset,
            out=out,
            seed=seed,
            epochs=epochs,
            progress=lambda done, total: progress("epochs", done, total, None),
        )
    if as_json:
        click.echo(_json_text({"model": kind, "out": out, "held_out": report.as_dict()}))
        return
    _print_errors(f"{kind}, held-out part of {data}", report.as_dict())
    print(f"training {training.text()}")
    print(f"written: {out}")


@wlplan.command()
@_options(
    click.option("--data", metavar="DATA.zarr", required=True, help="Data set to compare with."),
    click.option(
        "--model", metavar="DIR", default=None, help="Model; default: the one that ships."
    ),
)
def evaluate(data: str, model: str | None, seed: int, as_json: bool) -> None:
    """Report the errors of a model on simulated cycles.

    Of the data set that it was trained on, only the part that was held out counts. The split
    belongs to the model, so --seed changes nothing.
    """
    _check_is_folder(data, "data set", "wlplan collect")
    _check_model(model, "low")

    from wlplan.dataset import open_dataset
    from wlplan.training import evaluate_psi_low, held_out, load_model, read_description
    from wlplan.worlds import pretrained_path

    folder = pretrained_path("psi_low") if model is None else Path(model)
    description, predictor = read_description(folder), load_model(folder)
    dataset = open_dataset(data)
    part = held_out(dataset, description)
    report = evaluate_psi_low(predictor, part).as_dict()
    if as_json:
        click.echo(_json_text({"model": "psi-low", "data": data, "errors": report}))
        return
    which = "held-out part" if len(part) < len(dataset) else "all cycles"
    _print_errors(f"psi-low, {which} of {data}", report)


def _print_errors(title: str, report: Mapping[str, Any]) -> None:
    table = _table(title)
    for column in ("", "cycles", "mass", "time", "work"):
        table.add_column(column, justify="left" if not column else "right")
    kinds = (
        ("mean_relative", "mean relative error", lambda v, unit: f"{100.0 * v:.2f} %"),
        ("mean_absolute", "mean absolute error", lambda v, unit: f"{v:.3g} {unit}"),
        ("total_relative", "error of the sum", lambda v, unit: f"{100.0 * v:+.2f} %"),
    )
    loaded = f"loads over {report['loaded_mass']:g} t"
    for name, which in (("loaded", loaded), ("every", "all valid cycles")):
        part = report[name]
        for key, label, write in kinds:
            cells = (write(part[key][q], unit) for q, (_, unit, _) in _QUANTITIES.items())
            table.add_row(f"{label}, {which}", str(part["cycles"]), *cells)
    _print_table(table)


# --- bench

# Names that wlplan.bench defines, repeated here to keep help fast; a test compares them.
BENCH_ITEMS = (
    *("avalanche", "avalanche-gradient", "avalanche-batch", "loading", "rollout"),
    *("rollout-gradient", "psi-low", "psi-low-batch", "gpu-rollouts", "cycles", "plan"),
    *("first-load", "settle", "xla", "numba", "numpy", "aeolis"),
)
# How the figures of an item are written.
_BENCH_FIGURES: dict[str, Callable[[float], str]] = {
    "steepest_slope_degrees": lambda v: f"at most {v:.2f}°",
    "relative_volume_change": lambda v: f"volume to {v:.0e}",
    "ratio_to_forward": lambda v: f"{v:.1f} × forward",
    "ratio_to_one": lambda v: f"{v:.0f} × one",
    "times_settle": lambda v: f"{v:.1f} × settle",
    "sweeps": lambda v: f"{v:.0f} sweeps",
    "seconds_each": lambda v: f"{_duration(v)} each",
    "temporary_mebibytes": lambda v: f"{v:.0f} MiB",
    "cycles_per_second": lambda v: f"{v:.0f} a second",
    "loads_per_second": lambda v: f"{v:.0f} loads a second",
    "seconds_on_another_pile": lambda v: f"{_duration(v)} on another pile",
}


@wlplan.command()
@_options(
    click.option(
        "--only",
        "names",
        type=click.Choice(BENCH_ITEMS),
        metavar="NAME",
        multiple=True,
        help=f"Item to measure, may be given again: {', '.join(BENCH_ITEMS)}. Default: all.",
    ),
    click.option("--quick", is_flag=True, help="Fewer cases and repeats, and no whole plans."),
    _out_option,
)
def bench(names: tuple[str, ...], quick: bool, out: str | None, seed: int, as_json: bool) -> None:
    """Measure on this machine what the package is measured by, beside what there is to beat.

    Compiling and running are timed apart. With --out: bench.json.
    """
    folder = None if out is None else _checked_folder(out)

    from wlplan.bench import run_bench

    with _Progress() as progress:
        document = run_bench(names, quick=quick, seed=seed, progress=progress)
    text = _json_text(document)
    if folder is not None:
        from wlplan.io import write_text_atomic

        with _staged(folder) as staging:
            write_text_atomic(staging / "bench.json", text + "\n")
    if as_json:
        click.echo(text)
        return
    _print_bench(document)
    if folder is not None:
        print(f"written: {folder / 'bench.json'}")


def _print_bench(document: Mapping[str, Any]) -> None:
    """What was measured as a table on stdout, a group after the other."""
    device, versions = document["device"], document["versions"]
    table = _table(
        f"{device['processor']}, {device['cores']} cores; JAX {versions['jax']} on {device['kind']}"
    )
    table.add_column("item", min_width=28)
    for column in ("compile", "run,\nmedian", "10th to 90th\npercentile", "runs"):
        table.add_column(column, justify="right")
    table.add_column("found", min_width=20)
    for column in ("to reach", "met", "others"):
        table.add_column(column)
    records = document["items"]
    for record, after in zip(records, (*records[1:], None), strict=True):
        run = record["run"]
        cells = ["", "", "", ""]
        if run is not None:
            compiling = "" if record["compile"] is None else _duration(record["compile"])
            spread = f"{_duration(run['p10'])} to {_duration(run['p90'])}"
            cells = [compiling, _duration(run["median"]), spread, str(run["repeats"])]
        found = [_BENCH_FIGURES[name](value) for name, value in record["figures"].items()]
        table.add_row(
            f"{record['name']}\n{record['title']}",
            *cells,
            record["note"] or ", ".join(found),
            record["target"] or "",
            {True: "yes", False: "no", None: ""}[record["met"]],
            record["reference"] or "",
            end_section=after is None or after["group"] != record["group"],
        )
    _print_table(table)
    print("Targets are for two CPU cores. What others take was measured elsewhere or published.")


def _duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    unit, scale = ("s", 1.0) if seconds >= 1.0 else ("ms", 1e3) if seconds >= 1e-3 else ("µs", 1e6)
    value = seconds * scale
    return f"{value:.{0 if value >= 100.0 else 1 if value >= 10.0 else 2}f} {unit}"


# --- checks that need nothing heavy


def _check_pile_name(name: str) -> None:
    if name == BUNDLED:
        return
    if os.path.isdir(name):
        raise InputError(f"{name}: is a folder: name the pile file itself.")
    if not os.path.exists(name):
        raise InputError(f"{name}: no such pile file: check the name.")
    if Path(name).suffix.lower() not in _PILE_ENDINGS:
        raise InputError(
            f"{name}: unknown kind of pile file: use one of {', '.join(_PILE_ENDINGS)}."
        )


def _check_model(name: str | None, world: str) -> None:
    if name is None:
        return
    if world != "low":
        raise InputError(f"--model does not go with --world {world}: leave one of them out.")
    _check_is_folder(name, "model", "wlplan train")


def _check_not_a_file(name: str) -> None:
    if not name.strip():
        raise InputError("the name of the folder to write to is empty: give one.")
    if os.path.lexists(name) and not os.path.isdir(name):
        raise InputError(f"{name}: is a file: name a folder to write to.")


def _check_is_folder(name: str, what: str, maker: str) -> None:
    if not os.path.lexists(name):
        raise InputError(f"{name}: no such {what}: check the name, or make it with `{maker}`.")
    if not os.path.isdir(name):
        raise InputError(f"{name}: is a file: a {what} is a folder, made with `{maker}`.")


def _checked_folder(name: str) -> Path:
    """A folder to write to, found out to be possible before anything long is begun."""
    _check_not_a_file(name)
    folder = Path(name)
    place = folder.absolute()
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise InputError(f"{name}: {place} is a file: name a folder to write to.")
    probe = place / f".wlplan-{secrets.token_hex(6)}.tmp"
    try:
        probe.mkdir()
        probe.rmdir()
    except OSError as error:
        raise InputError(
            f"{name}: cannot be written ({error.strerror or error}): choose another folder."
        ) from error
    return folder


@contextlib.contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """A hidden folder to write to, whose files move into place once all are there.

    Other files in the folder stay. If writing fails or is interrupted, the folder is as it was.
    """
    exists = folder.is_dir()
    if not exists:
        folder.parent.mkdir(parents=True, exist_ok=True)
    # Inside or beside the folder, so that moving is renaming on one file system.
    name = f".{folder.name or 'wlplan'}.{secrets.token_hex(6)}.tmp"
    staging = folder / name if exists else folder.with_name(name)
    staging.mkdir()
    try:
        yield staging
        files = sorted(staging.iterdir())
        for file in files:
            if (folder / file.name).is_dir():
                raise InputError(
                    f"{folder / file.name}: is a folder where a file goes: choose another --out."
                )
        if exists:
            for file in files:
                os.replace(file, folder / file.name)
        else:
            os.rename(staging, folder)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


# --- what the commands share

_QUANTITIES = {"mass": ("mass", "t", 2), "time": ("time", "s", 1), "work": ("work", "kJ", 0)}
_RECEIVER_FIELDS = ("x", "y", "heading")
# What a plan says about where it comes from; playing it again keeps that.
_ORIGIN_FIELDS = ("world", "model", "planner", "seed")


def _read_pile(name: str) -> tuple[Pile, dict[str, Any]]:
    """A pile, and what plan.json says about it."""
    from wlplan.io import bundled_pile_path, read_pile
    from wlplan.pile import toe_contour

    path = bundled_pile_path() if name == BUNDLED else Path(name)
    pile = read_pile(path)
    toe_contour(pile)  # a pile that cannot be dug is refused here
    fields = {
        "file": f"{BUNDLED} ({path.name})" if name == BUNDLED else name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "cells": list(pile.height.shape),
        "cell_size": pile.cell_size,
        "origin": [float(value) for value in pile.origin],
    }
    return pile, fields


def _load_world(name: str, model: str | None) -> World:
    from wlplan.worlds import load_world

    return load_world(name) if model is None else load_world(name, model=model)


def _receiver(pile: Pile, truck: tuple[float, ...] | None) -> Receiver:
    """Where the loader dumps.

    Args:
        pile: The pile.
        truck: x [m], y [m] and, if given, heading [degree]; None for the default place.

    Raises:
        InputError: If the place lies on the pile or far away from it.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from wlplan.diggability import edge_poses
    from wlplan.heightmap import sample
    from wlplan.pile import ground_height, toe_contour
    from wlplan.transport import Receiver, default_receiver, v_turn_length

    if truck is None:
        return default_receiver(pile)
    x, y = truck[:2]
    size = pile.cell_size * np.array(pile.height.shape)
    low = np.asarray(pile.origin, float)
    away = math.hypot(*(np.array([x, y]) - low - 0.5 * size))
    if away > _FARTHEST_TRUCK:
        raise InputError(
            f"--truck {x:g},{y:g} lies {away:.0f} m from the middle of the map, which spans x "
            f"{low[0]:.1f} to {low[0] + size[0]:.1f} and y {low[1]:.1f} to {low[1] + size[1]:.1f} "
            f"m: give it in that frame (whole kilometres of survey coordinates are taken off)."
        )
    dtype = pile.height.dtype
    above = pile.height - ground_height(pile)
    place = [jnp.asarray(value, dtype) for value in (x, y)]
    inside = bool(np.all((np.array([x, y]) >= low) & (np.array([x, y]) <= low + size)))
    if inside and float(sample(above, pile, *place)) > 0.5:
        raise InputError(f"--truck {x:g},{y:g} lies on the pile: give a place beside it.")
    if len(truck) == 3:
        heading = math.radians(truck[2])
        heading = math.remainder(heading, 2.0 * math.pi)
    else:
        poses = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, dtype), edge_poses(toe_contour(pile), 24)
        )
        headings = np.radians(np.arange(-180.0, 180.0, 5.0))
        lengths = jax.jit(
            jax.vmap(
                lambda h: jax.vmap(
                    lambda pose: v_turn_length(pose, Receiver(*place, h))  # type: ignore[call-arg]
                )(poses).mean()
            )
        )(jnp.asarray(headings, dtype))
        heading = float(headings[int(np.argmin(lengths))])
    return Receiver(*place, jnp.asarray(heading, dtype))  # type: ignore[call-arg]


def _receiver_fields(receiver: Receiver) -> dict[str, float]:
    return {name: float(getattr(receiver, name)) for name in _RECEIVER_FIELDS}


def _ready(result: Any) -> Any:
    """The result, once the device has computed it."""
    import jax

    return jax.block_until_ready(result)


def _sum(values: Any) -> float:
    import numpy as np

    return float(np.asarray(values, np.float64).sum())


def _totals(performance: Performance, cost: Any) -> dict[str, float]:
    return {**{q: _sum(getattr(performance, q)) for q in _QUANTITIES}, "cost": float(cost)}


def _ledger(pile: Pile, simulated: PlanResult, simulator: Any) -> dict[str, float]:
    """What left the pile [m^3], and what was loaded [tonne], at a density [tonne/m^3]."""
    import numpy as np

    from wlplan.pile import ground_height
    from wlplan.units import KG_PER_TONNE

    def volume(after: Pile) -> float:
        # In float64: a bucket is a small difference of large volumes.
        above = np.asarray(after.height, np.float64) - np.asarray(ground_height(after), np.float64)
        return float(above.sum()) * after.cell_size**2

    return {
        "volume_before": volume(pile),
        "volume_after": volume(simulated.rollout.pile),
        "mass_removed": _sum(simulated.rollout.performance.mass),
        "density": simulator.soil.density / KG_PER_TONNE,
    }


def _remark_on_ledger(ledger: Mapping[str, float]) -> None:
    from wlplan.report import LEDGER_TOLERANCE, ledger_error

    error = ledger_error(ledger)
    if error > LEDGER_TOLERANCE:
        _remark(f"the ledger of the simulated pile is off by {100.0 * error:.2g} %")


def _json_text(document: Mapping[str, Any]) -> str:
    try:
        return json.dumps(document, indent=2, allow_nan=False)
    except ValueError as error:
        raise InputError(
            "the result holds numbers that are not finite: check the pile for spikes, or use "
            "another world."
        ) from error


def _remark(text: str) -> None:
    print(f"note: {text}", file=sys.stderr)


def _print_plan(document: Mapping[str, Any]) -> None:
    """The loads of a plan as a table on stdout, with sums, cost and ledger."""
    total, ledger = document["total"], document["ledger"]
    predicted = total.get("predicted", {})
    table = _table(f"{len(document['loads'])} loads from {document['pile']['file']}")
    table.add_column("load")
    # Short titles: all of it fits a terminal of 80 columns.
    for title in ("x\n[m]", "y\n[m]", "head.\n[°]"):
        table.add_column(title, justify="right")
    for title, unit, _ in _QUANTITIES.values():
        if predicted:
            table.add_column(f"{title}\npred.\n[{unit}]", justify="right", style="cyan")
        table.add_column(f"{title}\nsim.\n[{unit}]", justify="right", style="yellow")
    table.add_column("trans-\nport\n[s]", justify="right")

    def cells(record: Mapping[str, Any], transport: Mapping[str, float]) -> list[str]:
        row = []
        for q, (_, _, digits) in _QUANTITIES.items():
            for part in ("predicted", "simulated") if predicted else ("simulated",):
                row.append(f"{record[part][q]:.{digits}f}")
        return [*row, f"{transport['time']:.1f}"]

    for n, load in enumerate(document["loads"], start=1):
        heading = round(math.degrees(load["heading"]))
        place = (f"{load['x']:.2f}", f"{load['y']:.2f}", f"{heading}")
        last = n == len(document["loads"])
        table.add_row(str(n), *place, *cells(load, load["transport"]), end_section=last)
    table.add_row("sum", "", "", "", *cells(total, total["transport"]), style="bold")
    _print_table(table)

    for q, (title, unit, _) in _QUANTITIES.items():
        simulated = total["simulated"][q]
        if predicted and simulated:
            off = 100.0 * (predicted[q] / simulated - 1.0)
            print(
                f"{title}: predicted {predicted[q]:.1f} {unit}, simulated {simulated:.1f} {unit}, "
                f"difference {off:+.1f} %"
            )
    costs = [f"{part} {total[part]['cost']:.3f}" for part in total if "cost" in total[part]]
    print(f"cost for {document['objective']}: {', '.join(costs)}")
    lost = ledger["volume_before"] - ledger["volume_after"]
    print(
        f"ledger: {ledger['volume_before']:.2f} m³ before, {ledger['volume_after']:.2f} m³ after; "
        f"{lost:.3f} m³ at {ledger['density']:.3f} t/m³ for {ledger['mass_removed']:.3f} t loaded"
    )


def _table(title: str) -> Any:
    from rich import box
    from rich.table import Table

    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )


def _print_table(table: Any) -> None:
    from rich.console import Console

    # A file or a pipe has no width of its own: take what the table needs.
    width = None if sys.stdout.isatty() else 140
    # Units stand in square brackets, which would count as markup.
    Console(width=width, highlight=False, markup=False).print(table)


# --- time


class _Progress:
    """`progress(stage, done, total, cost)` on stderr: bars on a terminal, now and then a line."""

    def __init__(self) -> None:
        self._bars: Any = None
        self._tasks: dict[str, TaskID] = {}
        self._told: dict[str, float] = {}

    def __enter__(self) -> _Progress:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeElapsedColumn,
            )

            self._bars = Progress(
                TextColumn("{task.description:<12}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[cost]}"),
                console=Console(stderr=True),
                transient=True,
            )
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, stage: str, done: int, total: int, cost: float | None) -> None:
        text = "" if cost is None else f"cost {cost:.3f}"
        if self._bars is not None:
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(stage, total=total, cost=text)
            self._bars.update(self._tasks[stage], completed=done, total=total, cost=text)
            return
        now = time.monotonic()
        if stage in self._told and done < total and now - self._told[stage] < _PROGRESS_PAUSE:
            return
        self._told[stage] = now
        print(f"{stage} {done}/{total} {text}".rstrip(), file=sys.stderr, flush=True)


# Begin and end of everything that JAX has traced and compiled so far [s], of `time.perf_counter`.
_compilations: list[tuple[float, float]] = []


def _on_duration(event: str, duration_secs: float, **_: str | int) -> None:
    if event.startswith("/jax/core/compile/"):
        now = time.perf_counter()
        _compilations.append((now - duration_secs, now))


class _Stopwatch:
    """Wall-clock time of a block, tracing and compiling apart from the rest."""

    _listens = False

    def __enter__(self) -> _Stopwatch:
        import jax

        if not _Stopwatch._listens:
            jax.monitoring.register_event_duration_secs_listener(_on_duration)
            _Stopwatch._listens = True
        self._first, self._begin = len(_compilations), time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.perf_counter() - self._begin
        # Stages nest: one second of compiling inside of tracing counts once.
        self.compiling, reached = 0.0, self._begin
        for begin, end in sorted(_compilations[self._first :]):
            self.compiling += max(end - max(begin, reached), 0.0)
            reached = max(reached, end)

    def text(self) -> str:
        """Both times, for people."""
        running = max(self.seconds - self.compiling, 0.0)
        return f"{self.seconds:.1f} s ({self.compiling:.1f} s compiling, {running:.1f} s running)"
