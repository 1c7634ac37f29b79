"""The store under any order of collecting, killing, going on, merging and reading.

A model beside it, a dictionary, says which cycles should be there. What simulates is a stand-in;
what writes is real.
"""

from __future__ import annotations

import contextlib
import functools
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis.strategies as st
import numpy as np
import pytest
from examples import examples
from faults import ERROR, Kind, Tree, struck, tree
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from wlplan.dataset import Dataset, collect, collecting, merge, merging, open_dataset, store
from wlplan.dataset.layout import Layout
from wlplan.dataset.variables import LOADS, VARIABLES
from wlplan.dataset.worker_pool import CollectionSettings
from wlplan.errors import InputError

CYCLES = 5 * LOADS - 4  # five batches, the last not full
# The last is a map, which older data sets lack; here it is a number, so that all is there.
FEW = {**{n: VARIABLES[n] for n in ("mass", "rollout")}, "h36_after": VARIABLES["mass"]}
SHARDS = (None, (1, 1), (1, 2), (2, 2), (1, 3), (2, 3), (3, 3))
NAMES = ("a", "b", "c", "d")


class FewVariables(Dataset):
    """A data set in memory that has these only."""

    def __init__(self, **columns: Any) -> None:
        self.__dict__.update(columns)


class KilledError(BaseException):
    """What ends a process: nothing is tidied up after it."""


KILLED = Kind("killed", lambda _: KilledError(), for_good=True)


def numbers(seed: int, first: int, stop: int) -> dict[str, np.ndarray]:
    """Cycles as the stand-in simulates them."""
    values = 1000 * seed + np.arange(first, stop)
    return {name: values.astype(variable.dtype) for name, variable in FEW.items()}


def batches(
    layout: Layout, start: int, settings: CollectionSettings, _: object
) -> Iterator[dict[str, np.ndarray]]:
    """Stands in for `wlplan.dataset.worker_pool.collect_batches`."""
    for first in range(start, layout.stop, layout.batch_cycles):
        yield numbers(settings.seed, first, min(first + layout.batch_cycles, layout.stop))


