"""Objectives by name: the weights of the terms, free of JAX, so that help comes at once."""

# A metre of way or lane that cannot be driven costs as much as half a typical load.
_TOUCHING = 2.0

OBJECTIVES = {
    "efficiency": {"mass": 2.0, "time": 1.0, "work": 1.0, "touching": _TOUCHING},
    "productivity": {"mass": 2.0, "time": 2.0, "touching": _TOUCHING},
    "delivery": {"time": 1.0, "work": 1.0, "touching": _TOUCHING},
    "energy": {"mass": 2.0, "work": 2.0, "touching": _TOUCHING},
}
"""Named objectives; "efficiency" has the follow-up's weights, [2, 1, 1], and room to drive;
"delivery" is for amounts in tonnes, where a small load costs a load more."""
