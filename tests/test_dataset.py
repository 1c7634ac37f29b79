"""Laws of the collection: what is stored, resuming, splits, and what bad stores are told."""

import contextlib
import dataclasses
import errno
import functools
import importlib.machinery
import itertools
import json
import math
import os
import queue
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import zarr

from wlplan import cli
from wlplan.actions import latin_hypercube
from wlplan.constants import ACTION_HIGH, ACTION_LOW, CELL_SIZE
from wlplan.dataset import (
    VARIABLES,
    Dataset,
    collect,
    collecting,
    episode,
    fingerprint,
    layout,
    merge,
    merging,
    open_dataset,
    reflect,
    split,
    vector_simulator,
    worker_pool,
)
from wlplan.dataset import store as stored
from wlplan.dataset.episode import Episode, choose_pose
from wlplan.dataset.layout import Layout
from wlplan.dataset.worker import simulator_from_json
from wlplan.dataset.worker_pool import CollectionSettings, FinishedEpisode, WorkerProcess
from wlplan.engines.simulator import STOP_REASONS, Simulator
from wlplan.engines.simulator.cycle import Settings
from wlplan.errors import InputError
from wlplan.io import provenance
from wlplan.models.normaliser import Normaliser
from wlplan.site.machine import WA320
from wlplan.site.soil import GRAVEL
from wlplan.terrain.automaton import Schedule
from wlplan.terrain.heightmap import sample_local
from wlplan.terrain.seed_piles import SEED_PILES, seed_pile
from wlplan.types import Pile, Pose

CYCLES, SEED = 11, 5
# Three batches.
LONGER = 17


@pytest.fixture(scope="module", autouse=True)
def _short_episodes() -> Iterator[None]:
    """Episodes of 3 loadings, two a batch: 11 cycles make two batches."""
    with pytest.MonkeyPatch.context() as patch:
        for part in (layout, episode, worker_pool, collecting, stored):
            patch.setattr(part, "LOADS", 3)
        patch.setattr(layout, "_BATCH", 2)
        yield


@pytest.fixture(scope="module", autouse=True)
def kept_workers() -> Iterator[list[WorkerProcess]]:
    """All workers of this module; they stay from one collection to the next, so compile once."""
    kept: list[WorkerProcess] = []

    @contextlib.contextmanager
    def pool(count: int) -> Iterator[list[WorkerProcess]]:
        kept.extend(WorkerProcess() for _ in range(count - len(kept)))
        yield kept[:count]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker_pool, "worker_pool", pool)
        yield kept
    for worker in kept:
        worker.close()


@pytest.fixture
def worker(kept_workers: list[WorkerProcess], store: Path) -> WorkerProcess:
    """A worker that has compiled before."""
    return kept_workers[0]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset") / "data.zarr"
    seen = []
    collect(path, cycles=CYCLES, seed=SEED, progress=lambda done, total: seen.append((done, total)))
    assert seen[0] == (0, CYCLES)
    assert seen[-1] == (CYCLES, CYCLES)
    assert seen == sorted(seen)
    return path


@pytest.fixture(scope="module")
def data(store: Path) -> Dataset:
    return open_dataset(store)


@pytest.fixture
def copy(store: Path, tmp_path: Path) -> Path:
    return shutil.copytree(store, tmp_path / "copy.zarr")


