"""The package's figures on the machine it runs on, beside those to beat and to reach."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from wlplan.errors import InputError
from wlplan.studies.bench.items import ITEMS
from wlplan.studies.bench.setup import Item, Measured, Setup
from wlplan.xla import cores

BENCH_FORMAT = "wlplan.bench/1"

_PACKAGES = ("wlplan", "jax", "jaxlib", "numpy", "numba", "aeolis")


def run_bench(
    names: Sequence[str] = (),
    *,
    quick: bool = False,
    seed: int = 0,
    progress: Callable[[str, int, int, float | None], None] | None = None,
) -> dict[str, Any]:
    """Measures on this machine what the package is measured by.

    Args:
        names: Items to measure, of `ITEMS`; none: all.
        quick: Fewer cases and repeats, and no plans of many loads.
        seed: Seed of piles, poses and actions.
        progress: `progress(item, done, total, None)`, called before each item.

    Returns:
        What goes into bench.json: device, versions, and for every item compile time [s], run time
        [s], further figures, target, reference, and whether the target was met; null where nothing
        was measured, and then `note` says why.

    Raises:
        InputError: If a name is unknown.
    """
    unknown = [name for name in names if name not in ITEMS]
    if unknown:
        raise InputError(f"unknown item {unknown[0]!r}: choose one of {', '.join(ITEMS)}.")
    setup = Setup(seed=seed, quick=quick)
    items = [item for item in ITEMS.values() if not names or item.name in names]
    records = []
    for done, item in enumerate(items):
        if progress is not None:
            progress(item.name, done, len(items), None)
        left_out = quick and item.long
        measured = Measured(note="left out by --quick") if left_out else item.measure(setup)
        records.append(_record(item, measured))
    return {
        "format": BENCH_FORMAT,
        "device": device(),
        "versions": _versions(),
        "quick": quick,
        "seed": seed,
        "items": records,
    }


def _record(item: Item, measured: Measured) -> dict[str, Any]:
    run = measured.run
    return {
        "name": item.name,
        "group": item.group,
        "title": item.title,
        "compile": measured.compile,
        "run": None
        if run is None
        else {"median": run.median, "p10": run.low, "p90": run.high, "repeats": run.repeats},
        "figures": dict(measured.figures),
        "target": item.target or None,
        "met": item.met(measured),
        "reference": item.reference or None,
        "note": measured.note or None,
    }


def device() -> dict[str, Any]:
    """What the figures were measured on: JAX's device, the processor, and its cores."""
    accelerator = jax.devices()[0]
    return {
        "platform": accelerator.platform,
        "kind": accelerator.device_kind,
        "processor": _processor(),
        "cores": cores(),
    }


def _processor() -> str:
    """Name of the processor, where the system tells (Linux); else its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
