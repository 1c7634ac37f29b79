"""`wlplan diggability`: what loads would yield all around the piles of a scan."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

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
    model_options,
    out_option,
    pile_argument,
    site_options,
    truck_option,
    with_options,
    world_option,
)
from wlplan.cli.outputs import (
    checked_folder,
    json_text,
    print_table,
    remark,
    titled_table,
    write_files,
)
from wlplan.cli.progress import Progress, Stopwatch, ready
from wlplan.cli.said import say
from wlplan.cli.values import ActionNumbers, NameOrReference
from wlplan.errors import InputError
from wlplan.planning.objectives import OBJECTIVES

if TYPE_CHECKING:
    from wlplan.site.frame import Frame

_FILES = ("report.html", "diggability.png", "diggability.json")
_MOST_LOCATIONS = 10_000
_RATE = "rate"


@click.command(
    short_help="Map what loads would yield all around a pile.",
    epilog="\b\nExample: wlplan diggability scan.tif --locations 150 --optimise --out map/",
)
@pile_argument()
@with_options(
    click.option(
        "--locations",
        type=click.IntRange(1, _MOST_LOCATIONS),
        default=150,
        show_default=True,
        help="Number of dig locations, on all piles of the scan together.",
    ),
    click.option(
        "--action",
        type=ActionNumbers(),
        default="0.68,4.51,0.17,4.46",
        show_default=True,
        help="Parameters of the bucket-filling controller, the same everywhere.",
    ),
    click.option(
        "--optimise",
        is_flag=True,
        help="Search for the best heading and parameters at each location, and compare with "
        "--action.",
    ),
    click.option(
        "--objective",
        type=NameOrReference("objective", (_RATE, *OBJECTIVES)),
        default=None,
        help=f"What is best with --optimise, and what a cycle costs with --truck: {_RATE}, which "
        f"is t/h, {', '.join(OBJECTIVES)}, or package.module:Name of an objective of your own. "
        f"Default: {_RATE}; the cost of cycles is then that of {next(iter(OBJECTIVES))}.",
    ),
    truck_option,
    world_option,
    *site_options(),
    *model_options,
    out_option,
)
def diggability(
    pile_file: PileFile,
    locations: int,
    action: tuple[float, ...],
    optimise: bool,
    objective: str | None,
    truck: tuple[float, ...] | None,
    world_name: str,
    soil: str | None,
    machine: str | None,
    model: str | None,
    pile_state: str | None,
    out: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Map what loads would yield all around PILE: around each of its piles, or that of --pile.

    By default one action, the same everywhere, along the inward normal; with --optimise the best
    heading and action of each location. With --truck the driving there counts.

    With --out: report.html, which shows everything, diggability.png and diggability.json.

    --seed chooses the actions that --optimise begins with; without it nothing is random.
    """
    check_pile_name(pile_file.name)
    check_models(model, pile_state, world_name)
    if objective is not None and not optimise and truck is None:
        raise InputError("--objective goes with --optimise or --truck: add one, or leave it out.")
    site = site_named(soil, machine)
    folder = None if out is None else checked_folder(out, _FILES)

    from wlplan.report.diggability_document import FORMAT, Optimised, map_fields
    from wlplan.report.plausibility import remarks_on_map
    from wlplan.site.site import Site
    from wlplan.studies.diggability import diggability_map, foreseen_on_map
    from wlplan.studies.map_costs import with_driving
    from wlplan.studies.optimised_diggability import RATE, optimised_map
    from wlplan.terrain.toes import poses_around, toes_of
    from wlplan.types import Action

    named = pile_named(pile_file, site.machine)
    pile, source = named.pile, named.fields
    toes = toes_of(pile, machine=site.machine)
    contours = [toe.contour for toe in toes]
    _, number = poses_around(contours, locations)
    world = world_named(world_name, site, model, pile_state)
    fixed = Action(*action)
    by_rate = objective in (None, _RATE)
    chosen: Any = RATE if objective is None or by_rate else objective_named(objective)
    place = Site(machine=site.machine, soil=site.soil, keep_out=named.closed)
    if truck is not None:
        place = site.with_receiver(named, truck, note=remark)
    best: Optimised | None = None
    with Progress() as progress, Stopwatch() as mapping:
        progress.phase("mapping")
        where: dict[str, Any] = {"locations": locations, "action": fixed, "contour": contours}
        if optimise:
            searched = ready(
                optimised_map(world, pile, objective=chosen, site=place, seed=seed, **where)
            )
            found, beside = searched.best, searched.fixed
            if by_rate:
                # The rate is said as such.
                found, beside = found.replace(cost=None), beside.replace(cost=None)
            best = Optimised(beside, searched.offset, searched.gain, objective or _RATE)
        else:
            found = ready(diggability_map(world, pile, **where))
        if truck is not None and (by_rate or not optimise):
            cycle: Any = {} if by_rate else {"objective": chosen}
            found = ready(with_driving(world, pile, found, place, action=fixed, **cycle))
            if best is not None:
                beside = ready(with_driving(world, pile, best.fixed, place, **cycle))
                best = dataclasses.replace(best, fixed=beside)
        foreseen = ready(foreseen_on_map(world, pile, found, fixed))
    document: dict[str, Any] = {
        "format": FORMAT,
        "pile": source,
        "frame": named.frame.fields(),
        **site.fields(),
        "world": world_name,
        **model_fields(model, pile_state),
        **map_fields(
            found,
            fixed,
            foreseen=foreseen,
            optimised=best,
            receiver=None if truck is None else place.placed_receiver,
            piles=(toes, number),
        ),
    }
    document["notes"] = remarks_on_map(
        document,
        pile,
        Site(machine=site.machine, soil=site.soil),
        models=hasattr(world, "faces_seen"),
    )
    text = json_text(document)
    if folder is not None:
        from wlplan.report import figures as plots
        from wlplan.report.diggability_page import map_figure, render_map

        png = plots.png_bytes(map_figure(document, pile))
        page = render_map(document, pile, settings={"map, wall clock": mapping.text()})
        write_files(folder, dict(zip(_FILES, (page, png, f"{text}\n"), strict=True)))
    for note in document["notes"]:
        remark(note)
    if as_json:
        click.echo(text)
        return
    _print_map(document, named.frame)
    say(f"map {mapping.text()}")
    if folder is not None:
        say(f"written: {folder / _FILES[0]}, and {', '.join(_FILES[1:])} beside it")


def _print_map(document: Mapping[str, Any], frame: Frame) -> None:
    """The table of a map: what its quantities are at the least, in the middle and at the most."""
    from wlplan.report.diggability_page import shades_of

    places = document["locations"]
    table = titled_table(
        f"{len(places)} locations around {document['pile']['file']}, {document['world']} world"
    )
    for column in ("", "least", "median", "most", "most at x [m]", "y [m]", "heading [°]"):
        table.add_column(column, justify="left" if not column else "right")
    for shade in shades_of(document).values():
        at = places[int(shade.values.argmax())]
        table.add_row(
            f"{shade.title} [{shade.unit}]",
            *(
                f"{value:.{shade.digits}f}"
                for value in (shade.values.min(), shade.median, shade.values.max())
            ),
            *(f"{v:.2f}" for v in frame.scan(at["x"], at["y"])),
            f"{math.degrees(at['heading']):.0f}",
        )
    print_table(table)
    if "fixed" in document:
        old, new = (document[part]["rate"]["mean"] for part in ("fixed", "summary"))
        say(f"in the mean {new:.0f} t/h instead of {old:.0f} t/h with the action everywhere")
