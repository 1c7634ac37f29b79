"""Test set-up: shapes are checked at run time, and what JAX would forgive is an error."""

import os

# Two workers share two cores; XLA reads this when JAX is imported.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax
import jaxtyping

jaxtyping.install_import_hook("wlplan", "beartype.beartype")
jax.config.update("jax_numpy_rank_promotion", "raise")  # type: ignore[no-untyped-call]