def contents(path: Path) -> dict[Path, bytes]:
    """Every file of a store by name."""
    return {p.relative_to(path): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def contents_but_command(path: Path) -> tuple[dict[Path, bytes], str]:
    """`contents`, without the words that the processes were started with."""
    found = contents(path)
    document = json.loads(found.pop(Path("zarr.json")))
    del document["attributes"]["command"]
    return found, json.dumps(document)


@pytest.fixture(scope="module")
def longer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("longer") / "data.zarr"
    collect(path, cycles=LONGER, seed=SEED)
    return path


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> dict[int, list[Path]]:
    """Number of shards -> all of them."""
    folder = tmp_path_factory.mktemp("shards")
    made = {n: [folder / f"{i}-of-{n}.zarr" for i in range(1, n + 1)] for n in (2, 3)}
    for n, paths in made.items():
        for i, path in enumerate(paths, 1):
            collect(path, cycles=LONGER, seed=SEED, shard=(i, n))
    return made


@pytest.fixture
def parts(shards: dict[int, list[Path]], tmp_path: Path) -> list[Path]:
    """Three shards to spoil."""
    return [shutil.copytree(path, tmp_path / "parts" / path.name) for path in shards[3]]


def numbered(rollouts: int, loads: int = 3) -> Dataset:
    """A data set of zeros, but for the number of the rollout."""
    n = rollouts * loads
    columns = {name: np.zeros((n, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    columns["rollout"] = np.repeat(np.arange(rollouts, dtype=np.int32), loads)
    return Dataset(**columns, attributes={})


def forget(path: Path, name: str) -> None:
    """Takes a variable out of a store, as if it had never been there."""
    shutil.rmtree(path / name)
    document = json.loads((path / "zarr.json").read_text())
    del document["consolidated_metadata"]["metadata"][name]
    (path / "zarr.json").write_text(json.dumps(document))


def refused(call: Callable[[], object], *words: str) -> None:
    with pytest.raises(InputError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    assert len(message) > 20
    for word in words:
        assert word in message


# --- what is stored


def test_every_cycle_is_there_and_in_order(data: Dataset) -> None:
    assert len(data) == CYCLES
    assert data.rollout.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3]
    assert data.load.tolist() == [0, 1, 2] * 3 + [0, 1]
    np.testing.assert_array_equal(data.seed_pile, data.rollout % len(SEED_PILES))
    assert data.valid.all()


def test_the_outcomes_are_those_of_loading_cycles(data: Dataset) -> None:
    for name in ("mass", "time", "work", "fill_time"):
        assert np.all(getattr(data, name) > 0.0)
    assert np.all(data.mass < 6.0)
    assert np.all(data.fill_time < data.time)
    assert np.all((data.work_slip >= 0.0) & (data.work_slip < data.work))
    assert np.all((data.stop_reason >= 0) & (data.stop_reason < len(STOP_REASONS)))
    assert all(np.isfinite(getattr(data, name)).all() for name in VARIABLES)


def test_the_actions_fill_their_box(data: Dataset) -> None:
    assert np.all((data.action >= ACTION_LOW) & (data.action <= ACTION_HIGH))
    # One hypercube over the 6 x 3 loadings of a set: no two cycles share a slice.
    slices = np.floor(data.action / ACTION_HIGH * len(SEED_PILES) * 3)
    assert all(len(np.unique(column)) == CYCLES for column in slices.T)


def test_the_maps_begin_at_the_reference_and_the_change_is_local(data: Dataset) -> None:
    # The centre line lies between two columns.
    assert np.all(np.abs(data.h36[:, 0, 17:19].mean(axis=1)) < 0.05)
    assert np.all(np.abs(data.h52[:, 0, 25:27]) < 0.05)
    moved = data.h52_after != data.h52
    assert 0.02 < moved.mean() < 0.9
    assert np.abs(data.h52_after - data.h52).max() < 1.5


def test_the_smaller_map_after_is_a_part_of_the_larger(data: Dataset) -> None:
    level = data.h36[:, 0, 0] - data.h52[:, 10, 8]
    part = data.h52_after[:, 10:46, 8:44] + level[:, None, None]
    np.testing.assert_allclose(data.h36_after, part, atol=1e-5)
    np.testing.assert_allclose(data.h36, data.h52[:, 10:46, 8:44] + level[:, None, None], atol=1e-5)
    # Most of the load comes from it.
    lost = (data.h36 - data.h36_after).sum(axis=(1, 2)) * CELL_SIZE**2 * GRAVEL.density / 1000.0
    assert np.median(lost / data.mass) > 0.6


def test_the_volume_that_the_map_loses_is_about_the_load(data: Dataset) -> None:
    lost = (data.h52 - data.h52_after).sum(axis=(1, 2)) * CELL_SIZE**2 * GRAVEL.density / 1000.0
    # Soil slides into the map from above it, so a part of the load shows outside.
    assert np.all(lost < 1.05 * data.mass + 0.1)
    assert np.median(lost / data.mass) > 0.7


def simulated(episode: Episode) -> Episode:
    """An episode after all its loadings, with no other beside it."""
    episodes = iter([episode])
    finished: list[Episode | None] = []
    vector_simulator.VectorSimulator(
        Simulator(), lambda: next(episodes, None), finished.append, threading.Event()
    ).run()
    assert finished == [None] * episode.loads + [episode]
    return episode


def test_an_episode_does_not_depend_on_those_beside_it(
    data: Dataset, worker: WorkerProcess
) -> None:
    for number in (0, 2):
        numbers = iter([number])
        finished: list[Any] = []
        settings = CollectionSettings(Simulator(), SEED, 3, 3)
        worker.simulate(settings, functools.partial(next, numbers, None), finished.append)
        *loadings, (found, alone) = finished
        assert loadings == [None] * 3
        assert found == number
        for name in VARIABLES:
            np.testing.assert_array_equal(alone[name], getattr(data, name)[data.rollout == number])


def test_what_left_the_grid_is_the_load() -> None:
    episode = Episode(3, SEED, 1, Simulator())
    episode.reset()
    before, origin = episode.height, episode.origin
    after = simulated(episode).height
    record = {name: values[0] for name, values in episode.records().items()}
    lost = np.sum(np.asarray(before - after, np.float64)) * CELL_SIZE**2
    assert lost * GRAVEL.density / 1000.0 == pytest.approx(float(record["mass"]), rel=1e-3)
    # The map after is the sampled pile after, over the reference of the map before.
    dug = Pile(after, CELL_SIZE, origin)
    where = Pose(*(jnp.asarray(value) for value in record["pose"]))
    want = sample_local(dug, where, cells=52, displacement=1.0).height
    got = record["h52_after"]
    offset = (got - want)[:4, :4].mean()  # at the level ground behind the dig location
    np.testing.assert_allclose(got - offset, want, atol=1e-4)
    smaller = record["h36_after"] - sample_local(dug, where).height
    np.testing.assert_allclose(smaller, smaller[0, 0], atol=1e-4)


def test_another_seed_gives_other_cycles_and_a_longer_collection_begins_alike() -> None:
    first, again, other = (Episode(3, seed, 3, Simulator()) for seed in (0, 0, 1))
    assert first.noise_seed == again.noise_seed != other.noise_seed
    np.testing.assert_array_equal(first.action, again.action)
    assert not np.any(first.place == other.place)
    headings = np.concatenate([Episode(n, 0, 3, Simulator()).turn for n in range(60)])
    assert np.abs(headings).max() <= math.radians(10.0)
    assert headings.std() == pytest.approx(math.radians(20.0) / math.sqrt(12.0), rel=0.1)


@pytest.mark.slow
def test_a_corridor_is_dug_on_where_it_was_dug_before(worker: WorkerProcess) -> None:
    def nearest(protocol: str) -> tuple[float, list[np.ndarray]]:
        """Median distance of a loading from the nearest before it."""
        finished: list[FinishedEpisode | None] = []
        settings, numbers = CollectionSettings(Simulator(), SEED, 12, 12, protocol), iter([0, 1])
        worker.simulate(settings, lambda: next(numbers, None), finished.append)
        episodes = sorted(episode for episode in finished if episode is not None)
        poses = [episode.records["pose"][:, :2] for episode in episodes]
        distances = [
            np.linalg.norm(pose[:k] - pose[k], axis=1).min() for pose in poses for k in range(1, 12)
        ]
        return np.median(distances), poses

    (close, dug), (far, paper) = nearest("corridor"), nearest("paper")
    assert close < 0.5 * far
    # Piles, first places and actions are the same.
    for one, other in zip(dug, paper, strict=True):
        np.testing.assert_array_equal(one[0], other[0])


def test_slow_loadings_are_followed_by_ones_with_similar_actions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The law of the protocol, with the fillings made up: every fourth is slow."""
    monkeypatch.setattr(episode, "choose_pose", lambda *_: np.zeros(3, np.float32))
    span = np.subtract(ACTION_HIGH, ACTION_LOW)
    steps, fresh, count = [], 0, 0
    for number in range(60):
        mine, papers = (
            Episode(number, SEED, 30, Simulator(), length=30, protocol=name)
            for name in ("slow", "paper")
        )
        mine.height, mine.origin = jnp.zeros((4, 4)), jnp.zeros(2)
        last = None
        for load in range(30):
            _, action = mine.next_loading()
            assert (action >= np.asarray(ACTION_LOW, np.float32)).all()
            assert (action <= np.asarray(ACTION_HIGH, np.float32)).all()
            new = np.array_equal(action, papers.action[load])
            assert new or last is not None  # none was slow: as in the paper's protocol
            if last is not None:
                count += 1
                fresh += new
                # Those at the edge of the range would have gone beyond it.
                low, high = (np.asarray(ends, np.float32) for ends in (ACTION_LOW, ACTION_HIGH))
                inside = (action > low) & (action < high)
                if not new:
                    middle = np.abs(last - np.array(ACTION_LOW) - 0.5 * span) < 0.2 * span
                    steps.extend(((action - last) / span)[inside & middle])
            slow = load % 4 == 1
            if slow:
                last = action.copy()
            mine.loadings.append({"action": action, "fill_time": 4.0 if slow else 3.9})
    deviation = 4.0 * math.sqrt(0.8 * 0.2 / count)
    assert fresh / count == pytest.approx(0.2, abs=deviation)
    # Three spreads from the edges, so what is cut off there does not count.
    assert np.mean(steps) == pytest.approx(0.0, abs=4.0 * 0.1 / math.sqrt(len(steps)))
    assert np.std(steps) == pytest.approx(0.1, rel=4.0 / math.sqrt(2.0 * len(steps)))
    assert len(steps) > 1000


def test_past_the_toe_is_before_and_behind_it_and_aslant(monkeypatch: pytest.MonkeyPatch) -> None:
    """The law of the protocol: where a loading begins lies on its heading, near its place there."""
    asked: list[np.ndarray | None] = []
    turned: list[float] = []

    def choose(pile: Pile, place: float, turn: float, near: np.ndarray | None) -> np.ndarray:
        asked.append(near)
        turned.append(turn)
        return np.array([2.0, 3.0, 1.0 + turn], np.float32)

    monkeypatch.setattr(episode, "choose_pose", choose)
    ahead = []
    for number in range(60):
        mine = Episode(number, SEED, 30, Simulator(), length=30, protocol="past-toe")
        mine.height, mine.origin = jnp.zeros((4, 4)), jnp.zeros(2)
        for _ in range(30):
            pose, _ = mine.next_loading()
            c, s = np.cos(pose[2]), np.sin(pose[2])
            dx, dy = pose[:2] - (2.0, 3.0)
            assert abs(dy * c - dx * s) < 1e-5
            ahead.append(dx * c + dy * s)
            mine.loadings.append({"action": pose, "fill_time": 0.0})
    for values, most in ((ahead, 1.0), (turned, math.radians(45.0))):
        assert np.abs(values).max() <= most * (1.0 + 1e-5)
        assert np.std(values) == pytest.approx(most / math.sqrt(3.0), rel=0.1)
    # The first of an episode is anywhere.
    assert np.mean([near is None for near in asked]) == pytest.approx(1 - 0.85 * 29 / 30, abs=0.03)


@pytest.mark.slow
def test_up_to_the_first_slow_loading_the_protocol_is_the_papers(worker: WorkerProcess) -> None:
    def episodes(protocol: str) -> list[FinishedEpisode]:
        finished: list[FinishedEpisode | None] = []
        settings, numbers = CollectionSettings(Simulator(), SEED, 20, 20, protocol), iter([0, 1])
        worker.simulate(settings, lambda: next(numbers, None), finished.append)
        return sorted(episode for episode in finished if episode is not None)

    followed = 0
    for mine, papers in zip(episodes("slow"), episodes("paper"), strict=True):
        slow = np.flatnonzero(mine.records["fill_time"] >= episode._SLOW_FILLING)
        first = slow[0] if len(slow) else 19
        for name in ("action", "pose", "mass"):
            np.testing.assert_array_equal(
                mine.records[name][: first + 1], papers.records[name][: first + 1]
            )
        followed += (
            mine.records["action"][first + 1 :] != papers.records["action"][first + 1 :]
        ).any()
    assert followed


def test_a_protocol_is_part_of_what_a_data_set_is(copy: Path) -> None:
    refused(lambda: collect(copy, cycles=CYCLES, seed=SEED, protocol="corridor"), "protocol")
    other = lambda: collect(copy, cycles=CYCLES, seed=SEED, protocol="other")  # noqa: E731
    refused(other, "paper, corridor, slow, past-toe")


@pytest.mark.parametrize("cycles", [1, 2, 3, 30, 31, 47, 449, 451, 1801, 10_718, 10_800])
def test_the_batches_make_up_the_cycles(cycles: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("LOADS", 30), ("_BATCH", 60)):
        monkeypatch.setattr(layout, name, value)
    whole = Layout(cycles)
    # A batch starts with an episode, and with a chunk.
    assert whole.batch_cycles == cycles or whole.batch_cycles % 30 == 0


def test_a_hypercube_has_one_point_in_each_slice() -> None:
    points = latin_hypercube(50, 4, np.random.default_rng(0))
    assert points.shape == (50, 4)
    for column in points.T:
        assert sorted(np.floor(50 * column)) == list(range(50))
    # Rows of a Latin hypercube are not sorted along with one another.
    assert np.abs(np.corrcoef(points.T) - np.eye(4)).max() < 0.5


def test_nothing_is_chosen_where_nothing_is_left() -> None:
    flat = Pile(jnp.zeros((60, 60)), CELL_SIZE, jnp.zeros(2))
    assert choose_pose(flat, 0.5, 0.0) is None


@pytest.mark.parametrize("place", [0.0, 0.5, 1.0])
def test_a_pose_heads_into_the_pile(place: float) -> None:
    pile = seed_pile("conical", slope=math.radians(30.0), noise=0.0)
    pose = choose_pose(pile, place, 0.1)
    assert pose is not None
    x, y, heading = pose
    inward = math.atan2(-y, -x)
    assert abs((heading - inward + math.pi) % (2.0 * math.pi) - math.pi) == pytest.approx(
        0.1, abs=0.05
    )


def test_the_store_says_what_it_holds(store: Path) -> None:
    document = json.loads((store / "zarr.json").read_text())
    attributes = document["attributes"]
    assert attributes["format"] == "wlplan.dataset/1"
    assert (attributes["cycles"], attributes["cycles_done"]) == (CYCLES, CYCLES)
    assert attributes["seed"] == SEED
    assert attributes["soil"] == dataclasses.asdict(GRAVEL)
    assert set(attributes["versions"]) == {"wlplan", "jax", "numpy"}
    for name, variable in VARIABLES.items():
        array = json.loads((store / name / "zarr.json").read_text())
        assert array["zarr_format"] == 3
        assert array["dimension_names"] == ["cycle", *variable.dims]
        assert array["attributes"]["units"] == variable.units
        assert array["attributes"]["long_name"]
    assert not store.with_name("data.zarr.lock").exists()


def test_a_data_set_of_a_version_without_the_smaller_map_after_is_read(
    data: Dataset, copy: Path
) -> None:
    forget(copy, "h36_after")
    earlier = open_dataset(copy)
    np.testing.assert_allclose(earlier.h36_after, data.h36_after, atol=1e-6)
    collect(copy, cycles=CYCLES, seed=SEED)
    assert not (copy / "h36_after").exists()
    stored.update_attributes(copy, {"cycles_done": 6})
    refused(lambda: collect(copy, cycles=CYCLES, seed=SEED), "h36_after", "another version")


def test_a_data_set_without_another_variable_is_damaged(copy: Path) -> None:
    forget(copy, "h52_after")
    refused(lambda: open_dataset(copy), "damaged", "h52_after")


# --- going on


@pytest.mark.parametrize("after", [0, 4, 9])
def test_a_collection_that_was_cut_short_ends_with_the_same_bytes(
    store: Path, tmp_path: Path, after: int
) -> None:
    path = tmp_path / "data.zarr"

    def stop(done: int, total: int) -> None:
        if done >= after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(path, cycles=CYCLES, seed=SEED, progress=stop)
    refused(lambda: open_dataset(path), f"of {CYCLES} cycles", "again")
    collect(path, cycles=CYCLES, seed=SEED)
    assert contents(path) == contents(store)


def test_missing_directories_above_are_made(tmp_path: Path) -> None:
    path = tmp_path / "not" / "yet" / "data.zarr"

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(path, cycles=CYCLES, seed=SEED, progress=stop)
    assert [entry.name for entry in path.parent.iterdir()] == ["data.zarr"]


@pytest.mark.parametrize("cores", [1, 3])
def test_the_number_of_cores_does_not_show(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    monkeypatch.setattr(worker_pool, "cores", lambda: cores)
    collect(tmp_path / "data.zarr", cycles=CYCLES, seed=SEED)
    assert contents(tmp_path / "data.zarr") == contents(store)


def test_what_goes_wrong_in_a_worker_is_not_lost(worker: WorkerProcess) -> None:
    settings = CollectionSettings(Simulator(), -1, 3, 3)
    numbers = iter([0])
    with pytest.raises(RuntimeError, match="non-negative"):
        worker.simulate(settings, lambda: next(numbers, None), lambda _: None)
    # It is as good as before.
    worker.simulate(dataclasses.replace(settings, seed=0), lambda: None, lambda _: None)


def test_the_end_of_a_worker_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workers = []

    @contextlib.contextmanager
    def pool(count: int) -> Iterator[list[WorkerProcess]]:
        workers.append(WorkerProcess())
        try:
            yield workers
        finally:
            workers[0].close()

    def kill(layout: Layout, start: int, news: queue.SimpleQueue[Any], progress: object) -> None:
        workers[0].process.kill()
        raise news.get()

    monkeypatch.setattr(worker_pool, "cores", lambda: 1)
    monkeypatch.setattr(worker_pool, "worker_pool", pool)
    monkeypatch.setattr(worker_pool, "_in_order", kill)
    refused(lambda: collect(tmp_path / "data.zarr", cycles=CYCLES), "exit code -9", "continues")
    assert "collect" not in [thread.name for thread in threading.enumerate()]


def test_a_worker_ends_with_its_collector() -> None:
    """Whatever way that ends: all it sees is the end of its input."""
    worker = WorkerProcess()
    assert worker.process.stdin is not None
    assert worker.process.stdout is not None
    worker.process.stdin.close()
    assert worker.process.wait(timeout=300.0) == 0
    worker.process.stdout.close()


@pytest.mark.parametrize("relative", [False, True])
def test_a_worker_imports_nothing_from_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, relative: bool
) -> None:
    """Whatever lies there: modules of Python, of a dependency, of the package itself."""
    for name in ("queue", "json", "numpy", "importlib", "encodings", "wlplan", "sitecustomize"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w').close()\nraise SystemExit(3)\n")
    monkeypatch.chdir(tmp_path)
    if relative:  # as in `python -c`, begun in another folder
        monkeypatch.setattr(sys, "path", ["", ".", *sys.path])
    worker = WorkerProcess()
    try:
        worker.simulate(CollectionSettings(Simulator(), 0, 3, 3), lambda: None, lambda _: None)
    finally:
        worker.close()
    assert not (tmp_path / "executed").exists()


def test_a_worker_imports_from_where_its_collector_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders that were added by hand, and the very package, though another one comes first."""
    (tmp_path / "queue.py").write_text(
        f"open('executed', 'w').close()\nexec(open({queue.__file__!r}).read())\n"
    )
    (tmp_path / "wlplan.py").write_text("raise SystemExit(3)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    worker = WorkerProcess()
    try:
        worker.simulate(CollectionSettings(Simulator(), 0, 3, 3), lambda: None, lambda _: None)
    finally:
        worker.close()
    assert (tmp_path / "executed").exists()


def test_a_worker_has_the_simulator_of_its_collector() -> None:
    other = Simulator(
        soil=dataclasses.replace(GRAVEL, density=1500.0),
        machine=dataclasses.replace(WA320, bucket_width=2.6),
        settings=Settings(step=0.01),
        schedule=Schedule(sweeps=(3, 4), tolerance=0.02),
    )
    message = json.loads(json.dumps(CollectionSettings(other, 1, 2, 3).to_json()))
    assert simulator_from_json(message["simulator"]) == other


def test_a_batch_that_was_half_written_is_written_again(store: Path, copy: Path) -> None:
    stored.update_attributes(copy, {"cycles_done": 6})
    chunk = copy / "h52" / "c" / "1" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:100])
    (copy / "mass" / "c" / "1").unlink()
    (copy / "mass" / "c" / "1.abc.partial").write_bytes(b"half")
    collect(copy, cycles=CYCLES, seed=SEED)
    assert contents(copy) == contents(store)


def test_a_complete_collection_is_left_alone(copy: Path) -> None:
    before = contents(copy)
    collect(copy, cycles=CYCLES, seed=SEED)
    assert contents(copy) == before


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"seed": 6}, "seed"),
        ({"cycles": 12}, "cycles"),
        (
            {"simulator": Simulator(soil=dataclasses.replace(GRAVEL, density=1500.0))},
            "soil (density) 1727",
        ),
    ],
)
def test_another_collection_does_not_go_on_in_the_same_place(
    copy: Path, changed: dict[str, Any], word: str
) -> None:
    before = contents(copy)
    refused(lambda: collect(copy, **{"cycles": CYCLES, "seed": SEED, **changed}), word)
    assert contents(copy) == before


