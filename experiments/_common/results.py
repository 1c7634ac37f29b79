"""What every result carries: how it was made, on what, with which versions."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import json
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

import wlplan
from experiments._common.places import RESULTS, add_places, folder_of, say
from wlplan.dataset import Dataset, collect, fingerprint, open_dataset
from wlplan.errors import InputError
from wlplan.io import write_bytes_atomic, write_text_atomic
from wlplan.xla import cores

# The data set of the experiments that need one: where it lies, and its cycles. Paper, section 6.2.
DATA = Path("out") / "cycles.zarr"
CYCLES, SMOKE_CYCLES = 10_800, 180
# The models that experiments train, see `experiments._common.models`.
MODELS = Path("out") / "models"
# The rows of those that go on where they were cut short, see `experiments._common.rows`.
ROWS = Path("out") / "rows"


def conditions() -> dict[str, Any]:
    """Device and versions."""
    device = jax.devices()[0]
    return {
        "device": f"{device.device_kind or device.platform}, {cores()} cores",
        "machine": platform.machine(),
        "python": platform.python_version(),
        "wlplan": wlplan.__version__,
        **{name: metadata.version(name) for name in ("jax", "jaxlib", "flax", "numpy")},
    }


def write_result(
    name: str,
    preset: str,
    result: dict[str, Any],
    folder: Path,
    *,
    seconds: float | None = None,
) -> Path:
    """Writes a result with its conditions as JSON.

    Args:
        name: Of the experiment.
        preset: Of the run.
        result: What it found.
        folder: Of results.
        seconds: How long the run took [s], if it ran in one go. Models that were there before are
            not in it.
    """
    took = {} if seconds is None else {"run_seconds": round(seconds, 1)}
    document = {
        "experiment": name,
        "command": f"python -m experiments.{name} --preset {preset}",
        "preset": preset,
        "conditions": conditions() | took,
        **result,
    }
    path = folder / f"{name}.json"
    # Lists of numbers in one line each: a result can be read, and compared with the one before.
    text = re.sub(
        r"\[\s+([^][{}]*?)\s+\]",
        lambda found: "[" + re.sub(r"\s+", " ", found[1]) + "]",
        json.dumps(document, indent=1),
    )
    write_text_atomic(path, text + "\n")
    return path


def add_data(parser: argparse.ArgumentParser) -> None:
    """The option that names the data set, for `data_of`."""
    parser.add_argument(
        "--data",
        type=Path,
        help=f"data set; collected if it is not there (default {DATA}, for smoke a new one)",
    )


def data_of(options: argparse.Namespace, folder: Path) -> Dataset:
    """The data set that the options name; if it is missing or not finished, it is collected first.

    Args:
        options: Of `add_data` and `add_places`.
        folder: Of results, where a short run has its own.

    Raises:
        InputError: If there is something else, or a part of a collection of other settings.
    """
    smoke = options.preset == "smoke"
    path = options.data or (folder / DATA.name if smoke else DATA)
    with contextlib.suppress(InputError):
        return open_dataset(path)
    count = SMOKE_CYCLES if smoke else CYCLES
    say(f"collecting {count} cycles in {path}")
    collect(path, cycles=count)
    return open_dataset(path)


def dataset_summary(data: Dataset) -> dict[str, Any]:
    """Which data set a result is of."""
    return {
        "cycles": len(data),
        "seed": data.attributes["seed"],
        "versions": data.attributes["versions"],
        "fingerprint": fingerprint(data),
    }


def main(name: str, run: Callable[..., dict[str, Any]], draw: Callable[[Path], None]) -> None:
    """Command line of an experiment: run and draw, or draw again what is there.

    Args:
        name: Name of its module.
        run: Function of the preset to the result; of a data set, of the folder of trained models,
            of the file of rows and of the folder of results too if it has parameters `data`,
            `models`, `rows` and `out`.
        draw: Draws the result that lies in a folder there.
    """
    needs = inspect.signature(run).parameters
    parser = argparse.ArgumentParser(prog=f"python -m experiments.{name}")
    add_places(parser)
    if "data" in needs:
        add_data(parser)
    if "models" in needs:
        parser.add_argument(
            "--models",
            type=Path,
            help=f"trained models; missing ones are trained (default {MODELS}, for smoke new ones)",
        )
    options = parser.parse_args()
    try:
        folder = folder_of(options)
        if options.draw:
            redraw(name, draw, folder)
        else:
            _run(name, run, options, folder, set(needs))
            say(f"{name}: drawing")
            draw(folder)
    except InputError as error:
        say(f"error: {error}")
        raise SystemExit(2) from error
    say(f"{name}: done, see {folder}")


def _run(
    name: str,
    run: Callable[..., dict[str, Any]],
    options: argparse.Namespace,
    folder: Path,
    needs: set[str],
) -> None:
    """Gives `run` what it needs, and writes what it returns."""
    smoke = options.preset == "smoke"
    say(f"{name}: running, preset {options.preset}; the result goes to {folder}")
    more: dict[str, Any] = {}
    if "out" in needs:
        more["out"] = folder
    if "rows" in needs:
        more["rows"] = (folder if smoke else ROWS) / f"{name}.jsonl"
    if "models" in needs:
        more["models"] = options.models or (folder / MODELS.name if smoke else MODELS)
    if "data" in needs:
        more["data"] = data_of(options, folder)
    goes_on = "rows" in more and more["rows"].exists()
    start = time.perf_counter()
    result = run(options.preset, **more)
    # What was made before the run was cut short took its time, too.
    seconds = None if goes_on else time.perf_counter() - start
    write_result(name, options.preset, result, folder, seconds=seconds)


def redraw(name: str, draw: Callable[[Path], None], folder: Path) -> None:
    """Draws a result again, that in a folder or, if there is none, the committed one.

    Args:
        name: Of the experiment.
        draw: Draws the result that lies in a folder there.
        folder: Where pictures go.

    Raises:
        InputError: If neither is there.
    """
    places = [place for place in (folder, RESULTS) if (place / f"{name}.json").is_file()]
    if not places:
        raise InputError(f"There is no {name}.json in {folder} to draw: run it without --draw.")
    say(f"{name}: drawing {places[0] / name}.json into {folder}")
    # Drawn aside, so that nothing of the committed result lies in a folder of another run.
    with tempfile.TemporaryDirectory() as aside:
        shutil.copy(places[0] / f"{name}.json", aside)
        draw(Path(aside))
        for picture in sorted(Path(aside).glob("*.png")):
            write_bytes_atomic(folder / picture.name, picture.read_bytes())
