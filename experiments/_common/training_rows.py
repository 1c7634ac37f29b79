"""Trainings as rows: errors, times and size of performance predictors, without their weights.

The rows are committed beside the result that they come to: so a new machine goes on where the last
one ended.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import hashlib
import json
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
import numpy as np
from flax import nnx

from experiments._common.places import RESULTS, add_places, folder_of, say
from experiments._common.results import add_data, data_of, redraw, write_result
from experiments._common.row_files import (
    RowFiles,
    add_row_options,
    matching,
    part_of,
    time_is_up,
)
from wlplan import training
from wlplan.dataset import Dataset, fingerprint
from wlplan.errors import InputError
from wlplan.io import write_text_atomic
from wlplan.io.provenance import versions
from wlplan.models.storage import read_description
from wlplan.studies.bench.inference import performance_times
from wlplan.training import held_out
from wlplan.training.settings import PerformanceSettings


class Training(Protocol):
    """One training of an experiment."""

    @property
    def name(self) -> str:
        """As file names have it."""

    @property
    def settings(self) -> PerformanceSettings:
        """How it is trained."""


AnyTraining = TypeVar("AnyTraining", bound=Training)


# Attributes of a data set that its cycles do not hang on.
_NOT_OF_THE_CYCLES = ("format", "title", "command", "versions", "cycles_done")


def recipe(data: Dataset) -> str:
    """A hash of what the cycles of a data set were made from.

    Not of the cycles themselves: between processors they differ in the last digits, which no
    training tells.
    """
    attributes = {k: v for k, v in data.attributes.items() if k not in _NOT_OF_THE_CYCLES}
    text = json.dumps({**attributes, "cycles": len(data)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def made_with(settings: PerformanceSettings, data: Dataset) -> dict[str, Any]:
    """What the row of a training hangs on.

    Args:
        settings: How it is trained.
        data: Data set to train on.
    """
    return {"settings": settings.as_dict(), "recipe": recipe(data), "versions": versions()}


# Options of `mallopt` of the C library of GNU.
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4


def keep_memory() -> None:
    """Has the process keep memory that is freed, where the C library can be told.

    A step of the paper's ψ_high needs 60 MB that the one before it gave back: without this it
    takes 41 ms instead of 22 to have its pages made anew (one core of an Intel Xeon).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def train_row(settings: PerformanceSettings, data: Dataset, place: Path) -> dict[str, Any]:
    """Trains a performance predictor and reports on it.

    Cut short, the same call goes on where it was.

    Args:
        settings: How it is trained.
        data: Data set to train on.
        place: Where the model lies until the row is made.

    Returns:
        Errors, what the training came to, and times: of the training those of the processor, so
        that other work beside it does not count; of inferences those of the clock.
    """
    clock = [time.process_time()]
    place.parent.mkdir(parents=True, exist_ok=True)
    model, report = training.train(
        settings, data, out=place, progress=lambda *_: clock.append(time.process_time())
    )
    description = read_description(place, settings.kind)
    record = description["training"]
    # The first epoch of a process has the compiling in it.
    epochs = np.diff(clock)[1:]
    one, batch = performance_times(model, held_out(data, description))
    row = {
        "parameters": parameters(model),
        "cycles": record["cycles"],
        "mean_relative": report.as_dict()["every"]["mean_relative"],
        "epochs": record["epochs"],
        "best_epoch": record["best_epoch"],
        "validation_loss": record["best_validation_loss"],
        "training_loss": record["last_training_loss"],
        "epoch_s": float(np.median(epochs)) if len(epochs) else None,
        # Not known if it did not run in one go.
        "training_s": clock[-1] - clock[0] if len(clock) == record["epochs"] + 1 else None,
        "inference_s": one.call.median,
        "inference_of_a_batch_s": batch.each,
        "dataset": fingerprint(data),
    }
    shutil.rmtree(place)
    # Each training has programs of its own, which would add up.
    jax.clear_caches()
    return row


def parameters(model: Any) -> int:
    """Number of the weights that are trained."""
    network = nnx.merge(model.graph, model.params)
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(network, nnx.Param)))


def main(
    name: str,
    trainings: Callable[[str], Sequence[AnyTraining]],
    run: Callable[[str, Dataset, dict[str, dict[str, Any]]], dict[str, Any]],
    draw: Callable[[Path], None],
    *,
    first: Callable[[AnyTraining], bool] = lambda _: True,
) -> None:
    """Command line of an experiment whose rows are trainings: train, join what is there, draw.

    Args:
        name: Name of its module.
        trainings: All trainings of a preset, in the order in which they are made.
        run: Function of the preset, the data set and the rows, by name, to the result.
        draw: Draws the result that lies in a folder there.
        first: Which of them are made without `--whole`.
    """
    parser = argparse.ArgumentParser(prog=f"python -m experiments.{name}")
    add_places(parser)
    add_data(parser)
    add_row_options(parser, Path("out") / name)
    parser.add_argument(
        "--whole", action="store_true", help="make all rows, and not only those that come first"
    )
    options = parser.parse_args()
    try:
        folder = folder_of(options)
        if options.draw:
            redraw(name, draw, folder)
            return
        smoke = options.preset == "smoke"
        rows = RowFiles(options.rows or (folder / name if smoke else Path("out") / name))
        say(f"{name}: rows in {rows.folder}; the result goes to {folder}")
        # Parts that are started together find the data that the first of them collects.
        with rows.alone("data set"):
            data = data_of(options, folder)
        committed = RESULTS / _kept(name)
        if not smoke and committed.exists():
            rows.lay(json.loads(committed.read_text()))
        every = trainings(options.preset)
        if not options.join:
            keep_memory()
            todo = [one for one in every if options.whole or smoke or first(one)]
            mine = part_of(matching(todo, options.only), options.shard)
            _make(mine, rows, data, time_is_up(options))
        found = {one.name: rows.read(one.name, made_with(one.settings, data)) for one in every}
        there = {key: row for key, row in found.items() if row is not None}
        lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(row)}" for key, row in there.items())
        write_text_atomic(folder / _kept(name), f"{{{lines}}}\n")
        write_result(name, options.preset, run(options.preset, data, there), folder)
        draw(folder)
    except InputError as error:
        say(f"error: {error}")
        raise SystemExit(2) from error
    say(f"{name}: done, see {folder / name}.json and .png")


def _kept(name: str) -> str:
    """File of the rows of an experiment, beside its result."""
    return f"{name}_rows.json"


def _make(
    todo: Sequence[Training],
    rows: RowFiles,
    data: Dataset,
    is_up: Callable[[], bool],
) -> None:
    """Makes the rows that are not there yet."""
    for number, one in enumerate(todo, 1):
        if is_up():
            return
        settings, place = one.settings, rows.folder / ".models" / one.name
        say(f"{number} of {len(todo)}: {one.name}")
        rows.get(
            one.name, made_with(settings, data), functools.partial(train_row, settings, data, place)
        )
