"""StableHLO as `jax.export` keeps it: any batch, with what JAX needs to call it again."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from wlplan.errors import InputError, one_line
from wlplan.portable.function import PortableFunction

ENDING = "stablehlo"
LIBRARIES: tuple[str, ...] = ()


def content(function: PortableFunction) -> bytes:
    """The serialized `jax.export.Exported`."""
    (batch,) = export.symbolic_shape("batch")
    return bytes(exported(function, batch).serialize())


def exported(function: PortableFunction, batch: Any) -> export.Exported:
    """The function over a batch, traced.

    Args:
        function: For one case.
        batch: Number of cases, or a symbol for it.

    Raises:
        InputError: If it does what JAX does not export.
    """
    shapes = [
        jax.ShapeDtypeStruct((batch, *port.shape), jnp.dtype(port.dtype))
        for port in function.inputs
    ]
    # An input that the function does not look at is still one: all models of a kind look alike.
    mapped = jax.jit(jax.vmap(function.function), keep_unused=True)
    try:
        return export.export(mapped)(*shapes)
    except (ValueError, NotImplementedError) as error:
        # JAX refuses what calls back into Python, and what compilers promise nothing about.
        raise InputError(
            f"{function.name} cannot be exported as StableHLO ({one_line(error)}): leave out what "
            f"calls back into Python."
        ) from error


def outputs(content: bytes, function: PortableFunction) -> tuple[np.ndarray, ...]:
    """What the file computes."""
    read = export.deserialize(bytearray(content))
    return tuple(np.asarray(output) for output in jax.jit(read.call)(*function.cases))


def facts(content: bytes, function: PortableFunction) -> dict[str, Any]:
    """By which rules it is called, and where."""
    del function
    read = export.deserialize(bytearray(content))
    return {
        "batch": "any",
        "calling_convention_version": read.calling_convention_version,
        "platforms": list(read.platforms),
    }