def test_two_processes_do_not_write_the_same_store(copy: Path) -> None:
    lock = copy.with_name("copy.zarr.lock")
    lock.write_text(f"{os.getpid()} {stored._start_of(os.getpid())} {socket.gethostname()}")
    refused(lambda: collect(copy, cycles=CYCLES, seed=SEED), str(os.getpid()), lock.name)
    assert lock.exists()


def test_a_lock_that_is_not_signed_yet_is_left_alone(copy: Path) -> None:
    lock = copy.with_name("copy.zarr.lock")
    lock.write_text("")
    refused(lambda: collect(copy, cycles=CYCLES, seed=SEED), "is being written", lock.name)
    assert lock.exists()


@pytest.mark.parametrize("holder", ["", "99999999 12", "99999999 1 {host}", "{pid} 1 {host}"])
def test_the_lock_of_a_dead_process_is_taken_over(copy: Path, holder: str) -> None:
    lock = copy.with_name("copy.zarr.lock")
    lock.write_text(holder.format(pid=os.getpid(), host=socket.gethostname()))
    os.utime(lock, (0.0, 0.0))
    collect(copy, cycles=CYCLES, seed=SEED)
    assert not lock.exists()


def test_a_file_that_is_no_lock_of_ours_is_left_alone(tmp_path: Path) -> None:
    """As the one of a package manager would be, beside a data set of its name."""
    theirs = tmp_path / "poetry.lock"
    theirs.write_text("# generated\n[[package]]\n")
    refused(lambda: collect(tmp_path / "poetry", cycles=3), "no lock of wlplan")
    assert theirs.read_text() == "# generated\n[[package]]\n"
    assert list(tmp_path.iterdir()) == [theirs]


