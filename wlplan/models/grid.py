"""The local heightmaps that the models were trained on."""

from __future__ import annotations

from wlplan.constants import CELL_SIZE
from wlplan.errors import InputError
from wlplan.terrain.heightmap import (
    PERFORMANCE_CELLS,
    PERFORMANCE_DISPLACEMENT,
    STATE_CELLS,
    STATE_DISPLACEMENT,
)
from wlplan.types import LocalHeightmap

GRID: dict[str, float] = {
    "cell_size": CELL_SIZE,
    "performance_cells": PERFORMANCE_CELLS,
    "performance_displacement": PERFORMANCE_DISPLACEMENT,
    "state_cells": STATE_CELLS,
    "state_displacement": STATE_DISPLACEMENT,
}
"""The local maps that the models look at: spacing [m], cells a side, displacement [m]."""


def check_performance_map(local: LocalHeightmap) -> None:
    """Refuses a local heightmap that ψ was not trained on.

    Raises:
        InputError: If it has not 36 × 36 cells of 0.1 m.
    """
    _check("ψ", local, PERFORMANCE_CELLS, PERFORMANCE_DISPLACEMENT)


def check_state_map(local: LocalHeightmap) -> None:
    """Refuses a local heightmap that φ was not trained on.

    Raises:
        InputError: If it has not 52 × 52 cells of 0.1 m.
    """
    _check("φ", local, STATE_CELLS, STATE_DISPLACEMENT)


def _check(predictor: str, local: LocalHeightmap, cells: int, displacement: float) -> None:
    if local.height.shape != (cells, cells) or local.cell_size != CELL_SIZE:
        raise InputError(
            f"The local heightmap has {local.height.shape} cells of {local.cell_size:g} m; "
            f"{predictor} was trained on {cells} a side, of {CELL_SIZE:g} m: sample it with "
            f"cells={cells}, displacement={displacement:g}."
        )
