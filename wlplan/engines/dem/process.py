"""The process boundary: jobs for the engine's own process, and what it has answered before.

A result is kept in the user's cache under a name that is a digest of its job. So the bed is made
once, and a sequence of loadings that was interrupted continues where it was: the engine has no
randomness, and what was played is read, not played again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wlplan.engines.dem.cycle import CycleRecord
from wlplan.engines.dem.grains import DemSettings
from wlplan.engines.dem.packing import Walls
from wlplan.engines.dem.worker import VERSION
from wlplan.errors import InputError, one_line
from wlplan.io.files import write_bytes_atomic
from wlplan.site.machine import WheelLoader
from wlplan.site.soil import Soil

INTERPRETER = "WLPLAN_DEM_PYTHON"
"""Environment variable: a Python with LAMMPS, instead of the one that runs."""
CACHE = "WLPLAN_CACHE"
"""Environment variable: folder of the cache, instead of the user's."""

# The worker takes this very package, and all else from its own Python: another one may have another
# version of it, and has other compiled modules than those beside it here. What `wlplan/__init__.py`
# needs may be missing there, so that is not run.
_PACKAGE = Path(__file__).parents[2]
_WORKER = f"""
import sys
from importlib.util import module_from_spec, spec_from_file_location
spec = spec_from_file_location(
    "wlplan", {str(_PACKAGE / "__init__.py")!r}, submodule_search_locations=[{str(_PACKAGE)!r}]
)
sys.modules["wlplan"] = module_from_spec(spec)
from wlplan.engines.dem.worker import main
sys.exit(main(sys.argv[1:]))
"""
# Surfaces are rounded to this [m], so that rounding errors do not make another job of the same.
_ROUNDED = 1e-4


def cache_folder() -> Path:
    """Folder of the results, made if it is missing.

    Raises:
        InputError: If it cannot be made.
    """
    given = os.environ.get(CACHE)
    if given:
        folder = Path(given)
    else:
        base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
        folder = Path(base) / "wlplan" / "dem"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        reason = one_line(error.strerror or error)
        raise InputError(
            f"{folder}: the cache cannot be made ({reason}): set {CACHE} to another folder."
        ) from error
    return folder


def play(
    surface: np.ndarray,
    action: np.ndarray,
    *,
    machine: WheelLoader,
    soil: Soil,
    settings: DemSettings,
    walls: Walls = Walls(),  # noqa: B008 (frozen)
) -> CycleRecord:
    """Plays one cycle in the engine, or reads it if it was played before.

    Args:
        surface: Height of the soil over a level floor on a grid of `columns` [m], see
            `cycle.play_cycle`.
        action: delta_bm, k_bm, delta_bk, k_bk.
        machine: What digs.
        soil: What is dug.
        settings: Of the engine.
        walls: Where the domain ends.

    Raises:
        InputError: If the engine is missing, was killed, or takes too long.
    """
    rounded = np.round(np.asarray(surface, np.float64) / _ROUNDED).astype(np.int32)
    numbers = np.asarray(action, np.float64).round(6)
    # Seconds do not change what comes out.
    lasting = dataclasses.replace(settings, timeout=0.0)
    identity = {
        "kind": "cycle",
        "version": VERSION,
        "settings": dataclasses.asdict(lasting),
        "machine": dataclasses.asdict(machine),
        "soil": {"density": soil.density, "steel_friction": soil.steel_friction},
        "walls": dataclasses.asdict(walls),
    }
    target = cache_folder() / f"cycle-{_digest(identity, rounded, numbers)}.npz"
    arrays = _stored(target, _fields(CycleRecord))
    if arrays is None:
        job = {**identity, "soil": dataclasses.asdict(soil), "bed": str(bed_file(settings))}
        arrays = run_job(
            job, {"surface": rounded * _ROUNDED, "action": numbers}, timeout=settings.timeout
        )
        _keep(target, arrays, _fields(CycleRecord))
    return CycleRecord(**{name: _plain(arrays[name]) for name in _fields(CycleRecord)})


