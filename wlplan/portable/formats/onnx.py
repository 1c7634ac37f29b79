"""ONNX, for the runtimes of networks: any batch. Predictors go in it, whole worlds do not."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from wlplan.errors import InputError, one_line
from wlplan.portable.function import Port, PortableFunction

ENDING = "onnx"
LIBRARIES = ("onnx", "onnxruntime")

_BATCH = "batch"


def content(function: PortableFunction) -> bytes:
    """The serialized model.

    Raises:
        InputError: If the function does what the export does not know.
    """
    import onnx
    from onnx import helper

    from wlplan.portable.onnx_graph import IR, OPSET, Graph

    (batch,) = export.symbolic_shape(_BATCH)
    shapes = [
        jax.ShapeDtypeStruct((batch, *port.shape), jnp.dtype(port.dtype))
        for port in function.inputs
    ]
    traced = jax.make_jaxpr(jax.vmap(function.function))(*shapes)
    graph = Graph(batch, function.inputs[0].name)
    made = graph.add(traced, [port.name for port in function.inputs])
    for port, value in zip(function.outputs, made, strict=True):
        graph.nodes.append(helper.make_node("Identity", [value], [port.name]))
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            function.name,
            [_info(port) for port in function.inputs],
            [_info(port) for port in function.outputs],
            graph.initializers,
            doc_string=function.meaning,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        producer_name="wlplan",
    )
    model.ir_version = IR
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def outputs(content: bytes, function: PortableFunction) -> tuple[np.ndarray, ...]:
    """What the file computes in ONNX Runtime, on the CPU.

    Raises:
        InputError: If ONNX Runtime lacks an operator.
    """
    import onnxruntime

    given = {port.name: case for port, case in zip(function.inputs, function.cases, strict=True)}
    try:
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        return tuple(session.run([port.name for port in function.outputs], given))
    except Exception as error:
        # It has a class of its own for each kind of failure, and none above them.
        raise InputError(
            f"{function.name}: ONNX Runtime does not take it ({one_line(error)}): export as "
            f"stablehlo instead."
        ) from error


def facts(content: bytes, function: PortableFunction) -> dict[str, Any]:
    """The versions that a reader has to know."""
    del function
    import onnx

    model = onnx.load_model_from_string(content)
    return {
        "batch": "any",
        "opset": model.opset_import[0].version,
        "ir_version": model.ir_version,
    }


def _info(port: Port) -> Any:
    from onnx import helper

    kind = helper.np_dtype_to_tensor_dtype(np.dtype(port.dtype))
    text = f"{port.meaning} [{port.unit}]"
    return helper.make_tensor_value_info(port.name, kind, (_BATCH, *port.shape), doc_string=text)
