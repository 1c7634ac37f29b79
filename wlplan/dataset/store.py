"""Data sets on disk: zarr groups that grow batch by batch and survive whatever happens."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import re
import socket
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wlplan.dataset.layout import Layout
from wlplan.dataset.variables import LOADS, VARIABLES, Dataset, h36_after
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError, one_line
from wlplan.io.documents import check_kinds, parse_json
from wlplan.io.files import atomic_folder, replace_file
from wlplan.io.provenance import command, versions

DATASET_FORMAT = "wlplan.dataset/1"

SHARD_ATTRIBUTES = ("shard", "shards", "first_cycle", "whole_cycles")
"""Attributes that a shard has and a whole data set has not."""

# What attributes are that are looked at; a number of them may be missing in older data sets.
_KINDS: dict[str, type] = {
    **dict.fromkeys((*SHARD_ATTRIBUTES, "cycles", "cycles_done", "seed", "loads"), int),
    **dict.fromkeys(("soil", "machine", "settings", "schedule", "versions"), dict),
    "protocol": str,
}
# How a lock is signed: number and start of the process, and its host.
_SIGNED = re.compile(r"\d+ \S+ .*")
# And how it is when the process died as it signed it.
_HALF_SIGNED = re.compile(r"\d+ \S*")
# A lock that is not signed for longer was left by a process that died before it was [s].
_SIGNING_TIME = 10.0


def identity(layout: Layout, seed: int, protocol: str, simulator: Simulator) -> dict[str, Any]:
    """What must agree for two collections to end with the same cycles, as JSON holds it."""
    shard: dict[str, int] = {}
    if layout.shard is not None:
        values = (*layout.shard, layout.first, layout.cycles)
        shard = dict(zip(SHARD_ATTRIBUTES, values, strict=True))
    identity = {
        "format": DATASET_FORMAT,
        **shard,
        "cycles": layout.size,
        "seed": seed,
        "protocol": protocol,
        "soil": dataclasses.asdict(simulator.soil),
        "machine": dataclasses.asdict(simulator.machine),
        "settings": dataclasses.asdict(simulator.settings),
        "schedule": dataclasses.asdict(simulator.schedule),
        "loads": LOADS,
    }
    as_written: dict[str, Any] = json.loads(json.dumps(identity))
    return as_written


def is_new(path: Path) -> bool:
    """Whether there is nothing at a path, or an empty directory."""
    return not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir()))


def create(path: Path, layout: Layout, identity: Mapping[str, Any]) -> None:
    """Makes a data set without cycles, all of it or nothing; the caller holds its `lock`."""
    attributes = {
        **identity,
        "title": "Loading cycles of a simulated wheel loader",
        "command": command(),
        "versions": versions(),
        "cycles_done": 0,
    }
    with atomic_folder(path, locked=True) as new:
        make_arrays(new, layout, attributes)


def make_arrays(path: Path, layout: Layout, attributes: Mapping[str, Any]) -> None:
    """Makes a group with these attributes and the empty arrays of a part."""
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.core.buffer import Buffer

    # Made in memory: on a disk that is full, zarr's threads go on writing after we have heard of it
    # and removed what was there.
    files: dict[str, Buffer] = {}
    memory = zarr.storage.MemoryStore(files)
    group = zarr.create_group(store=memory, zarr_format=3, attributes=dict(attributes))
    for name, variable in VARIABLES.items():
        group.create_array(
            name,
            shape=(layout.size, *variable.shape),
            chunks=(layout.batch_cycles, *variable.shape),
            dtype=variable.dtype,
            # Bytes of equal weight side by side compress to two thirds.
            compressors=BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"),
            dimension_names=("cycle", *variable.dims),
            attributes={
                "long_name": variable.long_name,
                "units": variable.units,
                **variable.attributes,
            },
        )
    # A copy of all metadata in the group's own: xarray looks for it and complains without. That is
    # a convention, not yet part of the format, says the warning.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(memory, zarr_format=3)
    for name, content in files.items():
        (path / name).parent.mkdir(exist_ok=True)
        replace_file(path / name, content.to_bytes())


def resume(path: Path, wanted: Mapping[str, Any]) -> int:
    """Number of cycles that a data set already holds.

    Raises:
        InputError: If it is not the data set that is wanted.
    """
    attributes = read_attributes(path)
    if part_of(attributes) != part_of(wanted):
        raise InputError(
            f"{path}: was begun as {part_of(attributes)}, not as {part_of(wanted)}: choose another "
            f"place."
        )
    differs = difference({name: attributes.get(name) for name in wanted}, wanted)
    if differs is not None:
        name, found, value = differs
        raise InputError(
            f"{path}: was begun with {name} {found!r}, not {value!r}: use the same settings to "
            f"continue it, or choose another place."
        )
    done = int(attributes["cycles_done"])
    lacking = [name for name in VARIABLES if not (path / name / "zarr.json").is_file()]
    if lacking and done < wanted["cycles"]:
        raise InputError(
            f"{path}: has no {lacking[0]}: it was begun by another version of wlplan; finish it "
            f"with that one, or choose another place."
        )
    # A process that was killed while it wrote leaves files that were never finished.
    for pattern in ("**/*.partial", ".zarr.json.*.tmp"):
        for partial_file in path.glob(pattern):
            partial_file.unlink(missing_ok=True)
    return done


def part_of(attributes: Mapping[str, Any]) -> str:
    """Which part of a data set attributes belong to, in words."""
    if "shard" not in attributes:
        return "a whole data set"
    return f"shard {attributes['shard']}/{attributes.get('shards')}"


def difference(
    found: Mapping[str, Any], wanted: Mapping[str, Any]
) -> tuple[str, object, object] | None:
    """The first attribute, or field of one, that differs: its name and both values."""
    for name in {**wanted, **found}:
        one, other = found.get(name), wanted.get(name)
        if one == other:
            continue
        if isinstance(one, dict) and isinstance(other, dict):
            inner = difference(one, other)
            if inner is not None:
                return f"{name} ({inner[0]})", *inner[1:]
        return name, one, other
    return None


def write(path: Path, batch: Mapping[str, np.ndarray], start: int) -> None:
    """Writes a batch from cycle `start` on; `cycles_done` has to be updated afterwards."""
    import zarr

    # A chunk that is missing is then one that was lost.
    with zarr.config.set({"array.write_empty_chunks": True}):
        group = zarr.open_group(str(path), mode="r+", zarr_format=3)
        for name, values in batch.items():
            array = group[name]
            assert isinstance(array, zarr.Array)
            array[start : start + len(values)] = values


def read_attributes(path: Path) -> dict[str, Any]:
    """The attributes of the group of a data set.

    Raises:
        InputError: If it is missing, or not a data set of this format.
    """
    if not os.path.lexists(path):
        raise InputError(f"{path}: no such data set: check the name, or collect it first.")
    try:
        attributes: dict[str, Any] = parse_json((path / "zarr.json").read_bytes())["attributes"]
        found = attributes.get("format")
        if found == DATASET_FORMAT:
            check_kinds(attributes, _KINDS)
            check_kinds(attributes.get("soil", {}), {"density": (int, float)})
            if not 0 <= attributes["cycles_done"] <= attributes["cycles"]:
                raise ValueError("more cycles than it has room for")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: is not a data set of wlplan: name a directory that `wlplan collect` wrote."
        ) from error
    if found != DATASET_FORMAT:
        raise InputError(
            f"{path}: has format {found!r}, not {DATASET_FORMAT!r}: it is not a data set, or one "
            f"for another version of wlplan."
        )
    return attributes


def update_attributes(path: Path, changes: Mapping[str, Any]) -> None:
    """Changes attributes of the group, all or none, after everything written so far."""
    target = path / "zarr.json"
    document = json.loads(target.read_text("utf-8"))
    document["attributes"].update(changes)
    replace_file(target, json.dumps(document, indent=2).encode())


@contextlib.contextmanager
def lock(path: Path) -> Iterator[None]:
    """Keeps two processes from writing the same data set; a lock of a dead process is taken over.

    Raises:
        InputError: If a running process holds it, or the path ends without a name to put beside.
    """
    if not path.name:
        raise InputError(f"{path}: is no place of its own: name a folder for the data set.")
    lock = path.with_name(f"{path.name}.lock")
    mine = f"{os.getpid()} {_start_of(os.getpid())} {socket.gethostname()}"
    for attempt in itertools.count():
        try:
            handle = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            holder = ""
            with contextlib.suppress(OSError):
                holder = lock.read_text("utf-8")
            if _HALF_SIGNED.fullmatch(holder):
                holder = ""
            if holder and not _SIGNED.fullmatch(holder):
                raise InputError(
                    f"{path}: {lock.name} is beside it and no lock of wlplan: choose another name."
                ) from None
            if _is_alive(holder) or (not holder and _is_young(lock)) or attempt > 2:
                raise InputError(
                    f"{path}: is being written by process {holder.split(' ')[0] or '?'}: wait for "
                    f"it, or delete {lock.name} if it is gone."
                ) from None
            lock.unlink(missing_ok=True)
        else:
            break
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(mine)
        yield
    finally:
        # What fails, or is interrupted, may succeed the second time.
        try:
            lock.unlink(missing_ok=True)
        finally:
            with contextlib.suppress(OSError):
                lock.unlink(missing_ok=True)


def _is_young(lock: Path) -> bool:
    """Whether a lock was made just now, so that its holder may not have signed it yet."""
    with contextlib.suppress(OSError):
        return time.time() - lock.stat().st_mtime < _SIGNING_TIME
    return False


def _is_alive(holder: str) -> bool:
    """Whether the process that wrote a lock still runs, as far as one can see."""
    try:
        number, start, host = holder.split(" ", 2)
        pid = int(number)
    except ValueError:
        return False
    if host != socket.gethostname():
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    # After a restart another process may have the same number.
    return _start_of(pid) == start


def _start_of(pid: int) -> str:
    """When a process started, or that it has ended, where the system tells (Linux); else "?"."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        # A process that was killed may stay listed until its parent asks for it.
        return "ended" if fields[0] in "ZX" else fields[19]
    except (OSError, IndexError):
        return "?"


