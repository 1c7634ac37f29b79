"""What a data set holds: its variables, and the cycles in memory."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from wlplan.constants import CELL_SIZE
from wlplan.engines.simulator import STOP_REASONS
from wlplan.errors import InputError
from wlplan.terrain.heightmap import (
    PERFORMANCE_CELLS,
    PERFORMANCE_DISPLACEMENT,
    STATE_CELLS,
    STATE_DISPLACEMENT,
)
from wlplan.terrain.seed_piles import SEED_PILES
from wlplan.types import Action, Characteristics, Pose

LOADS = 30
"""Consecutive loadings of an episode. Paper, section 6.2."""


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
    "h36": _map(
        PERFORMANCE_CELLS, "local heightmap of the performance predictor", PERFORMANCE_DISPLACEMENT
    ),
    "h36_after": _map(
        PERFORMANCE_CELLS,
        "h36 after the loading, over the same reference",
        PERFORMANCE_DISPLACEMENT,
    ),
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
    """Loading cycles in memory; `VARIABLES` has the meaning and unit of each array."""

    mass: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    work: Float[np.ndarray, " n"]
    action: Float[np.ndarray, "n 4"]
    pose: Float[np.ndarray, "n 3"]
    h36: Float[np.ndarray, "n 36 36"]
    h36_after: Float[np.ndarray, "n 36 36"]
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


def join(datasets: Sequence[Dataset]) -> Dataset:
    """Data sets in a row, their episodes numbered on; the attributes are those of the first.

    Raises:
        InputError: If they are of different soils or machines.
    """
    first = datasets[0]
    for other in datasets[1:]:
        for name in ("soil", "machine"):
            if other.attributes.get(name) != first.attributes.get(name):
                raise InputError(f"The data sets differ in {name}: a model is trained for one.")
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(d, name) for d in datasets]) for name in VARIABLES
    }
    ends = np.cumsum([0, *(d.rollout.max(initial=-1) + 1 for d in datasets)])
    columns["rollout"] = np.concatenate(
        [d.rollout + int(start) for d, start in zip(datasets, ends, strict=False)]
    ).astype(first.rollout.dtype)
    return dataclasses.replace(first, **columns)


def fingerprint(dataset: Dataset) -> str:
    """A hash of all arrays of a data set; the attributes do not count."""
    total = hashlib.sha256()
    for name in VARIABLES:
        values = np.ascontiguousarray(getattr(dataset, name))
        total.update(f"{name} {values.dtype} {values.shape};".encode())
        total.update(values.data)
    return f"sha256:{total.hexdigest()}"


def split(
    dataset: Dataset,
    *,
    seed: int = 0,
    fractions: tuple[float, ...] = (0.8, 0.1, 0.1),
    by: str = "rollout",
) -> tuple[Dataset, ...]:
    """Splits a data set at random into parts that share no episode, the variable `rollout`.

    Cycles of one episode resemble each other: they dig the same pile. Split by cycle, as in the
    paper, a test set does not show how a model does on a pile that it has not seen.

    Args:
        dataset: Data set to split.
        seed: Seed of the choice.
        fractions: Size of each part over their sum; by default training, validation and test.
        by: What the parts do not share: "rollout", or "cycle", each of which goes where it likes.

    Raises:
        InputError: If there are fewer episodes, or cycles, than parts, or it is to be split by
            anything else.
    """
    if by not in ("rollout", "cycle"):
        raise InputError(f"Unknown split by {by!r}: choose one of rollout, cycle.")
    if not fractions or min(fractions) <= 0.0 or not math.isfinite(sum(fractions)):
        raise InputError(f"The fractions of the split are {fractions}: they have to be positive.")
    belongs = dataset.rollout if by == "rollout" else np.arange(len(dataset))
    units = np.unique(belongs)
    parts = len(fractions)
    if len(units) < parts:
        raise InputError(
            f"The data set has {len(units)} {by}s, too few for {parts} parts that share none: "
            f"collect at least {parts * LOADS} cycles."
        )
    order = np.random.default_rng(seed).permutation(units)
    # Each part has one of them for a start, the rest is shared out by the fractions.
    share = np.cumsum(fractions) / sum(fractions) * (len(units) - parts)
    ends = np.rint(share).astype(int) + np.arange(1, parts + 1)
    return tuple(dataset.select(np.isin(belongs, chosen)) for chosen in np.split(order, ends[:-1]))


def h36_after(
    h36: Float[np.ndarray, "*n 36 36"],
    h52: Float[np.ndarray, "*n 52 52"],
    h52_after: Float[np.ndarray, "*n 52 52"],
) -> Float[np.ndarray, "*n 36 36"]:
    """The smaller local map after a loading [m]: its cells are cells of the larger one."""
    ahead = round((STATE_DISPLACEMENT - PERFORMANCE_DISPLACEMENT) / CELL_SIZE)
    aside = (STATE_CELLS - PERFORMANCE_CELLS) // 2
    change = (h52_after - h52)[
        ..., ahead : ahead + PERFORMANCE_CELLS, aside : aside + PERFORMANCE_CELLS
    ]
    after: np.ndarray = h36 + change
    return after


def reflect(maps: Float[np.ndarray, "*n i j"]) -> Float[np.ndarray, "*n i j"]:
    """Local heightmaps of the mirrored pile, left for right. Paper, section 6.4."""
    return maps[..., ::-1]
