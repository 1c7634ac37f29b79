"""The StableHLO module alone, as PJRT and IREE take it: fixed shapes, one case at a time.

With shapes that are known no compiler has to be told what JAX means by a symbolic one.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from wlplan.portable.formats import stablehlo
from wlplan.portable.function import PortableFunction

ENDING = "mlirbc"
LIBRARIES: tuple[str, ...] = ()

# What stands before the version in the head of an artifact, and what ends it.
_BEFORE, _AFTER = b"StableHLO_v", b"\x00"


def content(function: PortableFunction) -> bytes:
    """The portable artifact, in MLIR bytecode."""
    return stablehlo.exported(function, 1).mlir_module_serialized


def outputs(content: bytes, function: PortableFunction) -> tuple[np.ndarray, ...]:
    """What the file computes, case by case."""
    wrapped = dataclasses.replace(stablehlo.exported(function, 1), mlir_module_serialized=content)
    call = jax.jit(wrapped.call)
    rows = [
        [np.asarray(output) for output in call(*(case[n : n + 1] for case in function.cases))]
        for n in range(len(function.cases[0]))
    ]
    return tuple(np.concatenate(column) for column in zip(*rows, strict=True))


def facts(content: bytes, function: PortableFunction) -> dict[str, Any]:
    """Its entry, and the version of StableHLO that a reader has to know."""
    del function
    version = content.partition(_BEFORE)[2].partition(_AFTER)[0]
    return {
        "batch": 1,
        "entry": "main",
        "stablehlo_version": version.decode("ascii"),
        "platforms": [jax.default_backend()],
    }
