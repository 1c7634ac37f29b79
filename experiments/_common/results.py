"""What every result carries: how it was made, on what, with which versions."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import json
import platform
import re
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

import wlplan
from wlplan.dataset import Dataset, collect, fingerprint, open_dataset
from wlplan.errors import InputError
from wlplan.io import write_text_atomic
from wlplan.xla import cores

RESULTS = Path(__file__).parents[1] / "results"
PRESETS = ("full", "smoke")
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


def write_result(name: str, preset: str, result: dict[str, Any], folder: Path) -> Path:
    """Writes a result with its conditions as JSON."""
    document = {
        "experiment": name,
        "command": f"python -m experiments.{name} --preset {preset}",
        "preset": preset,
        "conditions": conditions(),
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


def open_or_collect(path: Path, preset: str) -> Dataset:
    """The data set at a path; if it is missing or not finished, it is collected first.

    Raises:
        InputError: If there is something else, or a part of a collection of other settings.
    """
    with contextlib.suppress(InputError):
        return open_dataset(path)
    count = SMOKE_CYCLES if preset == "smoke" else CYCLES
    print(f"collecting {count} cycles in {path}", file=sys.stderr)
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
    needs_data = "data" in needs
    parser = argparse.ArgumentParser(prog=f"python -m experiments.{name}")
    parser.add_argument("--preset", choices=PRESETS, default="full")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of results")
    parser.add_argument("--draw", action="store_true", help="only draw what is there")
    if needs_data:
        parser.add_argument(
            "--data",
            type=Path,
            help=f"data set; collected if it is not there (default {DATA}, for smoke a new one)",
        )
    if "models" in needs:
        parser.add_argument(
            "--models",
            type=Path,
            help=f"trained models; missing ones are trained (default {MODELS}, for smoke new ones)",
        )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.draw:
        more: dict[str, Any] = {}
        smoke = options.preset == "smoke"
        if "out" in needs:
            more["out"] = options.out
        if "rows" in needs:
            more["rows"] = (options.out if smoke else ROWS) / f"{name}.jsonl"
        if "models" in needs:
            more["models"] = options.models or (options.out / MODELS.name if smoke else MODELS)
        if needs_data:
            path = options.data or (options.out / DATA.name if smoke else DATA)
            try:
                more["data"] = open_or_collect(path, options.preset)
            except InputError as error:
                print(f"error: {error}", file=sys.stderr)
                raise SystemExit(2) from error
        write_result(name, options.preset, run(options.preset, **more), options.out)
    draw(options.out)
