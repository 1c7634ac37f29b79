"""The heights of a scan, small enough for a page to draw."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from wlplan.io.survey import Survey

# Cells a side at most, and whole parts of what heights are given in [m].
_CELLS, _STEP = 400, 0.01


def raster_of(survey: Survey) -> dict[str, Any]:
    """What is needed to draw a scan from above.

    Args:
        survey: As it was read.

    Returns:
        Values of JSON. `size`: cells in x and y. `first`: centre of the first cell [m] in the
        coordinates of the scan. `cell`: their side [m]. `height` and `ground`: in `step` metres
        over `lowest`, two bytes each, low byte first, row by row of x, in base64. `seen`: 1 or 0 of
        each cell, a byte each, likewise.
    """
    grid = survey.grid
    every = max(1, math.ceil(max(grid.height.shape) / _CELLS))
    height = grid.height[::every, ::every].astype(np.float64)
    ground = height * 0.0 if grid.ground is None else grid.ground[::every, ::every]
    seen = np.ones(height.shape, bool) if grid.valid is None else grid.valid[::every, ::every]
    lowest = float(min(height.min(), ground.min()))
    x, y = survey.frame.scan(*(float(v) for v in grid.origin))
    return {
        "size": list(height.shape),
        "first": [x, y],
        "cell": float(grid.cell_size) * every,
        "step": _STEP,
        "lowest": lowest,
        "height": _packed((height - lowest) / _STEP),
        "ground": _packed((ground.astype(np.float64) - lowest) / _STEP),
        "seen": base64.b64encode(seen.astype(np.uint8).tobytes()).decode(),
    }


def _packed(steps: Float[np.ndarray, "nx ny"]) -> str:
    limits = np.iinfo(np.uint16)
    return base64.b64encode(
        np.clip(np.rint(steps), limits.min, limits.max).astype("<u2").tobytes()
    ).decode()