def test_a_full_disk_is_said_in_one_line_and_costs_nothing(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "data.zarr"
    write = stored.write

    def fails(path: Path, batch: dict[str, np.ndarray], start: int) -> None:
        if start > 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, batch, start)

    monkeypatch.setattr(stored, "write", fails)
    refused(lambda: collect(path, cycles=CYCLES, seed=SEED), "No space", "6 of 11")
    monkeypatch.setattr(stored, "write", write)
    collect(path, cycles=CYCLES, seed=SEED)
    assert contents(path) == contents(store)


def test_other_things_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("keep me")
    refused(lambda: collect(tmp_path, cycles=3), "not a data set")
    refused(lambda: collect(tmp_path / "note.txt", cycles=3), "not a data set")
    refused(lambda: collect(tmp_path / "note.txt" / "data.zarr", cycles=3), "cannot be written")
    refused(lambda: collect("/", cycles=3), "name a folder")
    refused(lambda: collect(tmp_path / "missing" / "data.zarr", cycles=0), "at least 1")
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]
    assert (tmp_path / "note.txt").read_text() == "keep me"


# --- shards


@pytest.mark.parametrize("cycles", [1, 1799, 1801, 10_800, 108_001, 1_000_000])
def test_the_shards_are_even_portions_of_whole_batches(
    cycles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("LOADS", 30), ("_BATCH", 60)):
        monkeypatch.setattr(layout, name, value)
    batches = Layout(cycles).batches
    for count in {1, min(2, batches), min(7, batches), batches}:
        parts = [Layout(cycles, (number, count)) for number in range(1, count + 1)]
        assert parts[0].first == 0
        assert parts[-1].stop == cycles
        assert all(one.stop == other.first for one, other in itertools.pairwise(parts))
        assert all(part.first % part.batch_cycles == 0 for part in parts)
        held = [math.ceil(part.size / part.batch_cycles) for part in parts]
        assert 1 <= min(held) <= max(held) <= min(held) + 1


