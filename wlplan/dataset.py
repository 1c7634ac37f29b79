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
import queue
import shlex
import shutil
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from wlplan.automaton import relax
from wlplan.characteristics import as_vector, characteristics
from wlplan.compilation import cores
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
from wlplan.simulator.cycle import State, advance, begin, outcome
from wlplan.types import Action, Characteristics, Pile, Pose
from wlplan.units import ACTION_HIGH, ACTION_LOW, CELL_SIZE, J_PER_KJ

DATASET_FORMAT = "wlplan.dataset/1"

LOADS = 30
"""Consecutive loadings of a rollout. Paper, section 6.2."""

# Largest deviation of the heading from the normal of the toe [rad]. Paper, section 6.2.
_HEADING_SPREAD = math.radians(10.0)
# Rollouts that are written as one batch: one chunk of every variable, 19 MB of the largest.
_BATCH = 60
# Cycles that one thread computes side by side. Of half as many a time step takes 1.4 times as long
# a cycle, of twice as many no less; more leave more idle when the last rollouts are played.
_SLOTS = 32
# Time steps after which ended cycles make room for others. A cycle takes about 170 and waits half
# of these; more of them make fewer calls.
_STEPS = 10

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
    def batch_cycles(self) -> int:
        """Cycles that are written at once."""
        return min(_BATCH * LOADS, self.cycles)


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
            Missing directories above it are made.
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
        path.parent.mkdir(parents=True, exist_ok=True)  # the lock goes there
        with _lock(path):
            wanted = _identity(cycles, seed, simulator)
            if _is_new(path):
                _create(path, layout, wanted)
            done = _resume(path, wanted)
            if progress is not None:
                progress(done, cycles)
            with contextlib.closing(_batches(layout, done, seed, simulator, progress)) as batches:
                for batch in batches:
                    _write(path, batch, done)
                    done += len(batch["mass"])
                    _update_attributes(path, {"cycles_done": done})
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        advice = "free some space" if error.errno == errno.ENOSPC else "choose another place"
        if done:
            advice += f"; {done} of {cycles} cycles are safe, the same command goes on from there"
        raise InputError(f"{path}: cannot be written ({reason}): {advice}.") from error


