"""Objectives by name: the weights of the terms, free of JAX, so that help comes at once."""

# A metre of way or lane that cannot be driven costs as much as half a typical load.
_TOUCHING = 2.0
_EFFICIENCY = {"mass": 2.0, "time": 1.0, "work": 1.0, "touching": _TOUCHING}

OBJECTIVES = {
    "efficiency": _EFFICIENCY,
    "productivity": {"mass": 2.0, "time": 2.0, "touching": _TOUCHING},
    "delivery": {"time": 1.0, "work": 1.0, "touching": _TOUCHING},
    "energy": {"mass": 2.0, "work": 2.0, "touching": _TOUCHING},
    "careful": {**_EFFICIENCY, "mass_deviation": 4.0},
}
"""Named objectives; "efficiency" has the follow-up's weights, [2, 1, 1], and room to drive;
"delivery" is for amounts in tonnes, where a small load costs a load more; "careful" is efficiency
with each load two standard deviations lighter than foreseen, for soil that is not as believed."""
