"""Merging: join shards to the data set that a single collector would have written."""

from __future__ import annotations

import errno
import itertools
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from wlplan.dataset import store
from wlplan.dataset.layout import Layout
from wlplan.dataset.variables import VARIABLES
from wlplan.errors import InputError, one_line
from wlplan.io.files import atomic_folder
from wlplan.io.provenance import command

# Attributes that are a shard's own; in all others the shards of a data set agree.
_OWN = ("shard", "first_cycle", "cycles", "cycles_done", "command")
# What decides the bytes of a chunk, in the metadata of an array.
_ENCODING = ("data_type", "chunk_grid", "chunk_key_encoding", "fill_value", "codecs")


class _Shard(NamedTuple):
    """A shard on disk: a complete one."""

    path: Path
    layout: Layout
    attributes: dict[str, Any]


def merge(
    parts: Sequence[str | os.PathLike[str]],
    path: str | os.PathLike[str],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Joins all shards of a data set; they are left as they are.

    Chunks are copied as they are, once it was seen that they can be read. The data set appears at
    its place when it is complete; one that is there already, of the same shards, is left alone.

    Args:
        parts: Directories of the shards, in any order.
        path: Directory of the data set. Missing directories above it are made.
        progress: Called with the number of cycles copied so far and in all.

    Returns:
        The attributes of the data set: those of a single collector apart from `command`.

    Raises:
        InputError: If a shard is missing, given twice, not finished, damaged, or of another data
            set than the first; if the path holds something else; if another process writes it; or
            if it cannot be written.
    """
    path = Path(path)
    shards = _ordered([_read(Path(part)) for part in parts])
    place = path.absolute().resolve()
    for shard in shards:
        if shard.path.resolve() in (place, *place.parents):
            raise InputError(f"{path}: is a shard or inside of one: choose another place.")
        _check_chunks(shard.path, shard.layout)
    whole = Layout(shards[0].layout.cycles)
    attributes = {k: v for k, v in shards[0].attributes.items() if k not in store.SHARD_ATTRIBUTES}
    attributes |= {"cycles": whole.cycles, "command": command(), "cycles_done": 0}
    complete = {"cycles_done": whole.cycles}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)  # the lock goes there
        with store.lock(path):
            if not store.is_new(path):
                _check_is_merged(path, whole, attributes | complete)
                return attributes | complete
            with atomic_folder(path, locked=True) as new:
                store.make_arrays(new, whole, attributes)
                done = 0
                if progress is not None:
                    progress(done, whole.cycles)
                for shard in shards:
                    for cycles in _copy(shard, new):
                        done += cycles
                        if progress is not None:
                            progress(done, whole.cycles)
                store.update_attributes(new, complete)
    except OSError as error:
        reason = one_line(error.strerror or error)
        advice = "free some space" if error.errno == errno.ENOSPC else "choose another place"
        raise InputError(
            f"{path}: cannot be written ({reason}): {advice}; the shards are as they were."
        ) from error
    return attributes | complete


def _read(path: Path) -> _Shard:
    """A shard by its attributes.

    Raises:
        InputError: If it is no shard, of another version, or not finished.
    """
    attributes = store.read_attributes(path)
    if "shard" not in attributes:
        raise InputError(f"{path}: is no shard: name what `wlplan collect --shard` wrote.")
    try:
        number, count, first, cycles = (attributes[name] for name in store.SHARD_ATTRIBUTES)
        layout = Layout(cycles, (number, count))
        if (first, attributes["cycles"]) != (layout.first, layout.size):
            raise ValueError("cut elsewhere")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: was cut in another way than this version of wlplan does: merge it with the "
            f"version that collected it."
        ) from error
    done = attributes["cycles_done"]
    if done != layout.size:
        raise InputError(
            f"{path}: holds {done} of the {layout.size} cycles of {store.part_of(attributes)}: run "
            f"its `wlplan collect` again to finish it."
        )
    return _Shard(path, layout, attributes)


def _ordered(shards: Sequence[_Shard]) -> list[_Shard]:
    """All shards of one data set, from its first cycle to its last.

    Raises:
        InputError: If they are not that.
    """
    if not shards:
        raise InputError("There are no shards to merge: name them.")
    first = shards[0]
    wanted = {k: v for k, v in first.attributes.items() if k not in _OWN}
    for shard in shards:
        found = {k: v for k, v in shard.attributes.items() if k not in _OWN}
        differs = store.difference(found, wanted)
        if differs is not None:
            raise InputError(
                f"{shard.path}: has {differs[0]} {differs[1]!r}, but {first.path} has "
                f"{differs[2]!r}: merge shards of one data set."
            )
    shards = sorted(shards, key=lambda shard: shard.layout.first)
    for one, other in itertools.pairwise(shards):
        if one.layout == other.layout:
            raise InputError(
                f"{one.path} and {other.path}: both are {store.part_of(one.attributes)}: name each "
                f"shard once."
            )
    count = first.attributes["shards"]
    there = {shard.attributes["shard"] for shard in shards}
    missing = [f"{n}/{count}" for n in range(1, count + 1) if n not in there]
    if missing:
        more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
        raise InputError(
            f"Missing of the data set: shard {', '.join(missing[:5])}{more}: name all its shards."
        )
    return shards


def _check_chunks(path: Path, layout: Layout) -> None:
    """Sees that every chunk of every variable is there.

    Raises:
        InputError: If one is not.
    """
    for name in VARIABLES:
        for batch in range(_batches(layout)):
            if not os.path.isfile(path / _chunk(name, batch)):
                raise _damaged(path, f"{_chunk(name, batch)} is missing")


def _check_is_merged(path: Path, whole: Layout, attributes: dict[str, Any]) -> None:
    """Sees that a path holds the complete data set with these attributes.

    Raises:
        InputError: If it holds something else.
    """
    try:
        found = store.read_attributes(path)
    except InputError:
        found = {}
    ours = attributes | {"command": found.get("command")}
    if store.difference(found, ours) is not None:
        raise InputError(
            f"{path}: is there and not the data set of these shards: choose another place, or "
            f"delete it."
        )
    _check_chunks(path, whole)


def _copy(shard: _Shard, target: Path) -> Iterator[int]:
    """Copies a shard batch by batch to where its cycles are in the whole; yields how many each.

    Raises:
        InputError: If the shard is damaged, or written by another version.
        OSError: If the target cannot be written.
    """
    import zarr

    size, first = shard.layout.batch_cycles, shard.layout.first
    arrays: dict[str, Any] = {}
    try:
        group = zarr.open_group(str(shard.path), mode="r", zarr_format=3)
        for name in VARIABLES:
            arrays[name] = group[name]
            source, goal = (_encoding(path / name) for path in (shard.path, target))
            if source != goal or arrays[name].shape[0] != shard.layout.size:
                raise ValueError(f"{name} is stored in another way")
    except Exception as error:
        raise _damaged(shard.path, error) from error
    for batch in range(_batches(shard.layout)):
        here = slice(batch * size, min((batch + 1) * size, shard.layout.size))
        for name, array in arrays.items():
            try:
                # Only to see that it can be read: the bytes are copied as they are.
                _ = array[here]
                chunk = (shard.path / _chunk(name, batch)).read_bytes()
            except Exception as error:
                # Damaged chunks make the decoders raise almost anything.
                raise _damaged(shard.path, error) from error
            _write(target / _chunk(name, first // size + batch), chunk)
        yield here.stop - here.start


def _write(path: Path, content: bytes) -> None:
    """Writes a new file through to the disk, since its source may be deleted afterwards."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _batches(layout: Layout) -> int:
    """Batches of a part: chunks of each of its variables."""
    return -(-layout.size // layout.batch_cycles)


def _chunk(name: str, batch: int) -> str:
    """Name of the file of a chunk, below the data set; a chunk holds all of the other axes."""
    return "/".join((name, "c", str(batch), *("0" for _ in VARIABLES[name].shape)))


def _encoding(array: Path) -> dict[str, Any]:
    """What the metadata of an array says about the bytes of its chunks."""
    document = json.loads((array / "zarr.json").read_text("utf-8"))
    return {name: document.get(name) for name in _ENCODING}


def _damaged(path: Path, what: object) -> InputError:
    return InputError(
        f"{path}: is damaged or cannot be read ({one_line(what)}): if it is damaged, delete it and "
        f"collect it again."
    )