@pytest.mark.parametrize(("number", "count"), [(0, 3), (4, 3), (-1, 3), (1, 0)])
def test_there_are_no_other_shards_than_those(tmp_path: Path, number: int, count: int) -> None:
    call = functools.partial(collect, tmp_path / "x.zarr", cycles=LONGER)
    refused(lambda: call(shard=(number, count)), f"no shard {number}/{count}")
    assert not any(tmp_path.iterdir())


def test_more_shards_than_batches_are_refused(tmp_path: Path) -> None:
    call = functools.partial(collect, tmp_path / "x.zarr", cycles=LONGER)
    refused(lambda: call(shard=(1, 4)), "at most 3", "6 cycles")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("order", [(0, 1), (1, 0), (0, 1, 2), (2, 0, 1)])
def test_merged_shards_are_the_bytes_of_a_single_collector(
    longer: Path, shards: dict[int, list[Path]], tmp_path: Path, order: tuple[int, ...]
) -> None:
    paths = [shards[len(order)][i] for i in order]
    before = [contents(path) for path in paths]
    seen = []
    out = tmp_path / "not" / "yet" / "data.zarr"
    attributes = merge(paths, out, progress=lambda *numbers: seen.append(numbers))
    assert contents(out) == contents(longer)
    assert attributes == dict(open_dataset(out).attributes)
    assert [contents(path) for path in paths] == before
    assert seen == [(0, LONGER), (6, LONGER), (12, LONGER), (17, LONGER)]
    assert [entry.name for entry in out.parent.iterdir()] == ["data.zarr"]


