"""What every result carries: how it was made, on what, with which versions."""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from wlplan.compilation import cores
from wlplan.io import write_text_atomic

RESULTS = Path(__file__).parent / "results"
PRESETS = ("full", "smoke")


def conditions() -> dict[str, Any]:
    """Device and versions."""
    device = jax.devices()[0]
    return {
        "device": f"{device.device_kind or device.platform}, {cores()} cores",
        "machine": platform.machine(),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in ("wlplan", "jax", "jaxlib", "flax", "numpy")},
    }


def write(name: str, preset: str, result: dict[str, Any], folder: Path) -> Path:
    """Writes a result with its conditions as JSON."""
    document = {
        "experiment": name,
        "command": f"python -m experiments.{name} --preset {preset}",
        "preset": preset,
        "conditions": conditions(),
        **result,
    }
    path = folder / f"{name}.json"
    write_text_atomic(path, json.dumps(document, indent=1) + "\n")
    return path


def main(name: str, run: Callable[[str], dict[str, Any]], draw: Callable[[Path], None]) -> None:
    """Command line of an experiment: run and draw, or draw again what is there."""
    parser = argparse.ArgumentParser(prog=f"python -m experiments.{name}")
    parser.add_argument("--preset", choices=PRESETS, default="full")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of results")
    parser.add_argument("--draw", action="store_true", help="only draw what is there")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.draw:
        write(name, options.preset, run(options.preset), options.out)
    draw(options.out)
