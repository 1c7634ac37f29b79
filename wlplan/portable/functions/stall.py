"""The predictor of stalls of a learned world."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.portable.function import Port, PortableFunction, checksum
from wlplan.portable.functions import ACTION, Asked, actions
from wlplan.portable.functions.performance import performance_cases, performance_map
from wlplan.terrain.heightmap import PERFORMANCE_DISPLACEMENT
from wlplan.types import LocalHeightmap


def portable(asked: Asked) -> PortableFunction:
    """How likely a loading stalls.

    Raises:
        InputError: If the world does not foresee stalls.
    """
    stall: Any = getattr(asked.world, "stall", None)
    if stall is None:
        raise InputError(
            "this world has no predictor of stalls: choose a learned world, without a model of "
            "your own."
        )

    def function(heights: Array, action: Array) -> tuple[Array, ...]:
        return (stall(LocalHeightmap(heights, CELL_SIZE, PERFORMANCE_DISPLACEMENT), action),)

    return PortableFunction(
        name="stall",
        meaning="how likely a loading stalls, as a network predicts it",
        function=function,
        inputs=(performance_map(), ACTION),
        outputs=(Port("probability", "that the limit of time ends the filling", "1"),),
        cases=(performance_cases(asked), actions(asked)),
        origin={**asked.origin, "sha256": checksum(stall)},
    )
