"""Points at the place of the sensor itself, which are no part of the scene."""

from __future__ import annotations

import numpy as np

# Balls round the sensor [m], and how far away the nearest surface then is at least [m]: what is in
# the ball, if it is this many points, is the sensor itself or what it stands on. The part of them
# that may lie between is noise.
_BALLS, _APART, _CLUMP, _BETWEEN = (1.0, 0.5, 0.25), 0.5, 10, 0.02

# Zero, as integers times a scale plus an offset may miss it [m].
_ZERO = 1e-6

NEAR = max(_BALLS) + _APART
"""Distance from the sensor beyond which points play no role [m]."""


def at_sensor(places: np.ndarray, others: int = 0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Which points lie at the place of the sensor, at zero, bool [n], and notes of them.

    A return without a range is a point at zero. And a scanner sees itself there, while the nearest
    surface is some way off.

    Args:
        places: x, y and z in the frame of the sensor [m], shape [n, 3].
        others: Points of the scan beside those, all farther away than `NEAR`.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.sqrt((places**2).sum(axis=-1))
    zero = distance < _ZERO
    out = np.zeros(len(places), bool)
    notes = []
    # One may be the corner of a grid.
    if zero.sum() > 1:
        out |= zero
        notes.append(f"left out {int(zero.sum())} points at 0,0,0: returns without a range")
    total = len(places) + others - int(out.sum())
    for radius in _BALLS:
        ball = ~zero & (distance < radius)
        between = ~zero & ~ball & (distance < radius + _APART)
        count = int(ball.sum())
        if count >= _CLUMP and between.sum() <= _BETWEEN * count and 2 * count < total:
            out |= ball
            notes.append(
                f"left out {count} points within {radius:g} m of 0,0,0, apart from all others: "
                f"the scanner itself"
            )
            break
    return out, tuple(notes)
