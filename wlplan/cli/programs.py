"""Compiled programs, kept from one run of the command line to the next.

JAX can load again what it compiled before, and `wlplan.traced` what was traced. On CPUs JAX does
not look closely whether what it loads is right for the processor and for the XLA at hand: a program
that is not ends the process. So the programs lie in a folder of the user's alone, one for each
processor and each set of versions, and are dropped if a process that used them did not come to its
end.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import click

from wlplan.io.files import replace_file

VARIABLE = "WLPLAN_CACHE"
"""Of the environment: where programs are kept, or "off"."""

_MAKERS = ("wlplan", "jax", "jaxlib", "flax", "optax", "numpy")
# Most that is kept [byte], and for how long what is not used [s].
_MOST, _LONGEST = 512 * 2**20, 60 * 24 * 3600.0
# So often in a row a process may be cut short before nothing is loaded any more.
_PATIENCE = 3
# Programs that are compiled faster than this are not kept [s].
_QUICK = 0.05
# Versions of jaxlib that know the flag of `compile_fast`.
_TRIED = ((0, 8), (0, 10))
# Before this XLA may overflow its stack as it loads a large program on a Mac.
_ON_A_MAC = (0, 10)

# Of the files of JAX, and of `wlplan.traced`, which cannot be imported before JAX is set up.
_ENDINGS = ("-cache", ".stablehlo")
_TRACES = "WLPLAN_TRACES"

_KEY, _FAULTS, _RUNNING, _TIMES = "made_with.json", "cut_short", "running", "times.json"


@dataclasses.dataclass(frozen=True)
class Cache:
    """Where programs are kept.

    Attributes:
        folder: Of the programs of this processor and these versions; None: nothing is kept.
        reason: Why not.
    """

    folder: Path | None
    reason: str = ""

    def programs(self) -> list[Path]:
        """The files of the programs, compiled and traced."""
        if self.folder is None or not self.folder.is_dir():
            return []
        return sorted(path for path in self.folder.iterdir() if path.name.endswith(_ENDINGS))

    def seconds(self, what: str) -> float | None:
        """How long something took to compile when it last did [s]; None if that is not known."""
        if self.folder is None:
            return None
        known = _read_json(self.folder / _TIMES).get(what)
        return float(known) if isinstance(known, int | float) else None

    def remember(self, what: str, seconds: float) -> None:
        """Keeps how long something took to compile [s]."""
        if self.folder is not None:
            known = _read_json(self.folder / _TIMES) | {what: round(seconds, 1)}
            with contextlib.suppress(OSError):
                replace_file(self.folder / _TIMES, json.dumps(known).encode())


def cache_of_command() -> Cache:
    """What the present command uses; one that keeps nothing outside of a command."""
    context = click.get_current_context(silent=True)
    found = None if context is None else context.find_object(Cache)
    return Cache(None, "this is no command") if found is None else found


def root() -> Path:
    """The folder of all that is kept, there or not."""
    asked = os.environ.get(VARIABLE, "")
    if asked and asked != "off":
        return Path(asked)
    from platformdirs import user_cache_path

    return user_cache_path("wlplan", appauthor=False) / "programs"


def made_with() -> dict[str, str]:
    """What compiled programs hang on: processor, versions, settings of XLA."""
    versions = {name: _version(name) for name in _MAKERS}
    flags = {name: os.environ.get(name, "") for name in ("XLA_FLAGS", "JAX_PLATFORMS")}
    library = hashlib.sha256()
    # Versions may be those of a package that was replaced in place: the library itself is not.
    spec = importlib.util.find_spec("jaxlib")
    for place in (spec.submodule_search_locations if spec else None) or ():
        for path in sorted(Path(place).glob("*")):
            if path.suffix in (".so", ".pyd", ".dylib"):
                known = path.stat()
                library.update(f"{path.name} {known.st_size} {known.st_mtime_ns}\n".encode())
    return {
        "processor": _processor(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
        **flags,
        "library": library.hexdigest()[:16],
    }


def cache() -> Cache:
    """Where programs of this processor and these versions are, without a change to anything."""
    if os.environ.get(VARIABLE) == "off":
        return Cache(None, f"{VARIABLE} is off")
    # Which is ours in a process that one of ours has started.
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if given and Path(given).parent != root():
        return Cache(None, "JAX has a cache of its own, JAX_COMPILATION_CACHE_DIR")
    if os.environ.get("JAX_ENABLE_COMPILATION_CACHE", "true").lower() in ("0", "false"):
        return Cache(None, "JAX_ENABLE_COMPILATION_CACHE is off")
    key = made_with()
    if sys.platform == "darwin" and _numbers(key["jaxlib"]) < _ON_A_MAC:
        return Cache(None, "jaxlib before 0.10 may crash as it loads programs on a Mac")
    name = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:20]
    folder = root() / name
    if _faults(folder) >= _PATIENCE:
        return Cache(None, "the last runs that loaded programs were cut short")
    return Cache(folder)


def compile_fast() -> None:
    """Has XLA compile in less time, if nobody has set its flags.

    A first plan of ten loads takes 44 s instead of 67, the next load as long as before (0.2 s), on
    two cores of an AMD EPYC; results differ by rounding. XLA ends the process at a flag that it
    does not know, so only versions that were tried are told.
    """
    tried = _numbers(_version("jaxlib"))[:2]
    if not os.environ.get("XLA_FLAGS") and _TRIED[0] <= tried <= _TRIED[1]:
        os.environ["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"


def use_cache() -> Cache:
    """Has JAX load and keep programs, if it is not imported yet.

    It never fails: where programs cannot be kept they are compiled.
    """
    try:
        found = cache()
        if found.folder is None:
            return found
        return _used(found.folder)
    except (OSError, NotImplementedError) as error:
        # The second: some file systems know no locks.
        return Cache(None, f"{root()}: {getattr(error, 'strerror', None) or error}")


def clear() -> int:
    """Removes all that is kept; programs of other versions too.

    Returns:
        How many files went.

    Raises:
        OSError: If something cannot be removed.
    """
    gone = 0
    for folder in _folders():
        gone += sum(1 for path in folder.rglob("*") if path.is_file())
        shutil.rmtree(folder)
    return gone


def _used(folder: Path) -> Cache:
    import filelock

    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    # What lies there is run.
    if hasattr(os, "geteuid"):
        known = folder.stat()
        if known.st_uid != os.geteuid() or known.st_mode & 0o022:
            return Cache(None, f"{folder} can be written by others")
    running = folder / _RUNNING
    running.mkdir(exist_ok=True, mode=0o700)
    if cut_short := sum(map(_is_left_over, running.iterdir())):
        replace_file(folder / _FAULTS, str(_faults(folder) + cut_short).encode())
        _drop(folder)
    key = made_with()
    if _read_json(folder / _KEY) != key:
        _drop(folder)
        replace_file(folder / _KEY, json.dumps(key, indent=1).encode())
    if _faults(folder) >= _PATIENCE:
        return Cache(None, "the last runs that loaded programs were cut short")
    _prune()
    mark = filelock.FileLock(running / f"{os.getpid()}-{time.time_ns():x}")
    mark.acquire(timeout=0)
    _ends.append(functools.partial(_at_the_end, folder, mark, os.getpid()))
    atexit.register(end)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = os.environ[_TRACES] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(_QUICK))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    return Cache(folder)


# What is done as this process comes to its end.
_ends: list[Callable[[], None]] = []


def end() -> None:
    """Says that this process came to its end; for one that ends without telling Python."""
    while _ends:
        _ends.pop()()


def _at_the_end(folder: Path, mark: object, process: int) -> None:
    """This process came to its end, so what it loaded was right."""
    if os.getpid() != process:
        return
    with contextlib.suppress(OSError):
        (folder / _FAULTS).unlink(missing_ok=True)
        mark.release()  # type: ignore[attr-defined]
        Path(mark.lock_file).unlink(missing_ok=True)  # type: ignore[attr-defined]


def _is_left_over(path: Path) -> bool:
    """Whether the process of a mark is gone, and its mark is not; the mark is removed."""
    import filelock

    lock = filelock.FileLock(path)
    try:
        lock.acquire(timeout=0)
    except (filelock.Timeout, OSError):
        return False
    lock.release()
    path.unlink(missing_ok=True)
    return True


def _drop(folder: Path) -> None:
    for path in Cache(folder).programs():
        path.unlink(missing_ok=True)


def _prune() -> None:
    """What was not used for long goes, and then the oldest, until the rest is small enough."""
    files = []
    for folder in _folders():
        for path in Cache(folder).programs():
            with contextlib.suppress(FileNotFoundError):
                known = path.stat()
                files.append((max(known.st_atime, known.st_mtime), known.st_size, path))
    size = sum(one[1] for one in files)
    now = time.time()
    for used, bytes_, path in sorted(files):
        if size <= _MOST and now - used < _LONGEST:
            break
        path.unlink(missing_ok=True)
        size -= bytes_


def _folders() -> Iterator[Path]:
    """Those that we made: a key lies in each."""
    place = root()
    if place.is_dir():
        yield from (path for path in sorted(place.iterdir()) if (path / _KEY).is_file())


def _faults(folder: Path) -> int:
    try:
        return int((folder / _FAULTS).read_text())
    except (OSError, ValueError):
        return 0


def _read_json(path: Path) -> dict[str, object]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _processor() -> str:
    """The model and all that it can do, as far as the system tells."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        names = ("model name", "flags", "Features", "CPU part")
        found = [line for line in lines if line.split(":")[0].strip() in names]
        # As often as there are cores.
        return hashlib.sha256("\n".join(dict.fromkeys(found)).encode()).hexdigest()[:16]
    return platform.processor()


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".")[:2] if part.isdigit())
