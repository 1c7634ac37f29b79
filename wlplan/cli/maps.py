"""`wlplan diggability`: what one action would yield all around a pile."""

from __future__ import annotations

import dataclasses
import math

import click

from wlplan.cli.inputs import (
    check_models,
    check_pile_name,
    model_fields,
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
from wlplan.cli.values import ActionNumbers
from wlplan.constants import QUANTITIES

_FORMAT = "wlplan.diggability/1"
_FILES = ("report.html", "diggability.png", "diggability.json")
_MOST_LOCATIONS = 10_000


@click.command(
    short_help="Map what one action would yield all around a pile.",
    epilog="\b\nExample: wlplan diggability scan.tif --locations 150 --out map/",
)
@pile_argument()
@with_options(
    click.option(
        "--locations",
        type=click.IntRange(1, _MOST_LOCATIONS),
        default=150,
        show_default=True,
        help="Number of dig locations around the pile.",
    ),
    click.option(
        "--action",
        type=ActionNumbers(),
        default="0.68,4.51,0.17,4.46",
        show_default=True,
        help="Parameters of the bucket-filling controller, the same everywhere.",
    ),
    world_option,
    *site_options(),
    *model_options,
    out_option,
)
def diggability(
    pile_file: PileFile,
    locations: int,
    action: tuple[float, ...],
    world_name: str,
    soil: str | None,
    machine: str | None,
    model: str | None,
    pile_state: str | None,
    out: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Map what one action would yield all around PILE.

    With --out: report.html, which shows everything, diggability.png and diggability.json.

    Nothing is random, so --seed changes nothing.
    """
    check_pile_name(pile_file.name)
    check_models(model, pile_state, world_name)
    site = site_named(soil, machine)
    folder = None if out is None else checked_folder(out, _FILES)

    import numpy as np

    from wlplan.report.plausibility import remarks_on_map
    from wlplan.site.site import Site
    from wlplan.studies.diggability import diggability_map, stalls_on_map
    from wlplan.types import Action

    named = pile_named(pile_file, site.machine)
    pile, source = named.pile, named.fields
    world = world_named(world_name, site, model, pile_state)
    fixed = Action(*action)
    with Progress() as progress, Stopwatch() as mapping:
        progress.phase("mapping")
        found = ready(
            diggability_map(world, pile, locations=locations, action=fixed, contour=named.contour)
        )

        stalls = ready(stalls_on_map(world, pile, found, fixed))
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
        for q in QUANTITIES
    }
    names = [field.name for field in dataclasses.fields(Action)]
    document = {
        "format": _FORMAT,
        "pile": source,
        "frame": named.frame.fields(),
        **site.fields(),
        "world": world_name,
        **model_fields(model, pile_state),
        "action": dict(zip(names, action, strict=True)),
        "summary": summary,
        "locations": [
            {name: float(values[n]) for name, values in records.items()} for n in range(locations)
        ],
    }
    if stalls is not None:
        for place, likely in zip(document["locations"], np.asarray(stalls), strict=True):
            place["stall_probability"] = float(likely)
    document["notes"] = remarks_on_map(
        document,
        pile,
        Site(machine=site.machine, soil=site.soil),
        models=hasattr(world, "faces_seen"),
    )
    text = json_text(document)
    if folder is not None:
        from wlplan.report import figures as plots
        from wlplan.report.diggability_page import render_map

        png = plots.png_bytes(plots.diggability_figure(pile, found, frame=named.frame))
        page = render_map(document, pile, settings={"map, wall clock": mapping.text()})
        write_files(folder, dict(zip(_FILES, (page, png, f"{text}\n"), strict=True)))
    for note in document["notes"]:
        remark(note)
    if as_json:
        click.echo(text)
        return
    table = titled_table(f"{locations} locations around {source['file']}, {world_name} world")
    for column in ("", "least", "median", "most", "most at x [m]", "y [m]", "heading [°]"):
        table.add_column(column, justify="left" if not column else "right")
    for q, (title, unit, digits) in QUANTITIES.items():
        best = int(records[q].argmax())
        table.add_row(
            f"{title} [{unit}]",
            *(f"{value:.{digits}f}" for value in summary[q].values()),
            *(f"{v:.2f}" for v in named.frame.scan(records["x"][best], records["y"][best])),
            f"{math.degrees(records['heading'][best]):.0f}",
        )
    print_table(table)
    say(f"map {mapping.text()}")
    if folder is not None:
        say(f"written: {folder / _FILES[0]}, and {', '.join(_FILES[1:])} beside it")
