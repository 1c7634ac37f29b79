"""`wlplan gradcheck`: the gradient of a plan's cost beside finite differences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from wlplan.cli.inputs import (
    check_models,
    check_pile_name,
    model_fields,
    objective_named,
    pile_named,
    site_named,
    world_named,
)
from wlplan.cli.options import (
    PileFile,
    loads_option,
    model_options,
    objective_option,
    out_option,
    pile_argument,
    site_options,
    with_options,
    world_option,
)
from wlplan.cli.outputs import checked_folder, json_text, print_table, titled_table, write_files
from wlplan.cli.progress import Progress, Stopwatch
from wlplan.cli.said import say
from wlplan.cli.values import FiniteRange
from wlplan.errors import InputError

if TYPE_CHECKING:
    from wlplan.studies.gradcheck import GradientCheck

_FORMAT = "wlplan.gradcheck/1"
# Every component takes two rollouts, and in the simulator, with its fixed number of steps, a
# rollout takes ten times as long.
_MOST_LOADS, _MOST_LOADS_SIMULATOR = 50, 10
_VERDICTS = {"ok": ("ok", None), "kink": ("kink", "yellow"), "wrong": ("WRONG", "bold red")}


@click.command(
    short_help="Compare the gradient of a plan's cost with finite differences.",
    epilog="\b\nExample: wlplan gradcheck scan.tif --world low --loads 5",
)
@pile_argument()
@with_options(
    loads_option(
        default=5,
        most=_MOST_LOADS,
        remark=f"; at most {_MOST_LOADS_SIMULATOR} in the simulator",
    ),
    world_option,
    objective_option("Cost of the plan"),
    click.option(
        "--step",
        type=FiniteRange(1e-9, 1e-3),
        default=1e-6,
        show_default=True,
        help="Step of the differences, in m, rad or the unit of the action parameter.",
    ),
    click.option(
        "--tolerance",
        type=FiniteRange(1e-9, 1.0),
        default=None,
        help="Relative error above which a component counts as wrong. Default: 1e-4; in the "
        "simulator, where the derivative of the earthmoving force is approximate, 3e-3.",
    ),
    *site_options(),
    *model_options,
    out_option,
)
def gradcheck(
    pile_file: PileFile,
    loads: int,
    world_name: str,
    objective: str,
    step: float,
    tolerance: float | None,
    soil: str | None,
    machine: str | None,
    model: str | None,
    pile_state: str | None,
    out: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Compare the gradient of a plan's cost with central differences, in float64.

    The plan is random, along the toe of PILE, with digs so close that each depends on those before.
    A component where the cost has a kink is reported as such. Ends with exit code 1 if a component
    is wrong. With --out: gradcheck.json.
    """
    check_pile_name(pile_file.name)
    check_models(model, pile_state, world_name)
    site = site_named(soil, machine)
    in_simulator = world_name == "simulator"
    if in_simulator and loads > _MOST_LOADS_SIMULATOR:
        raise InputError(
            f"--loads {loads} takes too long in the simulator: ask for at most "
            f"{_MOST_LOADS_SIMULATOR}, or check another world."
        )
    folder = None if out is None else checked_folder(out, ["gradcheck.json"])

    from wlplan.io import plan_to_dict
    from wlplan.planning.job import make_job
    from wlplan.report.document import receiver_fields
    from wlplan.studies.gradcheck import SIMULATOR_TOLERANCE, TOLERANCE, check_gradient, random_plan

    if tolerance is None:
        tolerance = SIMULATOR_TOLERANCE if in_simulator else TOLERANCE
    named = pile_named(pile_file, site.machine)
    world = world_named(world_name, site, model, pile_state)
    job = make_job(
        world,
        named.pile,
        site=site.with_receiver(named),
        objective=objective_named(objective),
    )
    checked_plan = random_plan(named.pile, loads, seed=seed, contour=named.contour)
    with Progress() as progress, Stopwatch() as checking:
        check = check_gradient(
            job,
            checked_plan,
            step=step,
            tolerance=tolerance,
            progress=lambda done, total: progress("components", done, total, None),
        )

    document = {
        "format": _FORMAT,
        "pile": named.fields,
        "frame": named.frame.fields(),
        **site.fields(),
        "world": world_name,
        **model_fields(model, pile_state),
        "objective": objective,
        "seed": seed,
        "receiver": receiver_fields(job.site.placed_receiver),
        "loads": plan_to_dict(checked_plan)["loads"],
        **check.as_dict(),
    }
    text = json_text(document)
    if folder is not None:
        write_files(folder, {"gradcheck.json": f"{text}\n"})
    if as_json:
        click.echo(text)
    else:
        _print_check(
            check,
            f"{loads} load{'s'[: loads != 1]} from {named.fields['file']}, {world_name} world",
        )
        say(f"gradient and differences {checking.text()}")
        if folder is not None:
            say(f"written: {folder / 'gradcheck.json'}")
    if check.with_verdict("wrong"):
        raise click.exceptions.Exit(1)


def _print_check(check: GradientCheck, title: str) -> None:
    """The components of a gradient as a table on stdout, with a summary."""
    table = titled_table(title)
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
    print_table(table)
    kinks, wrong = check.with_verdict("kink"), check.with_verdict("wrong")
    count = len(check.components)
    say(
        f"{count} components: {count - len(kinks) - len(wrong)} ok, {len(kinks)} at kinks "
        f"({100.0 * check.kink_fraction:.1f} %), {len(wrong)} wrong"
    )
    for word, found in (("at kinks", kinks), ("WRONG", wrong)):
        if found:
            say(f"{word}: {', '.join(f'load {c.load} {c.component}' for c in found)}")
    say(
        f"relative error, kinks left out: largest {check.largest_error:.1e}, "
        f"median {check.median_error:.1e}; tolerance {check.tolerance:g}"
    )
