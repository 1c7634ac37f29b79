"""Test set-up: shapes are checked at run time, and what JAX would forgive is an error."""

import os
from pathlib import Path

# Compiling takes most of the time: a program is compiled once for all tests, both workers and the
# processes that they start. JAX locks the folder, and removes what was not used for longest.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "xla")
)
os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(2**30))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
# Two workers share two cores; and programs that run for moments are not worth XLA's last effort.
# `wlplan plan` leaves the fusion emitters out too, see `wlplan.cli.programs`.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_multi_thread_eigen=false --xla_backend_optimization_level=1 "
    "--xla_cpu_use_fusion_emitters=false",
)

import examples
import jax
import jaxtyping
import pytest
from browsers import browser as browser

jaxtyping.install_import_hook("wlplan", "beartype.beartype")
jax.config.update("jax_numpy_rank_promotion", "raise")
examples.load_profile()


def pytest_addoption(parser: pytest.Parser) -> None:
    """How much the tests do that can go on for as long as one likes; `make soak` does more."""
    parser.addoption("--plans", type=int, default=500, help="random plans in each world")
    parser.addoption("--kills", type=int, default=5, help="kills of `collect` and of `train`")
