"""Loading as an environment for reinforcement learning.

`episodes` has the pure functions, to be jitted and mapped; `gym` wraps them for gymnasium, which
knows them as `wlplan/Loading-v0` once this is imported.
"""

from __future__ import annotations

import importlib.util

NAME = "wlplan/Loading-v0"
"""By which gymnasium makes it."""

if importlib.util.find_spec("gymnasium") is not None:
    import gymnasium

    if NAME not in gymnasium.registry:
        gymnasium.register(
            NAME,
            entry_point="wlplan.environment.gym:LoadingEnv",
            vector_entry_point="wlplan.environment.gym:LoadingVectorEnv",
        )