def open_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Reads a complete data set into memory, 32 kB a cycle.

    Raises:
        InputError: If it is missing, not complete, damaged, of another format, or a shard: who
            trains on a part should not do so unawares.
    """
    import zarr

    path = Path(path)
    attributes = read_attributes(path)
    if "shard" in attributes:
        raise InputError(
            f"{path}: is {part_of(attributes)} of a data set: join all of its shards with "
            f"`wlplan collect --merge` first."
        )
    cycles, done = int(attributes["cycles"]), int(attributes["cycles_done"])
    if done < cycles:
        raise InputError(
            f"{path}: holds {done} of {cycles} cycles: run the same `wlplan collect` again to "
            f"finish it."
        )
    columns: dict[str, Any] = {}
    try:
        group = zarr.open_group(str(path), mode="r", zarr_format=3)
        for name, variable in VARIABLES.items():
            if name == "h36_after" and name not in group:
                continue
            array = group[name]
            if not isinstance(array, zarr.Array) or array.nchunks_initialized < array.nchunks:
                raise ValueError(f"parts of {name} are missing")
            # Before it is read: a few bytes may say that they are an array of any size.
            if array.shape != (cycles, *variable.shape):
                raise ValueError(f"{name} has shape {array.shape}")
            if not np.can_cast(array.dtype, variable.dtype, "same_kind"):
                raise ValueError(f"{name} is of type {array.dtype}")
            columns[name] = np.asarray(array[...])
    except Exception as error:
        # Damaged chunks make the decoders raise almost anything; to the user it means the same.
        what = one_line(error)
        raise InputError(f"{path}: is damaged ({what}): copy or collect it again.") from error
    if "h36_after" not in columns:
        # Earlier versions did not store it.
        columns["h36_after"] = h36_after(columns["h36"], columns["h52"], columns["h52_after"])
    return Dataset(**columns, attributes=attributes)
