"""`wlplan collect`, `train` and `evaluate`: from the simulator to a learned model."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from wlplan.cli.evaluated import (
    evaluated,
    print_errors,
    print_pile_state,
    print_stalls,
    print_times,
)
from wlplan.cli.inputs import check_is_folder, site_named
from wlplan.cli.options import PROTOCOLS, site_options, training_options, with_options
from wlplan.cli.outputs import checked_folder, json_text, remark
from wlplan.cli.progress import Progress, Stopwatch
from wlplan.cli.said import say
from wlplan.cli.values import ShardNumber
from wlplan.errors import InputError
from wlplan.training.settings import KINDS

# A data set of so many takes 32 GB.
_MOST_CYCLES = 1_000_000


@click.command(
    short_help="Play random loading cycles and store them as training data.",
    epilog="\b\nExample: wlplan collect --cycles 10800 --out data.zarr",
)
@with_options(
    click.option(
        "--cycles",
        type=click.IntRange(1, _MOST_CYCLES),
        default=10_800,
        show_default=True,
        help="Number of loading cycles, of all shards together.",
    ),
    click.option("--out", metavar="DATA.zarr", required=True, help="Data set or shard to write."),
    click.option(
        "--shard",
        type=ShardNumber(),
        default=None,
        help="Play only the I-th of N parts, 1/N to N/N. Each part holds whole batches of cycles.",
    ),
    click.option(
        "--merge", "merging", is_flag=True, help="Join the shards PART.zarr instead of playing."
    ),
    click.option(
        "--protocol",
        type=click.Choice(PROTOCOLS),
        default="paper",
        show_default=True,
        help="How to choose poses and actions: as in the paper (paper), near where it dug before "
        "(corridor), with most actions near the last slow one (slow), or aslant from up to 1 m "
        "before or behind the toe, near where it dug before (past-toe).",
    ),
    *site_options(),
    click.argument("parts", metavar="[--merge PART.zarr...]", nargs=-1),
)
def collect(
    cycles: int,
    out: str,
    shard: tuple[int, int] | None,
    merging: bool,
    protocol: str,
    soil: str | None,
    machine: str | None,
    parts: tuple[str, ...],
    seed: int,
    as_json: bool,
) -> None:
    """Play random loading cycles in the simulator and store them as training data.

    If interrupted, the same command continues where it stopped.

    Several machines can share the work with --shard: each plays a part, with the same settings.
    --merge then joins the parts into the data set that one machine would have written.
    """
    if merging:
        _merge(parts, out, as_json)
        return
    if parts:
        raise InputError(
            f"{parts[0]}: shards are only named with --merge: add --merge, or leave the name out."
        )
    checked_folder(out)
    site = site_named(soil, machine)

    from wlplan.dataset import collect as collect_cycles
    from wlplan.engines.simulator import Simulator

    begin = time.perf_counter()
    counts: list[tuple[int, float]] = []
    with Progress() as progress:

        def tell(done: int, total: int) -> None:
            counts.append((done, time.perf_counter() - begin))
            progress("cycles", done, total, None)

        collect_cycles(
            out,
            cycles=cycles,
            seed=seed,
            protocol=protocol,
            simulator=Simulator(machine=site.machine, soil=site.soil),
            shard=shard,
            progress=tell,
        )
    if as_json:
        part = {} if shard is None else {"shard": shard[0], "shards": shard[1]}
        click.echo(json_text({"out": out, "cycles": cycles, "seed": seed, **part}))
        return
    which = "" if shard is None else f"shard {shard[0]}/{shard[1]} of "
    say(f"{which}{cycles} cycles in {out}; {_pace(counts)}")


def _pace(counts: Sequence[tuple[int, float]]) -> str:
    """Time of a collection, its start apart: each process compiles before its first cycle ends.

    Args:
        counts: How many cycles there were, and when [s]; the first as it begins.
    """
    played = [(count, at) for count, at in counts if count > counts[0][0]]
    if not played:
        return "nothing was left to play"
    (first, ready), (done, seconds) = played[0], played[-1]
    rate = (done - first) / (seconds - ready) if seconds > ready else float("nan")
    return (
        f"{seconds:.1f} s, {ready:.1f} of them until the first cycle (start and compiling), "
        f"then {rate:.0f} cycles a second"
    )


def _merge(parts: Sequence[str], out: str, as_json: bool) -> None:
    """`collect --merge`: the shards say which cycles and seed they are of."""
    context = click.get_current_context()
    for name in ("shard", "cycles", "seed", "protocol", "soil", "machine"):
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
            raise InputError(f"--{name} does not go with --merge: leave one of them out.")
    if not parts:
        raise InputError("--merge needs the shards to join: name all of them.")
    for part in parts:
        check_is_folder(part, "shard", "wlplan collect --shard")
    checked_folder(out)

    from wlplan.dataset import merge

    with Progress() as progress:
        attributes = merge(
            parts, out, progress=lambda done, total: progress("cycles", done, total, None)
        )
    cycles, seed = attributes["cycles"], attributes["seed"]
    if as_json:
        click.echo(json_text({"out": out, "cycles": cycles, "seed": seed, "merged": list(parts)}))
        return
    say(f"{cycles} cycles of {len(parts)} {'shard' if len(parts) == 1 else 'shards'} in {out}")


# Kinds of the models that predict the pile state.
_PILE_STATE = ("phi", "phi_vae")
_STALL = "stall"
# Kinds of the models by their names on the command line, where one name stands for all that ship.
_MODELS = {kind.replace("_", "-"): kind for kind in KINDS}
_ALL = "all"


@click.command(
    short_help="Train a model on collected cycles.",
    epilog="\b\nExample: wlplan train psi-low --data data.zarr --out my-psi-low",
)
@click.argument("model", metavar="MODEL", type=click.Choice((*_MODELS, _ALL)))
@with_options(
    click.option(
        "--data",
        metavar="DATA.zarr",
        required=True,
        multiple=True,
        help="Data set to train on; may be given several times. With MODEL all: one, which is "
        "collected if it is missing.",
    ),
    click.option(
        "--out",
        metavar="DIR",
        required=True,
        help="Folder to write to. With MODEL all: one folder for all models.",
    ),
    *training_options(),
)
def train(
    model: str, data: tuple[str, ...], out: str, seed: int, as_json: bool, **options: Any
) -> None:
    """Train MODEL on a data set and report its errors on cycles that it has not seen.

    psi-low and psi-high predict the performance of a load, stall how likely it stalls. phi and
    phi-vae predict the pile after it, phi-vae as in the paper. all trains every model that ships,
    with the settings that it ships with: only --epochs and --seed can be changed.

    If interrupted, the same command continues where it stopped.
    """
    chosen = {name: value for name, value in options.items() if value is not None}
    kind = _MODELS.get(model)
    takes = {"epochs"} if kind is None else {field.name for field in fields(KINDS[kind])}
    for name in chosen:
        if name not in takes:
            option = name.replace("_", "-")
            raise InputError(f"--{option} does not go with {model}: leave it out.")
    if kind is None:
        checked_folder(out)
        if len(data) > 1:
            raise InputError(
                "with MODEL all, --data names one data set, beside which the others lie: give it "
                "once."
            )
        _train_all(data[0], out, epochs=chosen.get("epochs"), seed=seed, as_json=as_json)
        return
    settings = KINDS[kind](seed=seed, **chosen)
    for each in data:
        check_is_folder(each, "data set", "wlplan collect")
    checked_folder(out)

    from wlplan.dataset import open_dataset
    from wlplan.training import train as train_model

    dataset = [open_dataset(each) for each in data]
    with Progress() as progress, Stopwatch() as training:
        _, report = train_model(
            settings,
            dataset,
            out=out,
            progress=lambda done, total: progress("epochs", done, total, None),
        )
    if as_json:
        click.echo(json_text({"model": model, "out": out, "held_out": report.as_dict()}))
        return
    title = f"{model}, held-out part of {', '.join(data)}"
    _print_report(kind, title, report.as_dict())
    say(f"training {training.text()}")
    say(f"written: {out}")


def _print_report(kind: str, title: str, report: Mapping[str, Any]) -> None:
    """Errors of a model that was trained."""
    if kind in _PILE_STATE:
        print_pile_state(title, [("ours", report)])
    elif kind == _STALL:
        print_stalls(title, report)
    else:
        print_errors(title, report)


def _train_all(data: str, out: str, *, epochs: int | None, seed: int, as_json: bool) -> None:
    from wlplan.training import train_all

    stages = set()
    with Progress() as progress, Stopwatch() as work:

        def tell(stage: str, done: int, total: int) -> None:
            stages.add(stage)
            progress(stage, done, total, None)

        reports = train_all(data, out, seed=seed, epochs=epochs, progress=tell)
    if as_json:
        click.echo(json_text({"model": "all", "out": out, "held_out": reports}))
        return
    for kind, report in reports.items():
        title = f"{kind.replace('_', '-')}, held-out parts of {data} and those beside it"
        _print_report(kind, title, report)
    say(f"collecting and training {work.text()}")
    for trained, words in (
        (True, "written"),
        (False, "kept, since data, settings and versions are the same"),
    ):
        places = [str(Path(out) / kind) for kind in reports if (kind in stages) is trained]
        if places:
            say(f"{words}: {', '.join(places)}")


@click.command(
    short_help="Report the errors and the speed of a model.",
    epilog="\b\nExample: wlplan evaluate --data data.zarr --model my-psi-low",
)
@with_options(
    click.option("--data", metavar="DATA.zarr", required=True, help="Data set to compare with."),
    click.option(
        "--model", metavar="DIR", default=None, help="Model. Default: the psi-low that ships."
    ),
)
def evaluate(data: str, model: str | None, seed: int, as_json: bool) -> None:
    """Report the errors of a model on simulated cycles, and the time of an inference.

    Of the data set that the model was trained on, only the held-out part counts. The split belongs
    to the model, so --seed changes nothing. The tables also have the values that the paper
    reports of its own model, on data of its own simulator.
    """
    check_is_folder(data, "data set", "wlplan collect")
    if model is not None:
        check_is_folder(model, "model", "wlplan train")

    from wlplan.dataset import open_dataset
    from wlplan.models.storage import load_model, read_description
    from wlplan.training import held_out, shares_piles
    from wlplan.worlds.shipped import pretrained_path

    folder = pretrained_path("psi_low") if model is None else Path(model)
    description = read_description(folder, kind=None)
    predictor: Any = load_model(folder, description["kind"])
    dataset = open_dataset(data)
    part = held_out(dataset, description)
    # What was held out of its own data has piles that are new to it.
    if part is dataset and shares_piles(dataset, description):
        seed_of = dataset.attributes.get("seed")
        remark(
            f"{data} has seed {seed_of}, as a data set of the model's training: the model has seen "
            f"some of these piles, and its errors on them are smaller. Collect with another seed."
        )
    found = evaluated(predictor, part, description)
    kind = description["kind"].replace("_", "-")
    if as_json:
        click.echo(json_text({"model": kind, "data": data, **found}))
        return
    which = "held-out part" if len(part) < len(dataset) else "all cycles"
    title = f"{kind}, {which} of {data}"
    if description["kind"] in _PILE_STATE:
        without = found["errors"].get("without_blending")
        ways = {"edges blended": found["errors"], "as predicted": without}
        rows = {"ours": found["errors"]} if without is None else ways
        print_pile_state(title, list(rows.items()))
    elif description["kind"] == _STALL:
        print_stalls(title, found["errors"])
    else:
        print_errors(title, found["errors"], found["paper"]["mean_relative"])
    print_times(found["inference"], found["paper"].get("inference_s"))
