"""`wlplan plan` and `wlplan simulate`: make a plan and play it, or play one that was written."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wlplan.cli.amount import amount_options
from wlplan.cli.inputs import (
    check_models,
    check_pile_name,
    model_fields,
    objective_named,
    pile_named,
    planner_named,
    read_as_recorded,
    site_named,
    site_recorded,
    world_named,
)
from wlplan.cli.options import (
    PileFile,
    also_option,
    engine_option,
    model_options,
    objective_option,
    out_option,
    pile_argument,
    placed_truck_option,
    planner_option,
    scatter_option,
    site_options,
    truck_option,
    with_options,
    world_option,
)
from wlplan.cli.outputs import checked_folder, json_text, remark
from wlplan.cli.plan_table import print_plan, remark_on_ledger
from wlplan.cli.programs import cache_of_command
from wlplan.cli.progress import Progress, Stopwatch, ready
from wlplan.cli.said import say
from wlplan.constants import QUANTITIES
from wlplan.errors import InputError
from wlplan.planning.objectives import OBJECTIVES
from wlplan.report.exports import check as check_exports
from wlplan.report.exports import names as names_of_exports
from wlplan.worlds.names import USUAL_ENGINE

if TYPE_CHECKING:
    from wlplan.planning.amounts import Amount
    from wlplan.site.frame import Frame
    from wlplan.types import Performance

# Files that a plan is written as, apart from exports; a test compares them.
_FILES = ("plan.json", "plan.png", "totals.png", "report.html")
# Exit code after Ctrl-C, also if there was a plan to show.
_INTERRUPTED = 130
# What a plan says about where it comes from; kept when it is played again.
_ORIGIN_FIELDS = ("world", "model", "pile_state", "planner", "seed")


@click.command(
    short_help="Plan the next loads from a pile.",
    epilog="\b\nExample: wlplan plan scan.tif --loads 10 --truck 12,3,90 --out plan/",
)
@pile_argument()
@with_options(
    amount_options,
    world_option,
    planner_option,
    objective_option("What the plan minimises", by_amount=True),
    click.option(
        "--referee/--no-referee",
        default=True,
        show_default=True,
        help="Let the simulator pick among the planner's best plans.",
    ),
    placed_truck_option,
    *site_options(),
    *model_options,
    out_option,
    also_option,
)
def plan(
    pile_file: PileFile,
    amount: Callable[[], Amount],
    world_name: str,
    planner: str,
    objective: str | None,
    referee: bool,
    truck: tuple[float, ...] | str | None,
    soil: str | None,
    machine: str | None,
    model: str | None,
    pile_state: str | None,
    out: str | None,
    also: tuple[str, ...],
    seed: int,
    as_json: bool,
) -> None:
    """Plan the next loads from PILE and play the plan in the simulator.

    With --out: plan.json, plan.png, totals.png and report.html, which shows everything.

    Ctrl-C ends the search: the best plan so far is played, shown and written.
    """
    check_pile_name(pile_file.name)
    check_models(model, pile_state, world_name)
    site = site_named(soil, machine)
    folder = _folder_of(out, also)
    kept = cache_of_command()
    kind = f"plan, {world_name}, {planner}{', referee' if referee else ''}"
    with Progress(kept.seconds(kind)) as progress:
        progress.phase("starting")

        from wlplan.report.making import Asked, make_plan

        progress.phase(f"reading {pile_file.name}")
        named = pile_named(pile_file, site.machine)
        progress.phase("loading the models")
        world = world_named(world_name, site, model, pile_state)
        simulator = world_named("simulator", site)
        wanted = amount()
        objective = wanted.objective if objective is None else objective
        clocks: dict[str, Stopwatch] = {}

        def timed(part: str) -> Stopwatch:
            clocks[part] = Stopwatch()
            return clocks[part]

        made = make_plan(
            named,
            site,
            world,
            simulator,
            Asked(
                amount=wanted,
                truck=truck,
                planner=planner_named(planner),
                objective=objective_named(objective),
                names={
                    "world": world_name,
                    "planner": planner,
                    "objective": objective,
                    **model_fields(model, pile_state),
                },
                referee=referee,
                seed=seed,
            ),
            progress=progress,
            timed=timed,
            note=remark,
        )
        kept.remember(kind, clocks["planning"].compiling)
        document = made.document
        text = json_text(document)
        seconds = {part: clock.text() for part, clock in clocks.items()}

    def show() -> None:
        for note in document["notes"]:
            remark(note)
        remark_on_ledger(document["ledger"])
        for name, numbers in made.violated.items():
            remark(f"{name} is violated by load {', '.join(map(str, numbers))}")
        if as_json:
            click.echo(text)
            return
        print_plan(document)
        say("; ".join(f"{name} {text}" for name, text in seconds.items()))

    def write(staging: Path) -> list[str]:
        settings = {f"{name}, wall clock": text for name, text in seconds.items()}
        return made.write(staging, settings=settings, also=also)

    _show_and_write(folder, show, write, as_json=as_json)
    if made.planned.stopped == "interrupted":
        raise click.exceptions.Exit(_INTERRUPTED)


def _show_and_write(
    folder: Path | None,
    show: Callable[[], None],
    write: Callable[[Path], list[str]],
    *,
    as_json: bool,
) -> None:
    """Shows a plan and writes it to a folder, if there is one.

    On a terminal the plan is shown first, for pictures and page take seconds more. Into a pipe,
    which may break, it goes when all is written.
    """
    from wlplan.io.files import atomic_folder

    is_waited_for = sys.stdout.isatty() and not as_json
    if is_waited_for:
        show()
    written = None
    if folder is not None:
        with Progress() as progress, atomic_folder(folder, existing="add") as staging:
            progress.phase("drawing")
            written = write(staging)
    if not is_waited_for:
        show()
    if not as_json:
        _print_written(folder, written)


def _folder_of(out: str | None, also: Sequence[str]) -> Path | None:
    """The folder to write to, and a check that all can be written there.

    Raises:
        InputError: If not, or if there is no folder for what is exported.
    """
    if also and out is None:
        raise InputError("--also needs a folder to write to: give --out DIR.")
    check_exports(also)
    return None if out is None else checked_folder(out, [*_FILES, *names_of_exports(also)])


def _print_written(folder: Path | None, written: list[str] | None) -> None:
    if folder is None or written is None:
        say("nothing written: --out DIR writes the plan, the figures and a report")
        return
    first, *others = written
    say(f"written: {folder / first}, and {', '.join(others)} beside it")


@click.command(
    short_help="Play a plan in the simulator or in discrete elements.",
    epilog="\b\nExample: wlplan simulate scan.tif plan/plan.json --out again/",
)
@pile_argument(required=True)
@click.argument("plan_file", metavar="PLAN.json")
@with_options(
    engine_option,
    scatter_option,
    truck_option,
    *site_options("that of the plan"),
    out_option,
    also_option,
)
def simulate(
    pile_file: PileFile,
    plan_file: str,
    engine: str,
    scatter: int | None,
    truck: tuple[float, ...] | None,
    soil: str | None,
    machine: str | None,
    out: str | None,
    also: tuple[str, ...],
    seed: int,
    as_json: bool,
) -> None:
    """Play PLAN.json in an engine on PILE and compare the outcome with the prediction.

    With --out: plan.json, plan.png, totals.png and report.html, of the plan as it was played.

    Truck, soil and machine are those of the plan, unless given. No engine has randomness, so
    --seed changes nothing; --scatter gives the simulator that of real grains. If interrupted, the
    same command with --engine dem continues where it was.
    """
    if engine == "dem" and "gif" in also:
        raise InputError(
            "discrete elements keep no pile between the loads: leave out --also gif, or play the "
            "plan in the simulator."
        )
    if engine == "dem" and scatter is not None:
        raise InputError(
            "discrete elements have a scatter of their own: leave out --scatter, or play the plan "
            "in the simulator."
        )
    check_pile_name(pile_file.name)
    site_named(soil, machine)  # wrong options are refused before anything heavy is imported

    folder = _folder_of(out, also)

    from wlplan.io import read_plan
    from wlplan.io.files import named as named_file
    from wlplan.planning.amounts import amount_recorded
    from wlplan.planning.piles import heights_after
    from wlplan.planning.plan import play
    from wlplan.report.document import deviation_of, plan_document, write_plan_folder
    from wlplan.site.frame import frame_recorded
    from wlplan.worlds.scattered import scattered

    loading_plan, given = read_plan(plan_file)
    recorded = site_recorded(given, plan_file)
    site = site_named(soil, machine, otherwise=recorded)
    made_for = given.get("pile")
    named = pile_named(read_as_recorded(pile_file, made_for), site.machine)
    pile, source = named.pile, named.fields
    if isinstance(made_for, dict) and made_for.get("sha256", source["sha256"]) != source["sha256"]:
        remark("the plan was made for another pile file than this one")
    elif isinstance(made_for, dict) and any(
        made_for.get(name, source[name]) != source[name] for name in ("cells", "origin")
    ):
        remark("the plan was made for another part of this file: read it with the same --crop")
    if (site.soil, site.machine) != (recorded.soil, recorded.machine):
        remark("the plan was made for another soil or machine than it is played with")
    with named_file(Path(plan_file)):
        frame = frame_recorded(given)
        dx, dy = named.frame.shift_from(frame)
    loading_plan = loading_plan.replace(
        pose=loading_plan.pose.replace(x=loading_plan.pose.x + dx, y=loading_plan.pose.y + dy)
    )
    objective = given.get("objective")
    # A plan file must not make us import somebody else's module.
    if not isinstance(objective, str) or objective not in OBJECTIVES:
        objective = next(iter(OBJECTIVES))
    places = None if truck is not None else _places_of_trucks(given, frame)
    if places is None:
        place = site.with_receiver(
            named, truck if truck is not None else _truck_of(given, frame), note=remark
        )
    else:
        place = site.with_receivers(named, places, note=remark)
    with named_file(Path(plan_file)):
        amount = amount_recorded(given.get("job"))
    cycles: list[Any] = []
    count = len(given["loads"])
    with Progress() as progress, Stopwatch() as playing:
        progress.phase("playing")

        def keep(number: int, record: Any) -> None:
            cycles.append(record.as_dict())
            progress(engine, number, count, None)

        progress(engine, 0, count, None)
        simulator = world_named(engine, site)
        if scatter is not None:
            simulator = scattered(simulator, seed=scatter)
        played = ready(
            play(
                simulator,
                pile,
                loading_plan,
                objective=objective,
                amount=amount,
                site=place,
                note=remark,
                record=keep,
            )
        )
        if not cycles:
            progress(engine, count, count, None)

    predicted = _predicted_of(given)
    by: dict[str, Any] = {} if engine == USUAL_ENGINE else {"engine": engine}
    if scatter is not None:
        by["scatter"] = scatter
    document = plan_document(
        pile,
        played,
        site=place,
        predicted=predicted,
        predicted_cost=None if predicted is None else _predicted_cost(given),
        deviation=None if predicted is None else deviation_of(given),
        stall_probability=_stalls_foreseen(given),
        amount=amount,
        pile=named.fields,
        **site.fields(),
        **{name: given[name] for name in _ORIGIN_FIELDS if name in given},
        objective=objective,
        **by,
    )
    for load, cycle in zip(document["loads"], cycles, strict=False):
        load["cycle"] = cycle
    text = json_text(document)

    def show() -> None:
        for note in document["notes"]:
            remark(note)
        remark_on_ledger(document["ledger"])
        if as_json:
            click.echo(text)
            return
        print_plan(document)
        drawn = "" if scatter is None else f", scatter drawn from seed {scatter},"
        say(f"{engine}{drawn} {playing.text()}")

    def write(staging: Path) -> list[str]:
        return write_plan_folder(
            staging,
            document,
            pile,
            played,
            site=place,
            predicted=predicted,
            # In discrete elements a load takes minutes, and is not made once more.
            heights=None if cycles else heights_after(simulator, pile, played.plan),
            settings={f"{engine}, wall clock": playing.text()},
            also=also,
        )

    _show_and_write(folder, show, write, as_json=as_json)


def _truck_of(document: Mapping[str, Any], frame: Frame) -> tuple[float, ...] | None:
    """The truck that a plan in a frame was made for, as of the option; None if it names none."""
    from wlplan.report.document import RECEIVER_FIELDS

    record = document.get("receiver")
    values = [record.get(name) if isinstance(record, dict) else None for name in RECEIVER_FIELDS]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return None
    x, y, heading = (float(v) for v in values if v is not None)
    return *frame.scan(x, y), math.degrees(heading)


def _places_of_trucks(
    document: Mapping[str, Any], frame: Frame
) -> list[tuple[float, float, float]] | None:
    """The places of trucks that have each its own, as of the option; None for one or none."""
    from wlplan.report.stands import stands_of

    stands, trucks = stands_of(document), document.get("trucks") or []
    if len(stands) < 2:
        return None
    found = [_truck_of({"receiver": truck}, frame) for truck in trucks]
    places = [(one[0], one[1], one[2]) for one in found if one is not None and len(one) == 3]
    return places if len(places) == len(trucks) else None


def _predicted_of(document: Mapping[str, Any]) -> Performance | None:
    """What a plan predicts of its loads; None unless it does of all of them."""
    import numpy as np

    from wlplan.types import Performance

    rows = []
    for load in document["loads"]:
        record = load.get("predicted")
        values = [record.get(q) if isinstance(record, dict) else None for q in QUANTITIES]
        if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            return None
        rows.append(values)
    return Performance(*np.array(rows, dtype=float).T)


def _stalls_foreseen(document: Mapping[str, Any]) -> list[float] | None:
    """How likely the loads of a plan were said to stall; None unless it says so of all."""
    likely = [load.get("stall_probability") for load in document["loads"]]
    known = all(
        isinstance(v, int | float) and not isinstance(v, bool) and 0.0 <= v <= 1.0 for v in likely
    )
    return [float(v) for v in likely] if known else None


def _predicted_cost(document: Mapping[str, Any]) -> float | None:
    """The cost that a plan predicts, if it names one."""
    try:
        cost = document["total"]["predicted"]["cost"]
    except (KeyError, TypeError):
        return None
    is_number = isinstance(cost, int | float) and not isinstance(cost, bool)
    return float(cost) if is_number else None