def test_a_shard_says_what_it_is_and_is_not_taken_for_the_whole(
    shards: dict[int, list[Path]], longer: Path
) -> None:
    path = shards[2][1]
    attributes = json.loads((path / "zarr.json").read_text())["attributes"]
    assert {name: attributes[name] for name in stored.SHARD_ATTRIBUTES} == {
        "shard": 2,
        "shards": 2,
        "first_cycle": 6,
        "whole_cycles": LONGER,
    }
    assert attributes["cycles"] == attributes["cycles_done"] == 11
    refused(lambda: open_dataset(path), "shard 2/2", "--merge")
    # To others it is a zarr group like any other.
    whole = open_dataset(longer)
    for name in VARIABLES:
        np.testing.assert_array_equal(zarr.open_array(path / name)[:], getattr(whole, name)[6:])


@pytest.mark.parametrize("after", [0, 4, 9])
def test_a_shard_that_was_cut_short_ends_with_the_same_bytes(
    shards: dict[int, list[Path]], tmp_path: Path, after: int
) -> None:
    call = functools.partial(collect, tmp_path / "x.zarr", cycles=LONGER, seed=SEED, shard=(2, 2))
    seen = []

    def stop(done: int, total: int) -> None:
        seen.append((done, total))
        if done >= after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        call(progress=stop)
    assert seen[0] == (0, 11)
    refused(lambda: merge([shards[2][0], tmp_path / "x.zarr"], tmp_path / "y"), "of the 11 cycles")
    call()
    assert contents(tmp_path / "x.zarr") == contents(shards[2][1])


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"shard": (2, 3)}, "shard 1/3, not as shard 2/3"),
        ({"shard": (1, 2)}, "shard 1/3, not as shard 1/2"),
        ({"shard": None, "cycles": 6}, "shard 1/3, not as a whole data set"),
        ({"cycles": 18}, "whole_cycles 17, not 18"),
        ({"seed": 6}, "seed"),
    ],
)
def test_another_collection_does_not_go_on_in_the_place_of_a_shard(
    parts: list[Path], changed: dict[str, Any], word: str
) -> None:
    before = contents(parts[0])
    wanted = {"cycles": LONGER, "seed": SEED, "shard": (1, 3), **changed}
    refused(lambda: collect(parts[0], **wanted), word)
    assert contents(parts[0]) == before


def test_a_whole_data_set_does_not_go_on_as_a_shard(copy: Path) -> None:
    refused(lambda: collect(copy, cycles=CYCLES, seed=SEED, shard=(1, 1)), "a whole data set")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 6}, ("has seed 6", "has 5")),
        ({"versions": {"wlplan": "0.0.9"}}, ("versions (",)),
        ({"soil": {**dataclasses.asdict(GRAVEL), "density": 1.0}}, ("soil (density) 1.0",)),
        ({"settings": {}}, ("settings (step) None",)),
        ({"cycles_done": 0}, ("0 of the 6 cycles", "shard 2/3")),
        ({"first_cycle": 3}, ("cut in another way",)),
        ({"shards": "three"}, ("is not a data set of wlplan",)),
        ({"shards": 4}, ("cut in another way",)),
        ({"format": "wlplan.dataset/9"}, ("wlplan.dataset/9",)),
    ],
)
def test_shards_that_do_not_belong_together_are_refused(
    parts: list[Path], tmp_path: Path, changes: dict[str, Any], words: tuple[str, ...]
) -> None:
    stored.update_attributes(parts[1], changes)
    refused(lambda: merge(parts, tmp_path / "out.zarr"), parts[1].name, *words)
    assert [entry.name for entry in tmp_path.iterdir()] == ["parts"]


