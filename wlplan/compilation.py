"""Compiling large differentiated programs quickly on the CPU.

Programs like the gradient of a rollout are many small loops over small grids. Without fusion
emitters and at the first optimisation level XLA compiled them faster on the CPU, and what it made
ran faster too.
For the simulator's batches the opposite holds, so this is chosen function by function.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax

_OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}


@functools.cache
def _options() -> dict[str, Any]:
    """The options, where this backend and this version of XLA know them."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x + 1.0, compiler_options=_OPTIONS)(0.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return _OPTIONS


def jit_small_loops(
    function: Callable[..., Any], *, static_argnames: tuple[str, ...] = ()
) -> Callable[..., Any]:
    """`jax.jit` for programs of many small loops; the backend is asked at the first call."""

    @functools.cache
    def compiled() -> Callable[..., Any]:
        return jax.jit(function, static_argnames=static_argnames, compiler_options=_options())

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return compiled()(*args, **kwargs)

    return call
