"""`wlplan export`: worlds and predictors as files that run without wlplan."""

from __future__ import annotations

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
    pile_argument,
    site_options,
    with_options,
    world_option,
)
from wlplan.cli.outputs import checked_folder, print_table, titled_table
from wlplan.cli.progress import Progress, Stopwatch
from wlplan.portable import FORMATS, FUNCTIONS, TOLERANCE


@click.command(
    short_help="Write a world or a predictor as StableHLO or ONNX.",
    epilog="\b\nExample: wlplan export performance --format onnx --out psi/",
)
@click.argument("function", metavar="FUNCTION", type=click.Choice(FUNCTIONS))
@pile_argument()
@with_options(
    click.option(
        "--format",
        "kinds",
        type=click.Choice(FORMATS),
        multiple=True,
        default=("stablehlo",),
        show_default=True,
        help="Kind of file: stablehlo, for jax.export; mlir, the StableHLO module alone, for PJRT "
        "and IREE; onnx, of predictors, which needs wlplan[export]. May be given again.",
    ),
    click.option(
        "--tolerance",
        type=click.FloatRange(0.0),
        default=TOLERANCE,
        show_default=True,
        help="How far an output may be off, in parts of the largest value of that output.",
    ),
    click.option("--out", metavar="DIR", required=True, help="Folder to write: a new one."),
    world_option,
    *site_options(),
    *model_options,
)
def export(
    function: str,
    pile_file: PileFile,
    kinds: tuple[str, ...],
    tolerance: float,
    out: str,
    world_name: str,
    soil: str | None,
    machine: str | None,
    model: str | None,
    pile_state: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Write FUNCTION as a file that runs without wlplan, and check what it computes.

    FUNCTION is world, a whole world, or a predictor of it: performance (psi-low or psi-high),
    pile-state (phi) or stall.

    Each file is read back, run at eight places along the toe of PILE with random actions, and
    compared with the original; if it is off, nothing is written. A world takes maps of the size of
    PILE. Writes export.json, which says what inputs and outputs are, and check.npz with the inputs
    and outputs of the check.
    """
    check_pile_name(pile_file.name)
    check_models(model, pile_state, world_name)
    site = site_named(soil, machine)
    folder = checked_folder(out)

    from wlplan.portable.export import check_formats, check_place
    from wlplan.portable.export import export as export_function
    from wlplan.portable.functions import Asked, portable
    from wlplan.site.site import Site

    check_formats(kinds)
    check_place(folder)
    named = pile_named(pile_file, site.machine)
    asked = Asked(
        world=world_named(world_name, site, model, pile_state),
        pile=named.pile,
        contour=named.contour,
        site=Site(machine=site.machine, soil=site.soil),
        origin={
            "world": world_name,
            **model_fields(model, pile_state),
            **site.fields(),
            "pile": named.fields,
            "seed": seed,
        },
        seed=seed,
    )
    with Progress() as progress, Stopwatch() as work:
        progress.phase("exporting")
        compared = export_function(
            portable(function, asked), folder, kinds=kinds, tolerance=tolerance
        )
    if as_json:
        click.echo((folder / "export.json").read_text("utf-8"), nl=False)
        return
    table = titled_table(f"{function} of the {world_name} world, read back and compared")
    for column in ("", "kB", "off the most", "by", "of its largest value"):
        table.add_column(column, justify="right" if column in ("kB", "by") else "left")
    for found in compared:
        size = (folder / found.file).stat().st_size / 1e3
        worst = found.worst
        table.add_row(
            found.file,
            f"{size:.0f}",
            worst,
            f"{found.largest[worst]:.2g}",
            f"{found.relative[worst]:.2g}",
        )
    print_table(table)
    print(f"exporting and comparing {work.text()}")
    print(f"written: {folder}, with export.json and check.npz")