@contextlib.contextmanager
def stand_ins() -> Iterator[None]:
    """A simulator that counts, few variables, small batches; nobody holds a lock any more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collecting, "collect_batches", batches)
        patch.setattr("wlplan.dataset.layout._BATCH", 1)
        patch.setattr(store, "Dataset", FewVariables)
        patch.setattr(store, "_is_alive", lambda _: False)
        patch.setattr(store, "_SIGNING_TIME", 0.0)
        for module in (store, merging):
            patch.setattr(module, "VARIABLES", FEW)
            patch.setattr(module, "command", lambda: "wlplan collect")
        yield


@functools.cache
def alone(seed: int, shard: tuple[int, int] | None) -> Tree:
    """What a collection leaves that nothing disturbs."""
    with tempfile.TemporaryDirectory() as folder, stand_ins():
        collect(Path(folder) / "d", cycles=CYCLES, seed=seed, shard=shard)
        return tree(Path(folder) / "d")


class Part(NamedTuple):
    """What should be at a place."""

    seed: int
    shard: tuple[int, int] | None
    done: int

    @property
    def layout(self) -> Layout:
        """How it is cut."""
        return Layout(CYCLES, self.shard)

    @property
    def is_complete(self) -> bool:
        """Whether no cycle is missing."""
        return self.done == self.layout.size


# Where a fault strikes; None: nowhere.
faults = st.none() | st.tuples(st.sampled_from([KILLED, ERROR]), st.integers(1, 120))
names = st.sampled_from(NAMES)


class Collections(RuleBasedStateMachine):
    """Data sets and shards in a folder."""

    def __init__(self) -> None:
        super().__init__()
        self.place = Path(tempfile.mkdtemp())
        self.parts: dict[str, Part] = {}
        self.patched = contextlib.ExitStack()

    @initialize()
    def patch(self) -> None:
        """Puts the stand-ins in place."""
        self.patched.enter_context(stand_ins())

    def teardown(self) -> None:
        """Takes them away, and the folder too."""
        self.patched.close()
        shutil.rmtree(self.place)

    def struck(self, fault: tuple[Kind, int] | None) -> contextlib.AbstractContextManager[object]:
        """Within it something fails."""
        return contextlib.nullcontext() if fault is None else struck(self.place, *fault)

    @rule(name=names, seed=st.integers(0, 1), shard=st.sampled_from(SHARDS), fault=faults)
    def collect(
        self, name: str, seed: int, shard: tuple[int, int] | None, fault: tuple[Kind, int] | None
    ) -> None:
        """Begins, or goes on with, what a place should hold; what is another stays as it is."""
        there = self.parts.get(name)
        wanted = there is None or (there.seed, there.shard) == (seed, shard)
        before = tree(self.place / name)
        refused = killed = False
        with self.struck(fault):
            try:
                collect(self.place / name, cycles=CYCLES, seed=seed, shard=shard)
            except InputError:
                refused = True
            except KilledError:
                killed = True
        if not wanted:
            assert refused or killed
            assert tree(self.place / name) == before
            return
        assert fault is not None or not refused
        if store.is_new(self.place / name):
            assert there is None
            return
        done = store.read_attributes(self.place / name)["cycles_done"]
        part = Part(seed, shard, done)
        # What was safe stays so.
        assert done >= (there.done if there else 0)
        assert part.is_complete or refused or killed
        self.parts[name] = part
        if not refused and not killed:
            assert tree(self.place / name) == alone(seed, shard)

    @precondition(lambda self: self.parts)
    @rule(data=st.data(), fault=faults)
    def merge(self, data: st.DataObject, fault: tuple[Kind, int] | None) -> None:
        """Joins some parts in some order, at a place that may hold something."""
        sets = [
            sorted(n for n, p in self.parts.items() if p.shard and p.shard[1] == c) for c in (2, 3)
        ]
        whole = st.sampled_from(sets).flatmap(st.permutations)
        some = whole | st.lists(st.sampled_from(sorted(self.parts)), min_size=1, max_size=3)
        given, target = data.draw(some), data.draw(names)
        shards = [self.parts[name] for name in given]
        fits = (
            len({part.seed for part in shards}) == 1
            and all(part.shard and part.is_complete for part in shards)
            and len({part.shard[1] for part in shards if part.shard}) == 1
            and sorted(part.shard[0] for part in shards if part.shard)
            == list(range(1, len(shards) + 1))
            and shards[0].shard is not None
            and shards[0].shard[1] == len(shards)
            and target not in given
        )
        there, before = self.parts.get(target), tree(self.place / target)
        joined = Part(shards[0].seed, None, CYCLES) if shards else None
        refused = killed = False
        with self.struck(fault):
            try:
                merge([self.place / name for name in given], self.place / target)
            except InputError:
                refused = True
            except KilledError:
                killed = True
        after = tree(self.place / target)
        if not refused and not killed:
            assert fits
            assert there in (None, joined)
        if fault is None and fits and there in (None, joined):
            assert not refused
        if after == before:
            assert refused or killed or there == joined
            return
        # It appeared as a whole, with the bytes of a single collector.
        assert fits
        assert there is None
        assert joined is not None
        assert after == alone(joined.seed, None)
        self.parts[target] = joined

    @rule(name=names)
    def read(self, name: str) -> None:
        """As training does: what is whole and complete, and nothing else."""
        part = self.parts.get(name)
        if part is None or part.shard or not part.is_complete:
            with pytest.raises(InputError):
                open_dataset(self.place / name)
            return
        found = open_dataset(self.place / name)
        for variable, values in numbers(part.seed, 0, CYCLES).items():
            np.testing.assert_array_equal(getattr(found, variable), values)

    @rule(name=names)
    def delete(self, name: str) -> None:
        """Somebody removes it."""
        shutil.rmtree(self.place / name, ignore_errors=True)
        self.parts.pop(name, None)

    @invariant()
    def no_cycle_is_half(self) -> None:
        """Every cycle that counts is there with all of its variables."""
        import zarr

        for name, part in self.parts.items():
            group = zarr.open_group(str(self.place / name), mode="r", zarr_format=3)
            assert group.attrs["cycles_done"] == part.done
            assert part.is_complete or part.done % part.layout.batch_cycles == 0
            first = part.layout.first
            for variable, values in numbers(part.seed, first, first + part.done).items():
                np.testing.assert_array_equal(np.asarray(group[variable])[: part.done], values)


Collections.TestCase.settings = settings(max_examples=examples(15), stateful_step_count=15)
TestCollections = Collections.TestCase


@pytest.mark.slow
def test_many_orders() -> None:
    from hypothesis.stateful import run_state_machine_as_test

    run_state_machine_as_test(
        Collections, settings=settings(max_examples=examples(100), stateful_step_count=30)
    )


def test_the_machine_sees_a_half_cycle() -> None:
    """A count that runs ahead of what is written is found."""
    machine = Collections()
    machine.patch()
    try:
        machine.collect("a", 0, None, (KILLED, 60))
        machine.no_cycle_is_half()
        assert not machine.parts["a"].is_complete
        store.update_attributes(machine.place / "a", {"cycles_done": CYCLES})
        machine.parts["a"] = machine.parts["a"]._replace(done=CYCLES)
        with pytest.raises(AssertionError):
            machine.no_cycle_is_half()
    finally:
        machine.teardown()
