"""Objectives by name: the weights of the terms, free of JAX, so that help comes at once."""

OBJECTIVES = {
    "efficiency": {"mass": 2.0, "time": 1.0, "work": 1.0},
    "productivity": {"mass": 2.0, "time": 2.0},
    "energy": {"mass": 2.0, "work": 2.0},
}
"""Named objectives; "efficiency" has the follow-up's weights, [2, 1, 1]."""