def bed_file(settings: DemSettings) -> Path:
    """The file of the bed that piles are cut from, made if it is missing, with a note on stderr.

    Args:
        settings: Of the engine; only the grains matter.

    Raises:
        InputError: As of `play`.
    """
    grains = dataclasses.asdict(settings.grains)
    target = cache_folder() / f"bed-{_digest({'version': VERSION, 'grains': grains})}.npz"
    names = ("centre", "radius", "lengths", "packing")
    if _stored(target, names) is None:
        sys.stderr.write("note: settling a bed of spheres, once: about two minutes\n")
        made = run_job(
            {"kind": "bed", "settings": dataclasses.asdict(settings)}, {}, timeout=settings.timeout
        )
        _keep(target, made, names)
    return target


def run_job(
    job: dict[str, Any],
    arrays: dict[str, np.ndarray],
    *,
    timeout: float,
    command: Sequence[str] | None = None,
) -> dict[str, np.ndarray]:
    """Has the worker do one job.

    Args:
        job: As of `worker.run`; JSON types.
        arrays: Likewise.
        timeout: Longest wall-clock time [s].
        command: Words that start the worker, to which the paths of job and result are added.

    Returns:
        Arrays of the result by name.

    Raises:
        InputError: If the engine is missing, the worker was killed, failed or took too long, or its
            result cannot be read. Nothing of it is left.
    """
    interpreter = os.environ.get(INTERPRETER) or sys.executable
    words = [interpreter, "-P", "-c", _WORKER] if command is None else list(command)
    # One thread: the result must not depend on how many cores there are.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory(prefix="wlplan-") as folder:
        source, target = Path(folder) / "job.npz", Path(folder) / "result.npz"
        np.savez_compressed(source, allow_pickle=False, job=json.dumps(job), **arrays)
        try:
            # Whatever ends this block, an interrupt too, ends the worker.
            done = subprocess.run(
                [*words, str(source), str(target)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env=environment,
                timeout=timeout,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise InputError(
                f"the discrete-element engine took longer than {timeout:g} s and was stopped: "
                f"give it an idle core, or more time by `DemSettings(timeout=...)`."
            ) from error
        except OSError as error:
            reason = one_line(error.strerror or error)
            raise InputError(
                f"{words[0]}: cannot be started ({reason}): check {INTERPRETER}."
            ) from error
        if done.returncode != 0:
            raise InputError(_complaint(done.returncode, done.stderr.decode(errors="replace")))
        try:
            return _read(target)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(
                f"the discrete-element engine left no readable result ({one_line(error)}): check "
                f"the free space of {tempfile.gettempdir()} and run it again."
            ) from error


def _complaint(code: int, said: str) -> str:
    """What to report of a worker that failed."""
    lines = [line for line in said.splitlines() if line.strip()]
    last = lines[-1] if lines else "it said nothing"
    if code == 2 and last.startswith("error: "):
        return last.removeprefix("error: ")
    if code < 0:
        with contextlib.suppress(ValueError):
            name = signal.Signals(-code).name
            hint = ": out of memory?" if name == "SIGKILL" else "."
            return f"the discrete-element engine was killed by {name}{hint} Run it again."
    return f"the discrete-element engine failed (exit code {code}: {one_line(last)})."


def _digest(identity: dict[str, Any], *arrays: np.ndarray) -> str:
    found = hashlib.sha256(json.dumps(identity, sort_keys=True).encode())
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:32]


def _fields(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


def _stored(path: Path, names: Sequence[str]) -> dict[str, np.ndarray] | None:
    """A result that was kept; None if there is none, or it cannot be used."""
    try:
        stored = _read(path)
        return {name: stored[name] for name in names}
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def _read(path: Path) -> dict[str, np.ndarray]:
    # From memory: NumPy leaves a file open that turns out not to be whole.
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
        return {name: stored[name] for name in stored}


def _keep(path: Path, arrays: dict[str, np.ndarray], names: Sequence[str]) -> None:
    missing = [name for name in names if name not in arrays]
    if missing:
        raise InputError(
            f"the result of the discrete-element engine lacks {', '.join(missing)}: install "
            f"wlplan anew."
        )
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **{name: arrays[name] for name in names})
    write_bytes_atomic(path, content.getvalue())


def _plain(value: np.ndarray) -> Any:
    """A number or a text as such; anything longer as the array it is."""
    return value.item() if value.ndim == 0 else value
