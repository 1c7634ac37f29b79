"""Heights in a result: in whole centimetres, in few bytes."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from jaxtyping import Float

_METRES = 0.01
# Height over the ground that counts as soil [m].
_SOIL = 0.05


def packed(heights: Float[np.ndarray, "n nx ny"]) -> dict[str, Any]:
    """Grids of heights [m] as a value of JSON: see `unpacked`.

    What changes little from one grid to the next takes little room.
    """
    whole = np.rint(np.asarray(heights, np.float64) / _METRES).astype("<i2")
    steps = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1]))
    steps[0] = np.diff(steps[0], axis=0, prepend=np.zeros_like(steps[0, :1]))
    content = zlib.compress(steps.tobytes(), 9)
    return {"shape": list(whole.shape), "centimetres": base64.b64encode(content).decode()}


def unpacked(value: dict[str, Any]) -> Float[np.ndarray, "n nx ny"]:
    """The heights of `packed` [m].

    The text is base64 of zlib of two-byte integers, low byte first: of the first grid the
    differences along its first axis, then of each grid those to the one before.
    """
    content = zlib.decompress(base64.b64decode(value["centimetres"]))
    steps = np.frombuffer(content, "<i2").reshape(value["shape"]).astype(np.int64)
    steps[0] = np.cumsum(steps[0], axis=0)
    heights: np.ndarray = _METRES * np.cumsum(steps, axis=0)
    return heights


def around_pile(
    heights: Float[np.ndarray, "n nx ny"], margin: int
) -> tuple[Float[np.ndarray, "n mx my"], tuple[int, int]]:
    """The part of grids that holds soil in any of them, and some ground around it.

    Args:
        heights: Over level ground [m].
        margin: Ground that is kept around the soil [cells].

    Returns:
        The part, and its first row and column.
    """
    cells = np.argwhere(heights.max(axis=0) > _SOIL)
    low = np.maximum(cells.min(axis=0) - margin, 0)
    high = cells.max(axis=0) + margin + 1
    return heights[:, low[0] : high[0], low[1] : high[1]], (int(low[0]), int(low[1]))
