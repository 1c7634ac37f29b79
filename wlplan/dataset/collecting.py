"""Collecting: simulate what is missing of a data set and store it."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

from wlplan.dataset import store
from wlplan.dataset.layout import Layout
from wlplan.dataset.protocols import PROTOCOLS
from wlplan.dataset.variables import LOADS
from wlplan.dataset.worker_pool import CollectionSettings, collect_batches
from wlplan.engines.simulator import Simulator
from wlplan.errors import InputError, one_line

_SIMULATOR = Simulator()


def collect(
    path: str | os.PathLike[str],
    *,
    cycles: int,
    seed: int = 0,
    protocol: str = "paper",
    shard: tuple[int, int] | None = None,
    simulator: Simulator = _SIMULATOR,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Simulates loading cycles and stores them; continues where an earlier call stopped.

    A data set of more cycles is a longer series of the same episodes. Cycles are written batch by
    batch; what was written stays intact whatever happens to the process.

    A shard is a part of a data set that is collected on its own, with the same cycles as in the
    whole; `merge` joins shards.

    Args:
        path: Directory of the data set, a zarr (version 3) group; by custom it ends in `.zarr`.
            Missing directories above it are made.
        cycles: Number of loading cycles, of all shards together; the last episode is cut short to
            meet it.
        seed: Seed of piles, poses and actions.
        protocol: Where is dug, one of `PROTOCOLS`.
        shard: Which part to collect, counted from 1, and how many there are; None: everything.
        simulator: The simulator with its machine and soil.
        progress: Called with the number of cycles so far and in all, of the shard if it is
            one.

    Raises:
        InputError: If there is no such shard, or it would be empty; if the path holds something
            else or a data set of another seed, protocol, number of cycles, shard or simulator; if
            another process writes it; or if it cannot be written.
    """
    path = Path(path)
    layout = Layout(cycles, shard)
    if seed < 0:
        raise InputError(f"The seed is {seed}: it has to be 0 or more.")
    if protocol not in PROTOCOLS:
        raise InputError(f"Unknown protocol {protocol!r}: choose one of {', '.join(PROTOCOLS)}.")
    done = 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)  # the lock goes there
        with store.lock(path):
            wanted = store.identity(layout, seed, protocol, simulator)
            if store.is_new(path):
                store.create(path, layout, wanted)
            done = store.resume(path, wanted)
            if progress is not None:
                progress(done, layout.size)
            start = layout.first + done
            settings = CollectionSettings(simulator, seed, layout.loads, LOADS, protocol)
            with contextlib.closing(collect_batches(layout, start, settings, progress)) as batches:
                for batch in batches:
                    store.write(path, batch, done)
                    done += len(batch["mass"])
                    store.update_attributes(path, {"cycles_done": done})
    except OSError as error:
        reason = one_line(error.strerror or error)
        advice = "free some space" if error.errno == errno.ENOSPC else "choose another place"
        if done:
            advice += (
                f"; {done} of {layout.size} cycles are safe, the same command continues from there"
            )
        raise InputError(f"{path}: cannot be written ({reason}): {advice}.") from error
