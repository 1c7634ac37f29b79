"""The engine's own process: a job comes as an .npz file, its result goes to another.

Run by `wlplan.engines.dem.process`; by hand: `python -m wlplan.engines.dem.worker JOB.npz OUT.npz`.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wlplan.engines.dem.grains import DemSettings, Grains
from wlplan.engines.dem.packing import Bed, Walls
from wlplan.errors import InputError
from wlplan.site.machine import WheelLoader
from wlplan.site.soil import Soil

VERSION = 1
"""Grows with every change that makes other results of the same job."""


def settings_from(fields: dict[str, Any]) -> DemSettings:
    """The inverse of `dataclasses.asdict` for settings."""
    return DemSettings(**{**fields, "grains": Grains(**fields["grains"])})


def load_bed(path: str | Path) -> Bed:
    """A bed from its file."""
    with np.load(path, allow_pickle=False) as stored:
        return Bed(
            centre=stored["centre"].astype(np.float64),
            radius=stored["radius"].astype(np.float64),
            lengths=stored["lengths"],
            packing=float(stored["packing"]),
        )


def run(job: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Does a job.

    Args:
        job: Its "kind", "bed" or "cycle", its "settings", and for a cycle "machine", "soil",
            "walls" and the path of the "bed": fields of the classes of these names.
        arrays: For a cycle "surface" [m] and "action".

    Returns:
        Arrays by name: the fields of `Bed` or of `CycleRecord`.
    """
    settings = settings_from(job["settings"])
    keep: type[np.floating[Any]]
    if job["kind"] == "bed":
        from wlplan.engines.dem.bed import make_bed

        made: Any = make_bed(settings.grains, settings.time_step(np.inf))
        keep = np.float64
    else:
        from wlplan.engines.dem.cycle import play_cycle

        made = play_cycle(
            load_bed(job["bed"]),
            arrays["surface"].astype(np.float64),
            arrays["action"].astype(np.float64),
            machine=WheelLoader(**job["machine"]),
            soil=Soil(**job["soil"]),
            settings=settings,
            walls=Walls(**job["walls"]),
        )
        # Maps and records of single precision take half the space.
        keep = np.float32
    values = {
        field.name: np.asarray(getattr(made, field.name)) for field in dataclasses.fields(made)
    }
    return {name: value.astype(keep) if value.ndim else value for name, value in values.items()}


def main(arguments: Sequence[str]) -> int:
    """Reads a job, does it, and writes the result.

    Args:
        arguments: Paths of the job and of the result.

    Returns:
        Exit code: 0 done, 2 what is wrong stands on stderr in one line.
    """
    source, target = arguments
    try:
        with np.load(source, allow_pickle=False) as stored:
            job = json.loads(str(stored["job"]))
            arrays = {name: stored[name] for name in stored if name != "job"}
        result = run(job, arrays)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    np.savez_compressed(target, allow_pickle=False, **result)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
