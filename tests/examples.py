"""How many examples hypothesis tries: few and always the same, or many for `make fuzz`."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

# So many times as many as in the tests; `make fuzz` sets it, and examples are then random.
TIMES = int(os.environ.get("WLPLAN_FUZZ", "0"))


def examples(few: int) -> int:
    """How many a law tries that makes do with few in the tests."""
    return few * max(TIMES, 1)


def load_profile() -> None:
    """Sets what holds for all laws that say nothing else."""
    settings.register_profile(
        "tests",
        derandomize=not TIMES,
        max_examples=examples(10),
        deadline=None,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
    settings.load_profile("tests")
