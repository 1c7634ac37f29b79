"""`wlplan bench`: how fast the package is on this machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

from wlplan.cli.options import out_option, with_options
from wlplan.cli.outputs import checked_folder, json_text, print_table, titled_table, write_files
from wlplan.cli.progress import Progress
from wlplan.cli.said import say

# Names that `wlplan.studies.bench` defines, repeated here to keep help fast; a test compares them.
ITEMS = (
    *("avalanche", "avalanche-gradient", "avalanche-batch", "loading", "rollout"),
    *("rollout-gradient", "psi-low", "psi-low-batch", "gpu-rollouts", "cycles", "plan"),
    *("first-load", "next-load", "map", "map-optimised", "settle", "xla", "numba", "numpy"),
    "aeolis",
)
# How the figures of an item are written.
_FIGURES: dict[str, Callable[[float], str]] = {
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
    "processor_seconds": lambda v: f"{_duration(v)} of all cores",
    "nine_of_ten": lambda v: f"nine of ten {_duration(v)}",
    "seconds_on_another_pile": lambda v: f"{_duration(v)} on another pile",
}


@click.command(
    short_help="Measure how fast the package is on this machine.",
    epilog="\b\nExample: wlplan bench --quick --only avalanche",
)
@with_options(
    click.option(
        "--only",
        "names",
        type=click.Choice(ITEMS),
        metavar="NAME",
        multiple=True,
        help=f"Item to measure; may be given several times: {', '.join(ITEMS)}. Default: all.",
    ),
    click.option("--quick", is_flag=True, help="Fewer cases and repeats, and no whole plans."),
    out_option,
)
def bench(names: tuple[str, ...], quick: bool, out: str | None, seed: int, as_json: bool) -> None:
    """Measure how fast the package is on this machine, beside its targets and other programs.

    Compiling and running are timed separately. With --out: bench.json.
    """
    folder = None if out is None else checked_folder(out, ["bench.json"])

    from wlplan.studies.bench import run_bench

    with Progress() as progress:
        document = run_bench(names, quick=quick, seed=seed, progress=progress)
    text = json_text(document)
    if folder is not None:
        write_files(folder, {"bench.json": f"{text}\n"})
    if as_json:
        click.echo(text)
        return
    _print_bench(document)
    if folder is not None:
        say(f"written: {folder / 'bench.json'}")


def _print_bench(document: Mapping[str, Any]) -> None:
    """What was measured as a table on stdout, one group after the other."""
    device, versions = document["device"], document["versions"]
    table = titled_table(
        f"{device['processor']}, {device['cores']} cores; JAX {versions['jax']} on {device['kind']}"
    )
    table.add_column("item", width=30)
    for column in ("compile", "run,\nmedian", "10th to 90th\npercentile", "runs"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("result", width=28)
    table.add_column("target", width=20)
    table.add_column("met", width=3)
    records = document["items"]
    for record, after in zip(records, (*records[1:], None), strict=True):
        run = record["run"]
        cells = ["", "", "", ""]
        if run is not None:
            compiling = "" if record["compile"] is None else _duration(record["compile"])
            spread = f"{_duration(run['p10'])} to {_duration(run['p90'])}"
            cells = [compiling, _duration(run["median"]), spread, str(run["repeats"])]
        found = [_FIGURES[name](value) for name, value in record["figures"].items()]
        others = f"\nothers: {record['reference']}" if record["reference"] else ""
        table.add_row(
            f"{record['name']}\n{record['title']}{others}",
            *cells,
            record["note"] or ", ".join(found),
            record["target"] or "",
            {True: "yes", False: "no", None: ""}[record["met"]],
            end_section=after is None or after["group"] != record["group"],
        )
    print_table(table)
    say("Targets are for two CPU cores. Times of others were measured elsewhere or published.")


def _duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    unit, scale = ("s", 1.0) if seconds >= 1.0 else ("ms", 1e3) if seconds >= 1e-3 else ("µs", 1e6)
    value = seconds * scale
    return f"{value:.{0 if value >= 100.0 else 1 if value >= 10.0 else 2}f} {unit}"
