"""What the options of the commands have in common, including their types and names."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, cast

import click

from wlplan.cli.values import (
    FiniteRange,
    LevelOrFile,
    NameOrReference,
    Numbers,
    PlaceOrAuto,
    WholeNumbers,
)
from wlplan.cli.verbosity import quiet_or_verbose
from wlplan.planning import planners
from wlplan.planning.objectives import OBJECTIVES
from wlplan.report.exports import KINDS as EXPORTS
from wlplan.site.machine import MACHINES
from wlplan.site.soil import SOILS
from wlplan.training.settings import KINDS, Setting, setting_of
from wlplan.worlds.names import ENGINES, FOR_PLANNING, USUAL_ENGINE

# Names that the modules behind define, repeated here to keep help fast; a test compares them.
PROTOCOLS = ("paper", "corridor", "slow", "past-toe")
UPS = ("x", "y", "z", "-x", "-y", "-z")

BUNDLED = "bundled"
"""What stands for the pile that ships with the package where a file is asked for."""

# `click.ParamType` takes type arguments from click 8.4 on only.


def with_options(*options: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A decorator: several click options at once, then those that every command has."""
    common = (
        click.option(
            "--seed",
            type=click.IntRange(0, 2**31 - 1),
            default=0,
            show_default=True,
            help="Seed of all random choices.",
        ),
        click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout."),
    )

    def decorate(command: Any) -> Any:
        command = quiet_or_verbose(command)
        for option in reversed((*options, *common)):
            command = option(command)
        return command

    return decorate


def training_options() -> tuple[Callable[[Any], Any], ...]:
    """An option for each setting of any training, without the seed; what is not given is None.

    The help names the kinds of model that take it, and the default of each.
    """
    fields_of: dict[str, dict[str, dataclasses.Field[Any]]] = {}
    for kind, settings in KINDS.items():
        for field in dataclasses.fields(settings):
            fields_of.setdefault(field.name, {})[kind.replace("_", "-")] = field
    del fields_of["seed"]
    return tuple(_training_option(name, fields) for name, fields in fields_of.items())


def _training_option(
    name: str, fields: Mapping[str, dataclasses.Field[Any]]
) -> Callable[[Any], Any]:
    """The option of a setting, from its field in the settings of each kind that takes it."""
    first = next(iter(fields.values()))
    setting = setting_of(first)
    kinds_of: dict[str, list[str]] = {}
    for kind, field in fields.items():
        kinds_of.setdefault(_as_text(field.default), []).append(kind)
    if len(kinds_of) == 1:
        default = next(iter(kinds_of))
    else:
        default = "; ".join(f"{', '.join(kinds)} {text}" for text, kinds in kinds_of.items())
    takers = "" if len(fields) == len(KINDS) else f"{', '.join(fields)}: "
    return click.option(
        f"--{name.replace('_', '-')}",
        type=_option_type(setting, first.default),
        default=None,
        help=f"{takers}{setting.help} Default: {default}.",
    )


def _option_type(setting: Setting, default: Any) -> Any:
    """The click type of a setting, by the type of its default."""
    if setting.choices:
        return click.Choice(setting.choices)
    if isinstance(default, tuple):
        assert setting.least is not None
        assert setting.most is not None
        return WholeNumbers(int(setting.least), int(setting.most), setting.entries)
    low = setting.least if setting.above is None else setting.above
    high = setting.most if setting.below is None else setting.below
    opens = {"min_open": setting.above is not None, "max_open": setting.below is not None}
    if isinstance(default, float):
        return FiniteRange(low, high, **opens)
    # The bounds of a whole number are whole numbers.
    return click.IntRange(cast("int | None", low), cast("int | None", high), **opens)


