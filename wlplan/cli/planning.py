"""`wlplan plan` and `wlplan simulate`: make a plan and play it, or play one that was written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wlplan.cli.engines import play_in
from wlplan.cli.inputs import (
    RECEIVER_FIELDS,
    check_models,
    check_pile_name,
    model_fields,
    pile_named,
    receiver_at,
    receiver_fields,
    site_named,
    site_recorded,
    world_named,
)
from wlplan.cli.options import (
    OBJECTIVES,
    PLANNERS,
    engine_option,
    loads_option,
    model_options,
    objective_option,
    out_option,
    pile_argument,
    site_options,
    truck_option,
    with_options,
    world_option,
)
from wlplan.cli.outputs import checked_folder, json_text, remark
from wlplan.cli.played import ledger_of, print_plan, remark_on_ledger, totals, transport_totals
from wlplan.cli.progress import Progress, Stopwatch, ready
from wlplan.constants import QUANTITIES

if TYPE_CHECKING:
    from wlplan.planning.plan import PlanResult
    from wlplan.planning.transport import Receiver
    from wlplan.types import Performance, Pile

_MOST_LOADS = 500
# What a plan says about where it comes from; playing it again keeps that.
_ORIGIN_FIELDS = ("world", "model", "pile_state", "planner", "seed")


@click.command()
@pile_argument
@with_options(
    loads_option(default=15, most=_MOST_LOADS),
    world_option,
    click.option(
        "--planner", type=click.Choice(PLANNERS), default="gradient", show_default=True, help="How."
    ),
    objective_option("What for."),
    click.option(
        "--referee/--no-referee",
        default=True,
        show_default=True,
        help="Let the simulator pick among the planner's best plans.",
    ),
    truck_option,
    *site_options(),
    *model_options,
    out_option,
)
def plan(
    pile_file: str,
    loads: int,
    world_name: str,
    planner: str,
    objective: str,
    referee: bool,
    truck: tuple[float, ...] | None,
    soil: str | None,
    machine: str | None,
    model: str | None,
    pile_state: str | None,
    out: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Plan the next loads from PILE and play the plan in the simulator.

    With --out: plan.json, plan.png, totals.png and report.html, which shows everything.
    """
    check_pile_name(pile_file)
    check_models(model, pile_state, world_name)
    site = site_named(soil, machine)
    folder = None if out is None else checked_folder(out)

    from wlplan.io import plan_to_dict
    from wlplan.planning.plan import plan_loads

    pile, source = pile_named(pile_file)
    receiver = receiver_at(pile, truck)
    world, simulator = (
        world_named(world_name, site, model, pile_state),
        world_named("simulator", site),
    )
    with Progress() as progress:
        with Stopwatch() as planning:
            planned = ready(
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
        with Stopwatch() as playing:
            if world_name == "simulator":
                simulated = planned
            elif planned.refereed is not None:
                simulated = planned.refereed
            else:
                simulated, _ = play_in(
                    simulator,
                    pile,
                    planned.plan,
                    objective=objective,
                    receiver=receiver,
                    progress=progress,
                )

    document = plan_to_dict(
        planned.plan,
        predicted=planned.rollout.performance,
        simulated=simulated.rollout.performance,
        transport={"time": planned.transport_time, "work": planned.transport_work},
        pile=source,
        **site.fields(),
        world=world_name,
        planner=planner,
        objective=objective,
        referee=referee,
        seed=seed,
        **model_fields(model, pile_state),
        receiver=receiver_fields(receiver),
        total={
            "predicted": totals(planned.rollout.performance, planned.cost),
            "simulated": totals(simulated.rollout.performance, simulated.cost),
            "transport": transport_totals(planned),
        },
        ledger=ledger_of(pile, simulated, simulator),
    )
    text = json_text(document)
    seconds = {"planning": planning.text()}
    if planned.refereed is None:
        seconds["simulator"] = playing.text()
    if folder is not None:
        _write_plan(folder, document, pile, planned, simulated, receiver, seconds)
    remark_on_ledger(document["ledger"])
    if as_json:
        click.echo(text)
        return
    print_plan(document)
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
    from wlplan.io import write_bytes_atomic, write_plan
    from wlplan.io.files import atomic_folder
    from wlplan.report import figures as plots
    from wlplan.report.page import write_report

    count = len(document["loads"])
    map_png = plots.png_bytes(
        plots.plan_figure(
            pile,
            simulated.rollout.pile,
            planned.plan,
            receiver=receiver,
            after_title=f"After {count} load{'s' if count > 1 else ''} in the simulator",
        )
    )
    totals_png = plots.png_bytes(
        plots.totals_figure(planned.rollout.performance, simulated.rollout.performance)
    )
    with atomic_folder(folder, existing="add") as staging:
        write_plan(staging / "plan.json", document)
        write_bytes_atomic(staging / "plan.png", map_png)
        write_bytes_atomic(staging / "totals.png", totals_png)
        write_report(
            staging,
            document,
            figures=(
                (map_png, "The pile and the digs"),
                (totals_png, "Predicted beside simulated"),
            ),
            settings={f"{name}, wall clock": text for name, text in seconds.items()},
        )


@click.command()
@click.argument("pile_file", metavar="PILE")
@click.argument("plan_file", metavar="PLAN.json")
@with_options(engine_option, truck_option, *site_options("that of the plan"))
def simulate(
    pile_file: str,
    plan_file: str,
    engine: str,
    truck: tuple[float, ...] | None,
    soil: str | None,
    machine: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Play PLAN.json in an engine on PILE and compare with what was predicted.

    Truck, soil and machine are those of the plan, unless given. No engine has randomness, so
    --seed changes nothing. Interrupted with --engine dem, the same command goes on where it was.
    """
    check_pile_name(pile_file)
    site_named(soil, machine)  # wrong options are refused before anything heavy is imported

    from wlplan.io import plan_to_dict, read_plan

    loading_plan, given = read_plan(plan_file)
    pile, source = pile_named(pile_file)
    made_for = given.get("pile")
    if isinstance(made_for, dict) and made_for.get("sha256", source["sha256"]) != source["sha256"]:
        remark("the plan was made for another pile file than this one")
    recorded = site_recorded(given, plan_file)
    site = site_named(soil, machine, otherwise=recorded)
    if (site.soil, site.machine) != (recorded.soil, recorded.machine):
        remark("the plan was made for another soil or machine than it is played with")
    objective = given.get("objective")
    objective = objective if objective in OBJECTIVES else OBJECTIVES[0]
    receiver = receiver_at(pile, truck if truck is not None else _truck_of(given))
    with Progress() as progress, Stopwatch() as playing:
        world = world_named(engine, site)
        played, cycles = play_in(
            world, pile, loading_plan, objective=objective, receiver=receiver, progress=progress
        )

    predicted = _predicted_of(given)
    total = {
        "simulated": totals(played.rollout.performance, played.cost),
        "transport": transport_totals(played),
    }
    if predicted is not None:
        total = {"predicted": _given_totals(predicted, given), **total}
    document = plan_to_dict(
        loading_plan,
        predicted=predicted,
        simulated=played.rollout.performance,
        transport={"time": played.transport_time, "work": played.transport_work},
        pile=source,
        **site.fields(),
        **{name: given[name] for name in _ORIGIN_FIELDS if name in given},
        objective=objective,
        receiver=receiver_fields(receiver),
        total=total,
        ledger=ledger_of(pile, played, world),
        **({} if cycles is None else {"engine": engine}),
    )
    for load, cycle in zip(document["loads"], cycles or (), strict=False):
        load["cycle"] = cycle
    text = json_text(document)
    remark_on_ledger(document["ledger"])
    if as_json:
        click.echo(text)
        return
    print_plan(document)
    print(f"{engine} {playing.text()}")


def _truck_of(document: Mapping[str, Any]) -> tuple[float, ...] | None:
    """The truck that a plan was made for, as of the option; None if it names none."""
    record = document.get("receiver")
    values = [record.get(name) if isinstance(record, dict) else None for name in RECEIVER_FIELDS]
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
        values = [record.get(q) if isinstance(record, dict) else None for q in QUANTITIES]
        if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            return None
        rows.append(values)
    return Performance(*np.array(rows, dtype=float).T)


def _given_totals(predicted: Performance, document: Mapping[str, Any]) -> dict[str, float]:
    """The sums that a plan predicts, with the cost if it names one."""
    try:
        cost = document["total"]["predicted"]["cost"]
    except (KeyError, TypeError):
        cost = None
    return totals(predicted, cost if isinstance(cost, int | float) else None)
