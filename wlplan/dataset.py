"""Training data: loading cycles played by the simulator, stored, split and normalised.

The protocol is the paper's (section 6.2). A rollout takes one of the six seed piles, with noise of
its own, and digs it 30 times in a row; each loading starts at a random accessible point of the toe
of the pile as it then is, heads into it to within 10 degrees of the normal, and takes its action
from a Latin hypercube. A set is one rollout of each seed pile; its 180 actions are one hypercube.

Everything random about a rollout follows from the seed and the number of the rollout alone, so a
collection that was cut short goes on where it stopped and ends with the same bytes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import functools
import hashlib
import importlib.metadata
import itertools
import json
import math
import os
import shlex
import shutil
import socket
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from wlplan.automaton import relax
from wlplan.characteristics import as_vector, characteristics
from wlplan.errors import InputError
from wlplan.heightmap import (
    PERFORMANCE_CELLS,
    STATE_CELLS,
    STATE_DISPLACEMENT,
    local_axes,
    sample,
    sample_local,
    to_world,
)
from wlplan.pile import SEED_PILES, seed_pile, toe_contour
from wlplan.sampling import latin_hypercube
from wlplan.simulator import STOP_REASONS, Simulator
from wlplan.types import Action, Characteristics, Pile, Pose
from wlplan.units import ACTION_HIGH, ACTION_LOW, CELL_SIZE, J_PER_KJ

DATASET_FORMAT = "wlplan.dataset/1"

LOADS = 30
"""Consecutive loadings of a rollout. Paper, section 6.2."""

# Largest deviation of the heading from the normal of the toe [rad]. Paper, section 6.2.
_HEADING_SPREAD = math.radians(10.0)
# Rollouts in one call of the simulator. While one group is simulated the host looks for the dig
# locations of the next; a cycle waits for the slowest of its group.
_GROUP = 15
# Groups that advance together and are written as one batch: one chunk of every variable, 19 MB of
# the largest.
_GROUPS = 4

_SIMULATOR = Simulator()

# What the random streams are for; part of their keys.
_ROLLOUT_STREAM, _ACTION_STREAM = 0, 1


# --- the variables


@dataclasses.dataclass(frozen=True)
class Variable:
    """How a variable is stored. Every variable has the leading dimension `cycle`."""

    dtype: str
    long_name: str
    units: str = "1"
    dims: tuple[str, ...] = ()  # after `cycle`
    shape: tuple[int, ...] = ()  # after `cycle`
    attributes: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def _map(cells: int, long_name: str, displacement: float) -> Variable:
    return Variable(
        "float32",
        long_name,
        "m",
        (f"i{cells}", f"j{cells}"),
        (cells, cells),
        {"cell_size": CELL_SIZE, "displacement": displacement, "axes": "along heading, left"},
    )


VARIABLES: dict[str, Variable] = {
    "mass": Variable("float32", "load mass", "tonne"),
    "time": Variable("float32", "time of the loading cycle", "s"),
    "work": Variable("float32", "work of the loading cycle, slip included", "kJ"),
    "action": Variable(
        "float32",
        "parameters of the bucket-filling controller",
        dims=("action_parameter",),
        shape=(4,),
        attributes={"components": [field.name for field in dataclasses.fields(Action)]},
    ),
    "pose": Variable(
        "float32",
        "dig location and heading, world frame",
        "m, m, rad",
        ("pose_component",),
        (3,),
        {"components": [field.name for field in dataclasses.fields(Pose)]},
    ),
    "h36": _map(PERFORMANCE_CELLS, "local heightmap of the performance predictor", 0.0),
    "h52": _map(STATE_CELLS, "local heightmap of the pile state predictor", STATE_DISPLACEMENT),
    "h52_after": _map(
        STATE_CELLS, "h52 after the loading, over the same reference", STATE_DISPLACEMENT
    ),
    "characteristics": Variable(
        "float32",
        "characteristics of h36",
        "rad, rad, m-1, m-1",
        ("characteristic",),
        (4,),
        {"components": [field.name for field in dataclasses.fields(Characteristics)]},
    ),
    "work_slip": Variable("float32", "part of the work that the wheels' slip takes", "kJ"),
    "fill_time": Variable("float32", "time from the dig location to the stop", "s"),
    "stop_reason": Variable(
        "int32",
        "event that ended bucket filling",
        attributes={
            "flag_values": list(range(len(STOP_REASONS))),
            "flag_meanings": " ".join(STOP_REASONS),
        },
    ),
    "rollout": Variable("int32", "number of the rollout"),
    "load": Variable("int32", "number of the loading in its rollout"),
    "seed_pile": Variable(
        "int32",
        "seed pile of the rollout",
        attributes={
            "flag_values": list(range(len(SEED_PILES))),
            "flag_meanings": " ".join(f"{kind}_{math.degrees(s):.0f}" for kind, s in SEED_PILES),
        },
    ),
    "valid": Variable("bool", "the loading was at the toe of a pile worth digging"),
}
"""Variables of a data set by name, in the order of the fields of `Dataset`."""


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Loading cycles in memory; `VARIABLES` tells meaning and unit of each array."""

    mass: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    work: Float[np.ndarray, " n"]
    action: Float[np.ndarray, "n 4"]
    pose: Float[np.ndarray, "n 3"]
    h36: Float[np.ndarray, "n 36 36"]
    h52: Float[np.ndarray, "n 52 52"]
    h52_after: Float[np.ndarray, "n 52 52"]
    characteristics: Float[np.ndarray, "n 4"]
    work_slip: Float[np.ndarray, " n"]
    fill_time: Float[np.ndarray, " n"]
    stop_reason: Int[np.ndarray, " n"]
    rollout: Int[np.ndarray, " n"]
    load: Int[np.ndarray, " n"]
    seed_pile: Int[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]
    attributes: Mapping[str, Any]  # of the group: seed, soil, machine, versions

    def __len__(self) -> int:
        return len(self.mass)

    def select(self, which: Int[np.ndarray, " k"] | Bool[np.ndarray, " n"]) -> Dataset:
        """The cycles of an index array or a mask."""
        return dataclasses.replace(self, **{name: getattr(self, name)[which] for name in VARIABLES})