def _as_text(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def loads_option(*, default: int, most: int, remark: str = "") -> Callable[[Any], Any]:
    """The option that says how many loads there are.

    Args:
        default: Loads if the option is not given.
        most: Most loads that may be asked for.
        remark: Added to the help.
    """
    return click.option(
        "--loads",
        type=click.IntRange(1, most),
        default=default,
        show_default=True,
        help=f"Number of bucket loads{remark}.",
    )


def objective_option(purpose: str, *, by_amount: bool = False) -> Callable[[Any], Any]:
    """The option that says what a plan costs.

    Args:
        purpose: Its help.
        by_amount: Whether the default hangs on how much is to be loaded.
    """
    first = next(iter(OBJECTIVES))
    otherwise = f" Default: {first} for --loads, delivery for other amounts." if by_amount else ""
    return click.option(
        "--objective",
        type=NameOrReference("objective", OBJECTIVES),
        default=None if by_amount else first,
        show_default=not by_amount,
        help=f"{purpose}: {', '.join(OBJECTIVES)}, or package.module:Name of an objective of your "
        f"own.{otherwise}",
    )


def site_options(default: str = "") -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """The options that say what is dug and what digs.

    Args:
        default: What is taken without them, in words; by default gravel and the WA320.
    """
    soil, machine = (default, default) if default else ("gravel", "wa320")
    return (
        click.option(
            "--soil",
            metavar="NAME|FILE.toml[@DEG]",
            default=None,
            help=f"Soil: {', '.join(SOILS)}, or a TOML file of parameters; @DEG: what it rests at. "
            f"Default: {soil}.",
        ),
        click.option(
            "--machine",
            metavar="NAME|FILE.toml",
            default=None,
            help=f"Machine: {', '.join(MACHINES)}, or a TOML file of parameters. "
            f"Default: {machine}.",
        ),
    )


@dataclasses.dataclass(frozen=True)
class PileFile:
    """The pile file of a command.

    Attributes:
        name: Path of the file, or `BUNDLED`.
        reading: Arguments of `wlplan.io.read_scan` that were given.
    """

    name: str
    reading: dict[str, Any]


READING = {
    "band": click.option(
        "--band",
        type=click.IntRange(1, 65_535),
        default=None,
        help="Band of a GeoTIFF that holds the heights. Default: the only one that can.",
    ),
    "crop": click.option(
        "--crop",
        type=Numbers("X0,Y0,X1,Y1", 4),
        default=None,
        help="Read only this rectangle, in the coordinates of the file.",
    ),
    "layer": click.option(
        "--layer",
        metavar="NAME",
        default=None,
        help="Layer of a grid_map that holds the heights. Default: elevation, or the only one.",
    ),
    "up": click.option(
        "--up",
        type=click.Choice(UPS),
        default=None,
        help="Axis of a point cloud or mesh that is up. Default: z, or y of an .obj that looks so.",
    ),
    "ground": click.option(
        "--ground",
        type=LevelOrFile(),
        default=None,
        help="Floor under the pile: its level [m], in the heights of the scan, or a scan of it in "
        "the same coordinates. Default: estimated from the ground around the pile.",
    ),
    "pile": click.option(
        "--pile",
        type=Numbers("X,Y", 2),
        default=None,
        help="Which of several piles is meant: a place on it [m], in the coordinates of the scan. "
        "Default: the largest.",
    ),
    "keep_out": click.option(
        "--keep-out",
        metavar="FILE.geojson",
        default=None,
        help="Polygons in the coordinates of the scan: obstacles, or by their property kind no-go "
        "or no-dig.",
    ),
    "truck_area": click.option(
        "--truck-area",
        metavar="FILE.geojson",
        default=None,
        help="Polygons that trucks may stand in, in the coordinates of the scan: a whole truck "
        "inside one of them. Default: anywhere.",
    ),
    "include": click.option(
        "--include",
        type=Numbers("X,Y", 2),
        default=None,
        help="A place on a structure that is soil after all [m], in the coordinates of the scan.",
    ),
}
"""Options of how a pile is read, by the argument of `wlplan.io.read_scan` that each gives."""


def pile_argument(*, required: bool = False) -> Callable[[Any], Any]:
    """A decorator: the argument PILE and the options of how it is read, as one `PileFile`.

    Args:
        required: Whether the pile has to be named; otherwise it is by default the bundled one.
    """

    def decorate(command: Any) -> Any:
        @functools.wraps(command)
        def gathered(*, pile_file: str, **others: Any) -> Any:
            given = {name: others.pop(name) for name in READING}
            reading = {name: value for name, value in given.items() if value is not None}
            return command(pile_file=PileFile(pile_file, reading), **others)

        found: Any = gathered
        for option in reversed(READING.values()):
            found = option(found)
        if required:
            return click.argument("pile_file", metavar="PILE")(found)
        return click.argument("pile_file", metavar="[PILE]", default=BUNDLED)(found)

    return decorate


world_option = click.option(
    "--world",
    "world_name",
    type=NameOrReference("world", FOR_PLANNING),
    default="hybrid",
    show_default=True,
    help=f"World that predicts the loads: {', '.join(FOR_PLANNING)}, or package.module:Name of one "
    f"of your own.",
)
planner_option = click.option(
    "--planner",
    type=NameOrReference("planner", planners.NAMES),
    default="iterated_greedy",
    show_default=True,
    help=f"Planner: {', '.join(planners.NAMES)}, or package.module:Name of one of your own.",
)
engine_option = click.option(
    "--engine",
    type=click.Choice(list(ENGINES)),
    default=USUAL_ENGINE,
    show_default=True,
    help="Engine that plays the plan: the simulator; the same with the soil that lies in the "
    "approach lane; or discrete elements, which take minutes a load and need wlplan[dem].",
)
scatter_option = click.option(
    "--scatter",
    metavar="SEED",
    type=click.IntRange(0, 2**31 - 1),
    default=None,
    help="Play with the scatter of real grains, drawn from this seed: some percent in mass, one in "
    "time and work. Several seeds show what a plan's totals vary by.",
)
model_options = (
    click.option(
        "--model",
        metavar="DIR",
        default=None,
        help="Folder of a psi-low or psi-high from `wlplan train`, for a learned world, instead of "
        "the one that ships.",
    ),
    click.option(
        "--pile-state",
        metavar="DIR",
        default=None,
        help="Folder of a phi or phi-vae from `wlplan train`, for a learned world, instead of the "
        "phi that ships (high) or of cutting out a strip (low, hybrid).",
    ),
)


_TRUCK_HELP = (
    "Where the loader stands when it dumps [m], in the coordinates of the scan, and its heading "
    "there. Default heading: the one with the shortest ways. Default place: beside the pile, where "
    "the ways are short"
)
truck_option = click.option(
    "--truck", type=Numbers("X,Y[,HEADING_DEG]", 2), default=None, help=f"{_TRUCK_HELP}."
)
placed_truck_option = click.option(
    "--truck",
    type=PlaceOrAuto(),
    default=None,
    help=f"{_TRUCK_HELP}; auto: where the planner finds loads cheapest; each: likewise for each "
    f"of --trucks anew.",
)
also_option = click.option(
    "--also",
    multiple=True,
    type=click.Choice(EXPORTS),
    help="Write the plan as GeoJSON or DXF, the pile after it as GeoTIFF, or a film of it as GIF, "
    "too; may be given again.",
)
out_option = click.option(
    "--out", metavar="DIR", default=None, help="Folder to write to. It is made if it is missing."
)
