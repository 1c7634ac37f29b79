"""`wlplan info`: what a scan holds, without planning; nothing here needs JAX."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wlplan.cli.options import BUNDLED, PileFile, pile_argument, with_options
from wlplan.cli.outputs import json_text
from wlplan.cli.said import say


@click.command(
    short_help="Say what a scan holds.",
    epilog="\b\nExample: wlplan info scan.laz --soil sand",
)
@pile_argument()
@with_options(
    click.option(
        "--soil",
        metavar="NAME|FILE.toml",
        default=None,
        help="Soil that the piles are weighed as. Default: gravel.",
    ),
)
def info(pile_file: PileFile, soil: str | None, seed: int, as_json: bool) -> None:
    """Say what PILE holds, in seconds: volumes, piles, slopes, structures, what was left out.

    Nothing is random, so --seed changes nothing.
    """
    from wlplan.cli.inputs import check_pile_name
    from wlplan.io.bundled import bundled_pile_path
    from wlplan.io.summary import info as summary
    from wlplan.site.presets import soil_named
    from wlplan.site.soil import GRAVEL

    check_pile_name(pile_file.name)
    dug = GRAVEL if soil is None else soil_named(soil)
    path = bundled_pile_path() if pile_file.name == BUNDLED else Path(pile_file.name)
    found = summary(path, soil=dug, **pile_file.reading)
    if as_json:
        click.echo(json_text(found))
        return
    _print(found, pile_file.name, soil or "gravel")


def _print(found: dict[str, Any], name: str, soil: str) -> None:
    """What was found, in words on stdout."""
    x0, y0, x1, y1 = found["extent"]
    nx, ny = found["cells"]
    say(f"{name}: {nx} x {ny} cells of {found['cell_size']:g} m")
    say(
        f"from {x0:.1f}, {y0:.1f} to {x1:.1f}, {y1:.1f} m; reference system: "
        f"{found['crs'] or 'not named'}"
    )
    if found["unseen_area"]:
        say(f"{found['unseen_area']:.1f} m² were not seen")
    parts = found["volume_deviation_parts"]
    say(
        f"volume {found['volume']:.1f} m³ ± {found['volume_deviation']:.1f} "
        f"(noise {parts['noise']:.1f}, floor {parts['floor']:.1f}, unseen {parts['unseen']:.1f}), "
        f"{found['tonnes']:.0f} t as {soil}"
    )
    for pile in found["piles"]:
        planned = (
            " (the one that is planned)" if pile["planned"] and len(found["piles"]) > 1 else ""
        )
        say(
            f"pile at {pile['x']:.1f}, {pile['y']:.1f}: {pile['volume']:.1f} m³ ± "
            f"{pile['volume_deviation']:.1f}, {pile['tonnes']:.0f} t, {pile['height']:.1f} m high, "
            f"{pile['area']:.0f} m², toe {pile['toe_length']:.0f} m{planned}"
        )
    say(
        f"slopes: median {found['median_slope_deg']:.0f}°, steepest "
        f"{found['steepest_slope_deg']:.0f}°; {soil} rests at {found['repose_deg']:.0f}°"
    )
    for one in found["structures"]:
        say(
            f"stands there: {one['kind']} {one['length']:.1f} x {one['width']:.1f} m, "
            f"{one['height']:.1f} m high, at {one['x']:.1f}, {one['y']:.1f}"
        )
    for note in found["notes"]:
        say(f"note: {note}")