# --- collecting


@dataclasses.dataclass(frozen=True)
class _Layout:
    """How many cycles are rolled out in which portions."""

    cycles: int

    @property
    def rollouts(self) -> int:
        return math.ceil(self.cycles / LOADS)

    @property
    def loads(self) -> int:
        """Loadings to play of each rollout."""
        return min(LOADS, self.cycles)

    @property
    def group(self) -> int:
        """Rollouts in one call of the simulator, as even as can be."""
        return math.ceil(self.rollouts / math.ceil(self.rollouts / _GROUP))

    @property
    def batch_cycles(self) -> int:
        """Cycles that are written at once."""
        return min(_GROUPS * self.group * LOADS, self.cycles)


def collect(
    path: str | os.PathLike[str],
    *,
    cycles: int,
    seed: int = 0,
    simulator: Simulator = _SIMULATOR,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Plays loading cycles and stores them; goes on where an earlier call stopped.

    A data set of more cycles is a longer series of the same rollouts. Cycles are written batch by
    batch; what was written stays intact whatever happens to the process.

    Args:
        path: Directory of the data set, a zarr (version 3) group; by custom it ends in `.zarr`.
        cycles: Number of loading cycles; the last rollout is cut short to meet it.
        seed: Seed of piles, poses and actions.
        simulator: The simulator with its machine and soil.
        progress: Called with the number of cycles played so far and in all.

    Raises:
        InputError: If the path holds something else or a data set of another seed, number of
            cycles or simulator; if another process writes it; or if it cannot be written.
    """
    path = Path(path)
    if cycles < 1:
        raise InputError(f"{cycles} cycles asked for: it has to be at least 1.")
    if seed < 0:
        raise InputError(f"The seed is {seed}: it has to be 0 or more.")
    layout = _Layout(cycles)
    done = 0
    try:
        with _lock(path):
            wanted = _identity(cycles, seed, simulator)
            if _is_new(path):
                _create(path, layout, wanted)
            done = _resume(path, wanted)
            if progress is not None:
                progress(done, cycles)
            while done < cycles:
                batch = _play_batch(layout, done, seed, simulator, progress)
                _write(path, batch, done)
                done += len(batch["mass"])
                _update_attributes(path, {"cycles_done": done})
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        advice = "free some space" if error.errno == errno.ENOSPC else "choose another place"
        if done:
            advice += f"; {done} of {cycles} cycles are safe, the same command goes on from there"
        raise InputError(f"{path}: cannot be written ({reason}): {advice}.") from error


def _play_batch(
    layout: _Layout,
    start: int,
    seed: int,
    simulator: Simulator,
    progress: Callable[[int, int], None] | None,
) -> dict[str, np.ndarray]:
    """The variables of the next batch of cycles, from cycle `start` on."""
    stop = min(start + layout.batch_cycles, layout.cycles)
    numbers = range(start // LOADS, math.ceil(stop / LOADS))
    rollouts = [_Rollout(number, seed) for number in numbers]
    groups = [
        _Group(rollouts[k : k + layout.group], layout.group, simulator)
        for k in range(0, len(rollouts), layout.group)
    ]
    for load in range(layout.loads):
        # A call returns before its result is there: the host prepares one group while the device
        # is busy with the others.
        for group in groups:
            group.advance(load)
        if progress is not None:
            progress(min(start + (load + 1) * len(rollouts), stop), layout.cycles)
    parts = [group.records() for group in groups]
    return {name: np.concatenate([p[name] for p in parts])[: stop - start] for name in VARIABLES}


class _Rollout:
    """The random numbers of one rollout."""

    def __init__(self, number: int, seed: int):
        self.number = number
        repeat, self.seed_pile = divmod(number, len(SEED_PILES))
        key = np.random.SeedSequence(seed, spawn_key=(_ROLLOUT_STREAM, number))
        random = np.random.default_rng(key)
        self.noise_seed = int(random.integers(2**31))
        self.place, turn = random.random((2, LOADS))  # [0, 1) along the accessible toe
        self.turn = _HEADING_SPREAD * (2.0 * turn - 1.0)
        key = np.random.SeedSequence(seed, spawn_key=(_ACTION_STREAM, repeat))
        unit = latin_hypercube(len(SEED_PILES) * LOADS, 4, np.random.default_rng(key))
        low, high = np.array(ACTION_LOW), np.array(ACTION_HIGH)
        mine = slice(self.seed_pile * LOADS, (self.seed_pile + 1) * LOADS)
        self.action = (low + (high - low) * unit[mine]).astype(np.float32)


class _Group:
    """Rollouts that advance together, one loading at a time."""

    def __init__(self, rollouts: list[_Rollout], size: int, simulator: Simulator):
        self.rollouts = rollouts
        self.simulator = simulator
        # A short group is filled up with copies, so that one compiled program serves them all.
        self.padding = size - len(rollouts)
        shape = _grid_shape()
        self.origin = -0.5 * CELL_SIZE * (np.array(shape, np.float32) - 1.0)
        slide = _relaxer(simulator.soil.repose_angle)
        piles = []
        for rollout in rollouts:
            kind, slope = SEED_PILES[rollout.seed_pile]
            pile = seed_pile(kind, slope=slope, seed=rollout.noise_seed)
            piles.append(np.asarray(slide(_on_grid(pile, shape)).height))
        self.height = self._padded(np.stack(piles).astype(np.float32))
        self.pose = np.zeros((len(rollouts), 3), np.float32)
        self.loads: list[dict[str, Any]] = []

    def _padded(self, values: np.ndarray) -> Any:
        return np.concatenate([values, np.repeat(values[-1:], self.padding, axis=0)])

    def advance(self, load: int) -> None:
        """Plays the next loading of every rollout; does not wait for it."""
        height = np.asarray(self.height)
        valid = np.zeros(len(self.rollouts), bool)
        for k, rollout in enumerate(self.rollouts):
            pile = Pile(jnp.asarray(height[k]), CELL_SIZE, jnp.asarray(self.origin))
            pose = choose_pose(pile, rollout.place[load], rollout.turn[load])
            valid[k] = pose is not None
            # A pile that is used up is dug where it was dug last; `valid` tells.
            self.pose[k] = self.pose[k] if pose is None else pose
        pose = self.pose.copy()
        action = np.stack([rollout.action[load] for rollout in self.rollouts])
        self.height, record = _play(
            self.simulator, self.origin, self.height, self._padded(pose), self._padded(action)
        )
        self.loads.append(
            record
            | {
                "action": action,
                "pose": pose,
                "valid": valid,
                "rollout": np.array([rollout.number for rollout in self.rollouts]),
                "seed_pile": np.array([rollout.seed_pile for rollout in self.rollouts]),
                "load": np.full(len(self.rollouts), load),
            }
        )

    def records(self) -> dict[str, np.ndarray]:
        """The variables of all loadings, a rollout after the other."""
        count = len(self.rollouts)
        result = {}
        for name, variable in VARIABLES.items():
            column = np.stack([np.asarray(load[name])[:count] for load in self.loads], axis=1)
            result[name] = column.reshape(-1, *variable.shape).astype(variable.dtype)
        return result


def choose_pose(pile: Pile, place: float, turn: float) -> Float[np.ndarray, "3"] | None:
    """A dig pose at the toe of a pile as it is: x, y [m] and heading [rad].

    Args:
        pile: One pile.
        place: Which of the accessible points of the toe, 0 to 1 along it.
        turn: Heading over the normal into the pile [rad].

    Returns:
        The pose; None if there is nothing left to dig.
    """
    try:
        toe = toe_contour(pile)
    except InputError:
        return None
    candidates = np.flatnonzero(toe.accessible)
    if candidates.size == 0:
        return None
    at = candidates[min(int(place * candidates.size), candidates.size - 1)]
    return np.array([*toe.points[at], toe.heading[at] + turn], np.float32)


@jax.jit
def _play(
    simulator: Simulator,
    origin: Float[Array, "2"],
    height: Float[Array, "b nx ny"],
    pose: Float[Array, "b 3"],
    action: Float[Array, "b 4"],
) -> tuple[Float[Array, "b nx ny"], dict[str, Array]]:
    """One loading of each of a group of piles: the surfaces after and the simulated variables."""

    def play(height: Array, pose: Array, action: Array) -> tuple[Array, dict[str, Array]]:
        pile, dig_pose = Pile(height, CELL_SIZE, origin), Pose(*pose)
        after, performance, cycle = simulator.play(pile, dig_pose, Action(*action))
        h36 = sample_local(pile, dig_pose)
        h52 = sample_local(
            pile, dig_pose, cells=STATE_CELLS, displacement=STATE_DISPLACEMENT
        ).height
        axes = (jnp.asarray(a, height.dtype) for a in local_axes(STATE_CELLS, STATE_DISPLACEMENT))
        points = to_world(dig_pose, *jnp.meshgrid(*axes, indexing="ij"))
        record = {
            "mass": performance.mass,
            "time": performance.time,
            "work": performance.work,
            "h36": h36.height,
            "h52": h52,
            # Sampling is linear, so the change can be sampled: where nothing moved it is zero.
            "h52_after": h52 + sample(after.height - height, pile, *points),
            "characteristics": as_vector(characteristics(h36)),
            "work_slip": cycle.work_slip / J_PER_KJ,
            "fill_time": cycle.fill_time,
            "stop_reason": cycle.stop_reason,
        }
        return after.height, record

    return jax.vmap(play)(height, pose, action)


@functools.cache
def _grid_shape() -> tuple[int, int]:
    """The smallest grid that holds each of the seed piles [cells]."""
    shapes = [seed_pile(kind, slope=slope, noise=0.0).height.shape for kind, slope in SEED_PILES]
    nx, ny = np.max(shapes, axis=0)
    return int(nx), int(ny)


def _on_grid(pile: Pile, shape: tuple[int, int]) -> Pile:
    """A seed pile with level ground added on all sides; its centre stays the world origin."""
    # Seed piles have an odd number of cells a side, so the rim is the same on both sides.
    rim = [(n - old) // 2 for n, old in zip(shape, pile.height.shape, strict=True)]
    return dataclasses.replace(
        pile,
        height=jnp.pad(pile.height, [(r, r) for r in rim]),
        origin=jnp.asarray(pile.origin) - CELL_SIZE * jnp.asarray(rim, pile.height.dtype),
    )


@functools.cache
def _relaxer(repose_angle: float) -> Callable[[Pile], Pile]:
    # One pile at a time, since `relax` stops as soon as the pile stands.
    return jax.jit(functools.partial(relax, repose_angle=repose_angle))


# --- storing


def _identity(cycles: int, seed: int, simulator: Simulator) -> dict[str, Any]:
    """What must agree for two collections to end with the same cycles, as JSON holds it."""
    identity = {
        "format": DATASET_FORMAT,
        "cycles": cycles,
        "seed": seed,
        "soil": dataclasses.asdict(simulator.soil),
        "machine": dataclasses.asdict(simulator.machine),
        "settings": dataclasses.asdict(simulator.settings),
        "schedule": dataclasses.asdict(simulator.schedule),
        "loads": LOADS,
    }
    return json.loads(json.dumps(identity))


def _is_new(path: Path) -> bool:
    """Whether there is nothing at a path, or an empty directory."""
    return not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir()))


def _create(path: Path, layout: _Layout, identity: Mapping[str, Any]) -> None:
    """Makes the empty arrays beside their place and moves them there in one step."""
    import zarr
    from zarr.codecs import BloscCodec

    beside = path.with_name(f".{path.name}.new")
    shutil.rmtree(beside, ignore_errors=True)
    try:
        group = zarr.create_group(
            store=str(beside),
            zarr_format=3,
            attributes={
                **identity,
                "title": "Loading cycles of a simulated wheel loader",
                "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
                "versions": versions(),
                "cycles_done": 0,
            },
        )
        for name, variable in VARIABLES.items():
            group.create_array(
                name,
                shape=(layout.cycles, *variable.shape),
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
        # A copy of all metadata in the group's own: xarray looks for it and complains without. That
        # is a convention, not yet part of the format, says the warning.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(str(beside), zarr_format=3)
        os.replace(beside, path)
    except BaseException:
        shutil.rmtree(beside, ignore_errors=True)
        raise


def _resume(path: Path, wanted: Mapping[str, Any]) -> int:
    """Number of cycles that a data set already holds.

    Raises:
        InputError: If it is not the data set that is wanted.
    """
    attributes = _read_attributes(path)
    for name, value in wanted.items():
        found = attributes.get(name)
        if found != value:
            if isinstance(value, dict) and isinstance(found, dict):
                field = next(k for k in value if found.get(k) != value[k])
                name, found, value = f"{name} ({field})", found.get(field), value[field]
            raise InputError(
                f"{path}: was begun with {name} {found!r}, not {value!r}: use the same settings to "
                f"go on with it, or choose another place."
            )
    # A process that was killed while it wrote leaves files that were never finished.
    for partial_file in path.glob("**/*.partial"):
        partial_file.unlink(missing_ok=True)
    return int(attributes["cycles_done"])


def _write(path: Path, batch: Mapping[str, np.ndarray], start: int) -> None:
    import zarr

    # A chunk that is missing is then one that was lost.
    with zarr.config.set({"array.write_empty_chunks": True}):
        group = zarr.open_group(str(path), mode="r+", zarr_format=3)
        for name, values in batch.items():
            array = group[name]
            assert isinstance(array, zarr.Array)
            array[start : start + len(values)] = values


def _read_attributes(path: Path) -> dict[str, Any]:
    """The attributes of the group of a data set.

    Raises:
        InputError: If it is missing, or not a data set of this format.
    """
    if not os.path.lexists(path):
        raise InputError(f"{path}: no such data set: check the name, or collect it first.")
    try:
        attributes = json.loads((path / "zarr.json").read_text("utf-8"))["attributes"]
        found = attributes.get("format")
        if found == DATASET_FORMAT:
            int(attributes["cycles"]), int(attributes["cycles_done"])
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


def _update_attributes(path: Path, changes: Mapping[str, Any]) -> None:
    """Changes attributes of the group, all or none, after everything written so far."""
    target = path / "zarr.json"
    document = json.loads(target.read_text("utf-8"))
    document["attributes"].update(changes)
    beside = path / ".zarr.json.partial"
    with beside.open("w", encoding="utf-8") as file:
        json.dump(document, file, indent=2)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, target)


def versions() -> dict[str, str]:
    """Versions of the packages that decide the numbers."""
    return {name: importlib.metadata.version(name) for name in ("wlplan", "jax", "numpy")}


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Keeps two processes from writing the same data set; a lock of a dead process is taken over.

    Raises:
        InputError: If a running process holds it.
    """
    lock = path.with_name(f"{path.name}.lock")
    mine = f"{os.getpid()} {_start_of(os.getpid())} {socket.gethostname()}"
    for attempt in itertools.count():
        try:
            handle = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            holder = ""
            with contextlib.suppress(OSError):
                holder = lock.read_text("utf-8")
            if _is_alive(holder) or attempt > 2:
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
        lock.unlink(missing_ok=True)


def _is_alive(holder: str) -> bool:
    """Whether the process that wrote a lock still runs, as far as can be told."""
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


# --- reading


def open_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Reads a complete data set into memory, 27 kB a cycle.

    Raises:
        InputError: If it is missing, not complete, damaged, or of another format.
    """
    import zarr

    path = Path(path)
    attributes = _read_attributes(path)
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
            array = group[name]
            if not isinstance(array, zarr.Array) or array.nchunks_initialized < array.nchunks:
                raise ValueError(f"parts of {name} are missing")
            columns[name] = np.asarray(array[...])
            if columns[name].shape != (cycles, *variable.shape):
                raise ValueError(f"{name} has shape {columns[name].shape}")
    except Exception as error:
        # Damaged chunks make the decoders raise almost anything; to the user it means the same.
        what = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: is damaged ({what}): copy or collect it again.") from error
    return Dataset(**columns, attributes=attributes)


def fingerprint(dataset: Dataset) -> str:
    """A hash of all arrays of a data set; the attributes do not count."""
    total = hashlib.sha256()
    for name in VARIABLES:
        values = np.ascontiguousarray(getattr(dataset, name))
        total.update(f"{name} {values.dtype} {values.shape};".encode())
        total.update(values.data)
    return f"sha256:{total.hexdigest()}"


def split(
    dataset: Dataset, *, seed: int = 0, fractions: tuple[float, ...] = (0.8, 0.1, 0.1)
) -> tuple[Dataset, ...]:
    """Splits a data set at random into parts that share no rollout.

    Cycles of one rollout resemble each other: they dig the same pile. Split by cycle, a test set
    would not tell how a model does on a pile that it has not seen.

    Args:
        dataset: Data set to split.
        seed: Seed of the choice.
        fractions: Size of each part over their sum; by default training, validation and test.

    Raises:
        InputError: If there are fewer rollouts than parts.
    """
    if not fractions or min(fractions) <= 0.0 or not math.isfinite(sum(fractions)):
        raise InputError(f"The fractions of the split are {fractions}: they have to be positive.")
    rollouts = np.unique(dataset.rollout)
    parts = len(fractions)
    if len(rollouts) < parts:
        raise InputError(
            f"The data set has {len(rollouts)} rollouts, too few for {parts} parts that share "
            f"none: collect at least {parts * LOADS} cycles."
        )
    order = np.random.default_rng(seed).permutation(rollouts)
    # Each part has one rollout for a start, the rest is shared out by the fractions.
    share = np.cumsum(fractions) / sum(fractions) * (len(rollouts) - parts)
    ends = np.rint(share).astype(int) + np.arange(1, parts + 1)
    return tuple(
        dataset.select(np.isin(dataset.rollout, chosen)) for chosen in np.split(order, ends[:-1])
    )


def reflect(maps: Float[np.ndarray, "*n i j"]) -> Float[np.ndarray, "*n i j"]:
    """Local heightmaps of the mirrored pile, left for right. Paper, section 6.4."""
    return maps[..., ::-1]


@no_type_check
class Normaliser(struct.PyTreeNode):
    """Maps the range of the training data to [0, 1], component by component. Paper, section 6.4."""

    low: Float[Array, " k"]
    span: Float[Array, " k"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n k"]) -> Normaliser:
        """The normaliser of a table; a component that never changes is only shifted."""
        low = values.min(axis=0)
        span = values.max(axis=0) - low
        return cls(jnp.asarray(low), jnp.asarray(np.where(span > 0.0, span, np.ones_like(span))))

    def normalise(self, values: Float[Array, " k"]) -> Float[Array, " k"]:
        """One vector in units of the range; outside it the units go on linearly."""
        return (values - self.low) / self.span

    def denormalise(self, values: Float[Array, " k"]) -> Float[Array, " k"]:
        """The inverse of `normalise`."""
        return self.low + values * self.span
