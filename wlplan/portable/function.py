"""A pure function with named inputs and outputs, as other tools need it described."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Shaped

from wlplan.types import PyTree


@dataclasses.dataclass(frozen=True)
class Port:
    """An input or an output: one array.

    Attributes:
        name: By which it is called, an identifier.
        meaning: What it is, in words.
        unit: Of its numbers; "1" where there is none.
        frame: In which coordinates are, "world" or "local"; None where there are none.
        shape: For one case, without the batch.
        dtype: Type of its numbers.
    """

    name: str
    meaning: str
    unit: str
    frame: str | None = None
    shape: tuple[int, ...] = ()
    dtype: str = "float32"


@dataclasses.dataclass(frozen=True)
class PortableFunction:
    """A function that can be written to a file.

    Attributes:
        name: Stem of its files.
        meaning: What it does, in a sentence.
        function: Pure, `function(*inputs) -> outputs` for one case: arrays in the order of the
            ports, a tuple of arrays. It passes `jit` and `vmap`.
        inputs: What it takes, in order.
        outputs: What it returns, in order.
        cases: Inputs that it is checked on, each with a leading axis `n`.
        origin: What it was made of, as JSON has it: names, settings, checksums.
    """

    name: str
    meaning: str
    function: Callable[..., tuple[Array, ...]]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    cases: tuple[Shaped[np.ndarray, "n ..."], ...]
    origin: Mapping[str, Any]


def checksum(model: PyTree) -> str:
    """SHA-256 of all numbers of a pytree, in their order: of a world or a model its weights."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(model):
        values = np.ascontiguousarray(leaf)
        digest.update(f"{values.dtype.str}{values.shape}".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()
