"""Test set-up: shapes are checked at run time, and what JAX would forgive is an error."""

import os

# Before JAX is imported: two workers share two cores.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jaxtyping

jaxtyping.install_import_hook("wlplan", "beartype.beartype")

import jax

jax.config.update("jax_numpy_rank_promotion", "raise")