def test_all_shards_are_needed_and_each_once(
    parts: list[Path], shards: dict[int, list[Path]], store: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.zarr"
    refused(lambda: merge([], out), "no shards")
    refused(lambda: merge(parts[1:2], out), "shard 1/3, 3/3")
    refused(lambda: merge([*parts, parts[2]], out), "both are shard 3/3")
    refused(lambda: merge([*parts, shards[3][0]], out), "both are shard 1/3")
    refused(lambda: merge([*parts, shards[2][0]], out), "shards 2", "has 3")
    refused(lambda: merge([*parts, store], out), "is no shard")
    refused(lambda: merge([*parts, tmp_path / "nothing"], out), "no such data set")
    assert [entry.name for entry in tmp_path.iterdir()] == ["parts"]


@pytest.mark.parametrize("damage", ["missing", "truncated", "no array", "other chunks"])
def test_a_damaged_shard_is_refused(parts: list[Path], tmp_path: Path, damage: str) -> None:
    chunk = parts[2] / "h52" / "c" / "0" / "0" / "0"
    metadata = parts[2] / "h52" / "zarr.json"
    if damage == "missing":
        chunk.unlink()
    elif damage == "truncated":
        chunk.write_bytes(chunk.read_bytes()[:50])
    elif damage == "no array":
        shutil.rmtree(parts[2] / "h52")
    else:
        metadata.write_text(metadata.read_text().replace('"clevel": 5', '"clevel": 4'))
    refused(lambda: merge(parts, tmp_path / "out.zarr"), parts[2].name, "damaged", "collect")
    assert [entry.name for entry in tmp_path.iterdir()] == ["parts"]


def test_a_merge_that_is_done_is_left_alone(parts: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.zarr"
    merge(parts, out)
    before = contents(out)
    merge(parts[::-1], out, progress=lambda *_: pytest.fail("begun anew"))
    assert contents(out) == before
    (out / "mass" / "c" / "1").unlink()
    refused(lambda: merge(parts, out), "out.zarr", "damaged")


def test_other_things_are_not_merged_over(parts: list[Path], copy: Path, tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("keep me")
    before = contents(tmp_path)
    refused(lambda: merge(parts, copy), "not the data set of these shards")
    refused(lambda: merge(parts, tmp_path), "not the data set of these shards")
    refused(lambda: merge(parts, tmp_path / "note.txt"), "not the data set of these shards")
    refused(lambda: merge(parts, tmp_path / "note.txt" / "x"), "cannot be written")
    refused(lambda: merge(parts, "/"), "name a folder")
    refused(lambda: merge(parts, parts[0]), "is a shard")
    refused(lambda: merge(parts, parts[0] / "x.zarr"), "inside of one")
    assert contents(tmp_path) == before


def test_a_collection_that_was_only_begun_is_not_merged_over(
    parts: list[Path], tmp_path: Path
) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "x.zarr", cycles=LONGER, seed=SEED, progress=stop)
    refused(lambda: merge(parts, tmp_path / "x.zarr"), "not the data set of these shards")


def test_two_processes_do_not_merge_to_the_same_place(parts: list[Path], tmp_path: Path) -> None:
    lock = tmp_path / "out.zarr.lock"
    lock.write_text(f"{os.getpid()} {stored._start_of(os.getpid())} {socket.gethostname()}")
    refused(lambda: merge(parts, tmp_path / "out.zarr"), str(os.getpid()), lock.name)
    assert not (tmp_path / "out.zarr").exists()


def test_a_merge_that_does_not_end_leaves_nothing(
    longer: Path, parts: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.zarr"
    before = [contents(path) for path in parts]
    write, written = merging._write, []

    def full(path: Path, content: bytes) -> None:
        written.append(path)
        if len(written) > 20:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(merging, "_write", full)
        refused(lambda: merge(parts, out), "No space", "free some space")
    assert [entry.name for entry in tmp_path.iterdir()] == ["parts"]

    def stop(done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        merge(parts, out, progress=stop)
    assert [entry.name for entry in tmp_path.iterdir()] == ["parts"]
    # What a killed process leaves: its hidden folder, and its lock.
    (tmp_path / ".out.zarr.0123456789ab.tmp" / "mass").mkdir(parents=True)
    (tmp_path / "out.zarr.lock").write_text(f"99999999 1 {socket.gethostname()}")
    merge(parts, out)
    assert contents(out) == contents(longer)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["out.zarr", "parts"]
    assert [contents(path) for path in parts] == before


def test_the_command_line_collects_shards_and_merges_them(
    shards: dict[int, list[Path]], longer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [str(tmp_path / f"{i}.zarr") for i in (1, 2)]
    for i, name in enumerate(names, 1):
        words = ["collect", "--cycles", LONGER, "--seed", SEED, "--shard", f"{i}/2", "--json"]
        assert cli.main([*map(str, words), "--out", name]) == 0
        document = json.loads(capsys.readouterr().out)
        assert document == {
            "out": name,
            "cycles": LONGER,
            "seed": SEED,
            "shard": i,
            "shards": 2,
        }
        assert contents(tmp_path / f"{i}.zarr") == contents(shards[2][i - 1])
    out = str(tmp_path / "data.zarr")
    assert cli.main(["collect", "--merge", *names, "--out", out, "--json"]) == 0
    told, progress = capsys.readouterr()
    assert json.loads(told) == {"out": out, "cycles": LONGER, "seed": SEED, "merged": names}
    assert f"cycles {LONGER}/{LONGER}" in progress
    assert contents_but_command(tmp_path / "data.zarr") == contents_but_command(longer)
    assert cli.main(["collect", "--merge", names[0], "--out", str(tmp_path / "x")]) == 2
    told, complaint = capsys.readouterr()
    assert told == ""
    assert complaint.startswith("error: ")
    assert complaint.count("\n") == 1


# --- processes

# `wlplan collect` with the short episodes of these tests.
CHILD = """
import sys
from wlplan import cli
from wlplan.dataset import collecting, layout, episode, store, worker_pool
for part in (layout, episode, worker_pool, collecting, store):
    part.LOADS = 3
layout._BATCH = 2
sys.exit(cli.main(["collect", *sys.argv[1:]]))
"""


def start(*words: object) -> subprocess.Popen[str]:
    """A process that collects."""
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, *map(str, words)], stderr=subprocess.PIPE, text=True
    )


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    """Waits for what a process that runs on is to bring about."""
    until = time.monotonic() + 300.0
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.005)


def cycles_done(path: Path) -> int:
    """Number of cycles in a store so far; -1 without a store."""
    try:
        document = json.loads((path / "zarr.json").read_text())
    except FileNotFoundError:
        return -1
    return int(document["attributes"]["cycles_done"])


@pytest.mark.slow
def test_a_killed_shard_goes_on_and_ends_with_the_same_bytes(tmp_path: Path) -> None:
    cycles = 480
    collect(tmp_path / "want.zarr", cycles=cycles, seed=SEED, shard=(2, 2))
    path = tmp_path / "got.zarr"
    command = ("--cycles", cycles, "--seed", SEED, "--shard", "2/2", "--out", path)
    for least in (0, 6, 120):
        process = start(*command)

        def is_there(least: int = least) -> bool:
            return cycles_done(path) >= least

        wait_until(is_there, process)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        assert least <= cycles_done(path) < 240
        assert path.with_name("got.zarr.lock").exists()
    process = start(*command)
    process.communicate()
    assert process.returncode == 0
    assert contents_but_command(path) == contents_but_command(tmp_path / "want.zarr")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["got.zarr", "want.zarr"]


@pytest.mark.slow
def test_of_two_collectors_at_once_one_is_refused(store: Path, tmp_path: Path) -> None:
    path = tmp_path / "data.zarr"
    command = ("--cycles", CYCLES, "--seed", SEED, "--out", path)
    first = start(*command)
    wait_until(path.exists, first)
    second = start(*command)
    _, told = second.communicate()
    assert first.poll() is None
    assert second.returncode == 2
    assert told.startswith(f"error: {path}: is being written by process {first.pid}")
    assert told.count("\n") == 1
    first.communicate()
    assert first.returncode == 0
    assert contents_but_command(path) == contents_but_command(store)


# --- reading


def test_a_missing_or_foreign_store_is_refused(tmp_path: Path, copy: Path) -> None:
    refused(lambda: open_dataset(tmp_path / "nothing.zarr"), "no such data set")
    refused(lambda: open_dataset(tmp_path), "not a data set")
    stored.update_attributes(copy, {"format": "wlplan.dataset/9"})
    refused(lambda: open_dataset(copy), "wlplan.dataset/9")
    (copy / "zarr.json").write_text("{")
    refused(lambda: open_dataset(copy), "not a data set")


@pytest.mark.parametrize("damage", ["missing", "truncated", "no array"])
def test_a_damaged_store_is_refused(copy: Path, damage: str) -> None:
    chunk = copy / "h36" / "c" / "1" / "0" / "0"
    if damage == "missing":
        chunk.unlink()
    elif damage == "truncated":
        chunk.write_bytes(chunk.read_bytes()[:50])
    else:
        shutil.rmtree(copy / "h36")
    refused(lambda: open_dataset(copy), "damaged")


def test_the_fingerprint_tells_data_sets_apart(data: Dataset, store: Path) -> None:
    assert fingerprint(data) == fingerprint(open_dataset(store))
    other = dataclasses.replace(data, mass=data.mass + 1e-6)
    assert fingerprint(other) != fingerprint(data)


# --- splitting and normalising


@pytest.mark.parametrize("rollouts", [3, 10, 41, 360])
def test_no_rollout_is_in_two_parts(rollouts: int) -> None:
    whole = numbered(rollouts)
    parts = split(whole, seed=2)
    numbers = [np.unique(part.rollout) for part in parts]
    assert sorted(np.concatenate(numbers)) == list(range(rollouts))
    assert sum(len(part) for part in parts) == len(whole)
    assert min(len(part) for part in parts) > 0
    assert len(numbers[1]) == pytest.approx(0.1 * rollouts, abs=1)
    again = split(whole, seed=2)
    np.testing.assert_array_equal(again[2].rollout, parts[2].rollout)


def test_split_by_cycle_every_cycle_is_in_one_part_and_piles_are_in_several() -> None:
    whole = numbered(10)
    whole = dataclasses.replace(whole, mass=np.arange(len(whole), dtype=np.float32))
    fractions = (0.81, 0.09, 0.1)
    parts = split(whole, fractions=fractions, by="cycle")
    numbers = np.concatenate([part.mass for part in parts])
    np.testing.assert_array_equal(np.sort(numbers), whole.mass)
    for part, fraction in zip(parts, fractions, strict=True):
        assert len(part) == pytest.approx(fraction * len(whole), abs=2)
    assert set(parts[2].rollout) <= set(parts[0].rollout)


def test_too_few_rollouts_are_not_split() -> None:
    refused(lambda: split(numbered(2)), "2 rollouts")
    refused(lambda: split(numbered(5), by="pile"), "rollout, cycle")
    refused(lambda: split(numbered(5), fractions=(0.8, -0.1)), "positive")


def test_reflecting_twice_changes_nothing(data: Dataset) -> None:
    np.testing.assert_array_equal(reflect(reflect(data.h52)), data.h52)
    np.testing.assert_array_equal(reflect(data.h36)[:, :, 0], data.h36[:, :, -1])


def test_the_normaliser_maps_the_range_to_one_and_back() -> None:
    table = np.random.default_rng(0).normal(3.0, 2.0, (50, 4)).astype(np.float32)
    table[:, 3] = 7.0  # never changes
    normaliser = Normaliser.of(table)
    unit = np.stack([normaliser.normalise(jnp.asarray(row)) for row in table])
    np.testing.assert_allclose(unit[:, :3].min(axis=0), 0.0, atol=1e-6)
    np.testing.assert_allclose(unit[:, :3].max(axis=0), 1.0, atol=1e-6)
    np.testing.assert_array_equal(unit[:, 3], 0.0)
    back = np.stack([normaliser.denormalise(jnp.asarray(row)) for row in unit])
    np.testing.assert_allclose(back, table, rtol=1e-5)


def test_the_command_is_one_to_type_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/wlplan", "collect", "--out", "my data.zarr"])
    main = types.ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", main)
    assert provenance.command() == "wlplan collect --out 'my data.zarr'"
    main.__spec__ = importlib.machinery.ModuleSpec("wlplan.__main__", None)
    assert provenance.command() == "python -m wlplan collect --out 'my data.zarr'"
