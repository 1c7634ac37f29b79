"""The layout of a data set: how its cycles are cut into episodes, batches and shards."""

from __future__ import annotations

import dataclasses
import math

from wlplan.dataset.variables import LOADS
from wlplan.errors import InputError

# Episodes that are written as one batch: one chunk of every variable, 19 MB of the largest.
_BATCH = 60


@dataclasses.dataclass(frozen=True)
class Layout:
    """How the cycles of a collection are cut into episodes, batches and shards.

    Attributes:
        cycles: Number of cycles of the whole collection.
        shard: Which shard is meant, counted from 1, and how many there are; None: the whole.

    Raises:
        InputError: If there are no cycles, there is no such shard, or shards would be empty.
    """

    cycles: int
    shard: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.cycles < 1:
            raise InputError(f"{self.cycles} cycles asked for: it has to be at least 1.")
        number, count = self.shard or (1, 1)
        if not 1 <= number <= count:
            raise InputError(
                f"There is no shard {number}/{count}: give 1/{count} to {count}/{count}."
            )
        if count > self.batches:
            raise InputError(
                f"{self.cycles} cycles cannot be cut into {count} shards: a shard holds whole "
                f"batches of {self.batch_cycles} cycles, so at most {self.batches} make sense."
            )

    @property
    def loads(self) -> int:
        """Loadings to simulate of each episode."""
        return min(LOADS, self.cycles)

    @property
    def batch_cycles(self) -> int:
        """Cycles of a batch, which are written at once: one chunk of every variable."""
        return min(_BATCH * LOADS, self.cycles)

    @property
    def batches(self) -> int:
        """Number of batches of the whole, the last perhaps smaller."""
        return math.ceil(self.cycles / self.batch_cycles)

    @property
    def first(self) -> int:
        """First cycle of the shard, counted from 0 in the whole."""
        number, count = self.shard or (1, 1)
        return (number - 1) * self.batches // count * self.batch_cycles

    @property
    def stop(self) -> int:
        """The cycle after the last of the shard."""
        number, count = self.shard or (1, 1)
        return min(number * self.batches // count * self.batch_cycles, self.cycles)

    @property
    def size(self) -> int:
        """Number of cycles in the shard."""
        return self.stop - self.first
