"""ψ of a learned world: what one loading yields and costs, from the local heightmap."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.portable.function import Port, PortableFunction, checksum
from wlplan.portable.functions import ACTION, PERFORMANCE, Asked, actions, local_map, poses
from wlplan.terrain.heightmap import (
    PERFORMANCE_CELLS,
    PERFORMANCE_DISPLACEMENT,
    sample_local,
)
from wlplan.types import LocalHeightmap


def portable(asked: Asked) -> PortableFunction:
    """ψ with its normalisers; of an ensemble the mean and the standard deviation of its error.

    Raises:
        InputError: If the world has no ψ.
    """
    psi: Any = getattr(asked.world, "performance", None)
    if psi is None:
        raise InputError("this world has no predictor of performance: choose a learned world.")
    sure = hasattr(psi, "with_deviation")
    deviations = tuple(
        Port(f"{port.name}_deviation", f"standard deviation of the error of {port.name}", port.unit)
        for port in PERFORMANCE
    )

    def function(heights: Array, action: Array) -> tuple[Array, ...]:
        local = LocalHeightmap(heights, CELL_SIZE, PERFORMANCE_DISPLACEMENT)
        parts = psi.with_deviation(local, action) if sure else (psi(local, action),)
        return tuple(value for part in parts for value in (part.mass, part.time, part.work))

    return PortableFunction(
        name="performance",
        meaning="what one loading yields and costs, as a network predicts it",
        function=function,
        inputs=(performance_map(), ACTION),
        outputs=PERFORMANCE + (deviations if sure else ()),
        cases=(performance_cases(asked), actions(asked)),
        origin={**asked.origin, "sha256": checksum(psi)},
    )


def performance_map() -> Port:
    """What ψ and the predictor of stalls look at."""
    return local_map("heights", PERFORMANCE_CELLS, PERFORMANCE_DISPLACEMENT)


def performance_cases(asked: Asked) -> Float[np.ndarray, "n 36 36"]:
    """Local heightmaps around the toe."""
    sampled = jax.vmap(lambda pose: sample_local(asked.pile, pose).height)(poses(asked))
    return np.asarray(sampled, np.float32)