def _batches(
    layout: _Layout,
    start: int,
    seed: int,
    simulator: Simulator,
    progress: Callable[[int, int], None] | None,
) -> Generator[dict[str, np.ndarray]]:
    """The variables of one batch of cycles after the other, from cycle `start` on."""
    numbers = range(start // LOADS, layout.rollouts)
    waiting, finished = iter(numbers), queue.SimpleQueue[Any]()
    lock, stopped = threading.Lock(), threading.Event()

    def take() -> _Rollout | None:
        with lock:
            number = None if stopped.is_set() else next(waiting, None)
        return None if number is None else _Rollout(number, seed, layout.loads, simulator)

    def work() -> None:
        try:
            _Bench(simulator, take, finished.put, stopped).run()
        except BaseException as error:
            finished.put(error)

    workers = [
        threading.Thread(target=work, name="collect", daemon=True)
        for _ in range(min(cores(), len(numbers)))
    ]
    # Alone, so that the programs are compiled once.
    if numbers:
        _compile(simulator)
    for worker in workers:
        worker.start()
    try:
        yield from _in_order(layout, start, finished, progress)
    finally:
        stopped.set()
        for worker in workers:
            worker.join()


def _in_order(
    layout: _Layout,
    start: int,
    finished: queue.SimpleQueue[Any],
    progress: Callable[[int, int], None] | None,
) -> Iterator[dict[str, np.ndarray]]:
    """Puts rollouts together to batches as they are finished, in whatever order they are.

    Args:
        layout: Portions of the collection.
        start: First cycle.
        finished: Loadings that are played as None, rollouts that are finished, and errors.
        progress: As for `collect`.
    """
    rollouts: dict[int, _Rollout] = {}
    played = start
    while start < layout.cycles:
        stop = min(start + layout.batch_cycles, layout.cycles)
        numbers = range(start // LOADS, math.ceil(stop / LOADS))
        while not all(number in rollouts for number in numbers):
            news = finished.get()
            if isinstance(news, BaseException):
                raise news
            if news is None:
                played += 1
                if progress is not None:
                    # Those of the last rollout that are cut off do not count.
                    progress(min(played, layout.cycles), layout.cycles)
            else:
                rollouts[news.number] = news
        parts = [rollouts.pop(number).records() for number in numbers]
        yield {n: np.concatenate([p[n] for p in parts])[: stop - start] for n in VARIABLES}
        start = stop


class _Rollout:
    """A pile, what is random about digging it, and the loadings so far."""

    def __init__(self, number: int, seed: int, loads: int, simulator: Simulator):
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
        self.loads = loads
        self.simulator = simulator
        self.pose = np.zeros(3, np.float32)
        self.valid = False
        self.played: list[dict[str, Any]] = []

    def heap(self) -> None:
        """Makes the pile; apart from the random numbers, for it takes time."""
        shape = _grid_shape()
        kind, slope = SEED_PILES[self.seed_pile]
        pile = seed_pile(kind, slope=slope, seed=self.noise_seed)
        self.height = _relaxer(self.simulator.soil.repose_angle)(_on_grid(pile, shape)).height
        self.origin = _origin()

    @property
    def load(self) -> int:
        """Number of the next loading."""
        return len(self.played)

    def prepare(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose and action of the next loading."""
        pile = Pile(self.height, CELL_SIZE, self.origin)
        pose = choose_pose(pile, self.place[self.load], self.turn[self.load])
        self.valid = pose is not None
        # A pile that is used up is dug where it was dug last; `valid` tells.
        self.pose = self.pose if pose is None else pose
        return self.pose, self.action[self.load]

    def take_in(self, height: Array, record: dict[str, Array]) -> None:
        """The surface after the loading and its simulated variables."""
        self.height = height
        known = {
            "action": self.action[self.load],
            "pose": self.pose,
            "valid": self.valid,
            "rollout": self.number,
            "seed_pile": self.seed_pile,
            "load": self.load,
        }
        self.played.append(jax.tree.map(np.asarray, record) | known)

    def records(self) -> dict[str, np.ndarray]:
        """The variables of all loadings."""
        return {
            name: np.stack([load[name] for load in self.played]).astype(variable.dtype)
            for name, variable in VARIABLES.items()
        }


class _Bench:
    """One thread's rollouts: their cycles are computed side by side, each at its own stage.

    A cycle that has ended makes room for the next of its rollout at once, and a rollout for
    another; so none waits for the slowest. What comes of a rollout does not depend on the others.

    Args:
        simulator: The simulator.
        take: Gives the next rollout; None when there are no more.
        put: Takes None for each loading played, and each rollout when it is finished.
        stopped: Set when the rest is no longer wanted.
    """

    def __init__(
        self,
        simulator: Simulator,
        take: Callable[[], _Rollout | None],
        put: Callable[[_Rollout | None], None],
        stopped: threading.Event,
    ):
        self.programs, self.take, self.put, self.stopped = _programs(simulator), take, put, stopped
        self.state = _nothing(simulator)
        self.slots: list[_Rollout | None] = [None] * _SLOTS
        self.views: list[Array] = [jnp.zeros(0)] * _SLOTS

    def run(self) -> None:
        """Plays rollouts until there are no more."""
        for slot in range(_SLOTS):
            self._fill(slot)
        while any(self.slots) and not self.stopped.is_set():
            self.state, ended = self.programs.advance(self.state)
            for slot, has_ended in enumerate(np.asarray(ended).tolist()):
                if has_ended and self.slots[slot] is not None:
                    self._empty(slot)

    def _fill(self, slot: int) -> None:
        """Puts the next loading of a slot's rollout there, or the first of another."""
        rollout = self.slots[slot]
        if rollout is None:
            rollout = self.slots[slot] = self.take()
            if rollout is None:
                return
            rollout.heap()
        pose, action = rollout.prepare()
        self.state, self.views[slot] = self.programs.enter(
            self.state, slot, rollout.origin, rollout.height, pose, action
        )

    def _empty(self, slot: int) -> None:
        """Writes a loading back to its pile and goes on."""
        rollout = self.slots[slot]
        assert rollout is not None
        height, record = self.programs.leave(
            self.state, slot, rollout.origin, rollout.height, rollout.pose, self.views[slot]
        )
        rollout.take_in(height, record)
        self.put(None)
        if rollout.load == rollout.loads:
            self.put(rollout)
            self.slots[slot] = None
        self._fill(slot)


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


def _begin(simulator: Simulator, height: Array, action: Action) -> State:
    """Cycles about to begin, leaves with the cycles as their last axis."""
    return begin(height, jnp.zeros_like(height), action, simulator.machine)


def _nothing(simulator: Simulator) -> State:
    """A full set of slots in which nothing goes on."""
    zero = jnp.zeros(_SLOTS, jnp.float32)
    height = jnp.zeros((STATE_CELLS, STATE_CELLS, _SLOTS), jnp.float32)
    return _begin(simulator, height, Action(zero, zero, zero, zero)).ended()


def _advance(simulator: Simulator, state: State) -> tuple[State, Bool[Array, " b"]]:
    """Some time steps further, and which cycles have ended."""
    state = advance(
        state,
        machine=simulator.machine,
        soil=simulator.soil,
        settings=simulator.settings,
        steps=_STEPS,
    )
    return state, state.has_ended


def _enter(
    simulator: Simulator,
    state: State,
    slot: Int[Array, ""] | int,
    origin: Float[Array, "2"],
    height: Float[Array, "nx ny"],
    pose: Float[Array, "3"] | np.ndarray,
    action: Float[Array, "4"] | np.ndarray,
) -> tuple[State, Float[Array, "52 52"]]:
    """The slots with a new loading in one of them, and its surface in the local frame."""
    view, _ = simulator.view(Pile(height, CELL_SIZE, origin), Pose(*pose))
    one = _begin(simulator, view[..., None], Action(*(part[None] for part in action)))
    return jax.tree.map(lambda all_, new: all_.at[..., slot].set(new[..., 0]), state, one), view


def _leave(
    simulator: Simulator,
    state: State,
    slot: Int[Array, ""] | int,
    origin: Float[Array, "2"],
    height: Float[Array, "nx ny"],
    pose: Float[Array, "3"] | np.ndarray,
    view: Float[Array, "52 52"],
) -> tuple[Float[Array, "nx ny"], dict[str, Array]]:
    """The surface after the loading of one slot, and the simulated variables."""
    one = jax.tree.map(lambda all_: all_[..., slot][..., None], state)
    cycles = outcome(one, machine=simulator.machine, soil=simulator.soil)
    cycle = jax.tree.map(lambda part: part[..., 0], cycles)
    pile, dig_pose = Pile(height, CELL_SIZE, origin), Pose(*pose)
    after, performance = simulator.leave(pile, dig_pose, view, cycle)
    h36 = sample_local(pile, dig_pose)
    h52 = sample_local(pile, dig_pose, cells=STATE_CELLS, displacement=STATE_DISPLACEMENT).height
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


class _Programs(NamedTuple):
    """`_advance`, `_enter` and `_leave` of one simulator, compiled."""

    advance: Callable[..., tuple[State, Bool[Array, " b"]]]
    enter: Callable[..., tuple[State, Float[Array, "52 52"]]]
    leave: Callable[..., tuple[Float[Array, "nx ny"], dict[str, Array]]]


@functools.cache
def _programs(simulator: Simulator) -> _Programs:
    # Bound to their simulator, for JAX takes 0.2 ms a call to look at it.
    bound = (functools.partial(function, simulator) for function in (_advance, _enter, _leave))
    return _Programs(*map(jax.jit, bound))


def _compile(simulator: Simulator) -> None:
    """Compiles what the threads run."""
    programs = _programs(simulator)
    shape, pose = _grid_shape(), np.zeros(3, np.float32)
    flat = jnp.zeros(shape, jnp.float32)
    _relaxer(simulator.soil.repose_angle)(Pile(flat, CELL_SIZE, _origin()))
    action = np.zeros(4, np.float32)
    state, view = programs.enter(_nothing(simulator), 0, _origin(), flat, pose, action)
    state, _ = programs.advance(state)
    programs.leave(state, 0, _origin(), flat, pose, view)


@functools.cache
def _grid_shape() -> tuple[int, int]:
    """The smallest grid that holds each of the seed piles [cells]."""
    shapes = [seed_pile(kind, slope=slope, noise=0.0).height.shape for kind, slope in SEED_PILES]
    nx, ny = np.max(shapes, axis=0)
    return int(nx), int(ny)


def _origin() -> Float[Array, "2"]:
    """Centre of the first cell of the grid; that of the grid is the world origin [m]."""
    return jnp.asarray(-0.5 * CELL_SIZE * (np.array(_grid_shape(), np.float32) - 1.0))


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
