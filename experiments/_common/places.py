"""Where results go, and what an experiment says while it runs: no JAX is needed to know it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from wlplan.errors import InputError

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"
"""The results that are committed; written with `--update` alone."""
OUT = Path("out") / "experiments"
"""Where results go otherwise, in a folder for each preset."""
PRESETS = ("full", "smoke")


def say(text: str) -> None:
    """One line on stderr: what is done now."""
    print(text, file=sys.stderr, flush=True)


def add_places(parser: argparse.ArgumentParser) -> None:
    """The options that all experiments have: how much is run, and where results go."""
    parser.add_argument("--preset", choices=PRESETS, default="full")
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--out", type=Path, help=f"folder of results (default {OUT}/PRESET)")
    place.add_argument(
        "--update", action="store_true", help="write to experiments/results, which is committed"
    )
    parser.add_argument(
        "--draw",
        action="store_true",
        help="only draw: the result in the folder, or the committed one if there is none",
    )


def folder_of(options: argparse.Namespace) -> Path:
    """The folder that results go to, by the options of `add_places`; it is made.

    Raises:
        InputError: If a short run were to replace results of the full preset, or there is a file
            of that name.
    """
    if options.update and options.preset != "full":
        raise InputError(
            f"--update replaces results of the full preset, and this is {options.preset!r}: "
            "leave one of the two out."
        )
    folder: Path = RESULTS if options.update else options.out or OUT / options.preset
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be the folder of results: {error.strerror}.") from error
    return folder
