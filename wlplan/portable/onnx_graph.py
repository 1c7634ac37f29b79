"""A traced JAX function as an ONNX graph.

Learned predictors are matrix products and elementwise functions, and a loop with a bound that
depends on numbers. That is what is known here; whatever else a function does is refused by name.
No library that does this goes with the JAX that we use, see docs/export.md.
"""

from __future__ import annotations

import itertools
import string
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx
from jax.extend import core
from onnx import TensorProto, helper, numpy_helper

from wlplan.errors import InputError

OPSET, IR = 18, 8
"""Versions of the operators and of the file: those that ONNX Runtime 1.14 and later reads."""

# Without an attribute and with the operands as they are.
_SAME = {
    "abs": "Abs",
    "add": "Add",
    "add_any": "Add",
    "and": "And",
    "ceil": "Ceil",
    "cos": "Cos",
    "div": "Div",
    "eq": "Equal",
    "erf": "Erf",
    "exp": "Exp",
    "floor": "Floor",
    "ge": "GreaterOrEqual",
    "gt": "Greater",
    "le": "LessOrEqual",
    "log": "Log",
    "logistic": "Sigmoid",
    "lt": "Less",
    "max": "Max",
    "min": "Min",
    "mul": "Mul",
    "neg": "Neg",
    "not": "Not",
    "or": "Or",
    "pow": "Pow",
    "sign": "Sign",
    "sin": "Sin",
    "sqrt": "Sqrt",
    "sub": "Sub",
    "tan": "Tan",
    "tanh": "Tanh",
}
# What matters to JAX alone.
_IDENTITY = ("copy", "copy_p", "name", "optimization_barrier", "stop_gradient")
# Calls: their body is written out.
_CALLS = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call")
_REDUCTIONS = {
    "reduce_sum": "ReduceSum",
    "reduce_max": "ReduceMax",
    "reduce_min": "ReduceMin",
    "reduce_prod": "ReduceProd",
    "reduce_or": "ReduceMax",
    "reduce_and": "ReduceMin",
}


class Graph:
    """An ONNX graph in the making.

    Args:
        batch: The symbol that stands for the number of cases.
        first: Name of an input of the graph whose first axis is the batch.
    """

    def __init__(self, batch: Any, first: str):
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []
        self._batch, self._first = batch, first
        self._numbers = itertools.count()

    def add(self, closed: core.ClosedJaxpr, inputs: Sequence[str]) -> list[str]:
        """Writes out a traced function; names of its inputs -> names of its outputs.

        Raises:
            InputError: If it does what is not known here.
        """
        constants = [self.constant(np.asarray(value)) for value in closed.consts]
        return self._body(closed.jaxpr, [*constants, *inputs])

    def _body(self, jaxpr: core.Jaxpr, inputs: Sequence[str]) -> list[str]:
        names: dict[Any, str] = dict(zip([*jaxpr.constvars, *jaxpr.invars], inputs, strict=True))

        def name_of(atom: Any) -> str:
            if isinstance(atom, core.Literal):
                return self.constant(np.asarray(atom.val, _aval(atom).dtype))
            return names[atom]

        for equation in jaxpr.eqns:
            made = self._equation(equation, [name_of(atom) for atom in equation.invars])
            names.update(zip(equation.outvars, made, strict=True))
        return [name_of(atom) for atom in jaxpr.outvars]

    def _equation(self, equation: core.JaxprEqn, inputs: list[str]) -> list[str]:
        name, parameters = equation.primitive.name, equation.params
        if name in _SAME:
            self._check_logic(equation)
            return [self.node(_SAME[name], *inputs)]
        if name in _IDENTITY:
            return inputs
        if name in _CALLS:
            body = "jaxpr" if "jaxpr" in parameters else "call_jaxpr"
            return self.add(parameters[body], inputs)
        if name == "while":
            return self._loop(parameters, inputs)
        if name in _REDUCTIONS:
            return [self._reduced(equation, inputs[0])]
        if name == "unstack":
            return self._unstacked(equation, inputs[0])
        rule = _RULES.get(name)
        if rule is None:
            raise InputError(
                f"ONNX export does not know what JAX calls {name}: export as stablehlo instead."
            )
        return [rule(self, equation, inputs)]

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """One operator with one output; the name of that."""
        output = self._fresh()
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def shaped(self, value: str, shape: Sequence[Any]) -> str:
        """A value with another shape."""
        wanted = [size if isinstance(size, int) else -1 for size in shape]
        assert wanted.count(-1) <= 1
        return self.node("Reshape", value, self.whole(wanted))

    def expanded(self, value: str, shape: Sequence[Any]) -> str:
        """A value, with ones where it is the same along an axis, as large as a shape."""
        return self.node("Expand", value, self._shape(shape))

    def choice(self, which: str, one: str, other: str, dtype: Any) -> str:
        """One value where something is true, another one elsewhere."""
        if dtype != np.bool_:
            return self.node("Where", which, one, other)
        # ONNX Runtime has no Where of truth values.
        rest = self.node("And", self.node("Not", which), other)
        return self.node("Or", self.node("And", which, one), rest)

    def whole(self, values: Sequence[int | np.integer]) -> str:
        """Whole numbers, as operators take shapes and axes."""
        return self.constant(np.asarray(values, np.int64))

    def like(self, value: Any, atom: Any) -> str:
        """A number of the type of a variable."""
        return self.constant(np.asarray(value, _aval(atom).dtype))

    def _shape(self, shape: Sequence[Any]) -> str:
        if all(isinstance(size, int) for size in shape):
            return self.whole(shape)
        parts = [
            self.whole([size]) if isinstance(size, int) else self._size(size) for size in shape
        ]
        return self.node("Concat", *parts, axis=0)

    def _size(self, size: Any) -> str:
        """The number of cases, as a graph knows it once it is run."""
        assert size == self._batch
        # Made anew where it is needed: a loop does not show what is in it to what comes after.
        return self.node("Shape", self._first, start=0, end=1)

    def constant(self, value: np.ndarray) -> str:
        """Numbers that are known."""
        name = self._fresh()
        self.initializers.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def _fresh(self) -> str:
        return f"v{next(self._numbers)}"

    def _check_logic(self, equation: core.JaxprEqn) -> None:
        """`and`, `or` and `not` are known of truth values alone."""
        name = equation.primitive.name
        if name in ("and", "or", "not") and _aval(equation.invars[0]).dtype != np.bool_:
            raise InputError(
                f"ONNX export does not know what JAX calls {name} of whole numbers: export as "
                f"stablehlo instead."
            )

    def _reduced(self, equation: core.JaxprEqn, value: str) -> str:
        kind = _REDUCTIONS[equation.primitive.name]
        if not equation.params["axes"]:
            return value
        axes = self.whole(equation.params["axes"])
        if _aval(equation.invars[0]).dtype != np.bool_:
            return self.node(kind, value, axes, keepdims=0)
        number = self.node("Cast", value, to=TensorProto.INT32)
        return self.node("Cast", self.node(kind, number, axes, keepdims=0), to=TensorProto.BOOL)

    def _unstacked(self, equation: core.JaxprEqn, value: str) -> list[str]:
        """What lies side by side along an axis, apart."""
        axis = self.whole([equation.params["axis"]])
        parts = (
            self.node("Slice", value, self.whole([k]), self.whole([k + 1]), axis)
            for k in range(len(equation.outvars))
        )
        return [self.node("Squeeze", part, axis) for part in parts]

    def _loop(self, parameters: Any, inputs: list[str]) -> list[str]:
        """A `while` as a Loop: whether it goes on is asked before it, and after each round.

        Over a batch it goes on while one case does; the others then stay as they are.
        """
        cond, body = parameters["cond_jaxpr"], parameters["body_jaxpr"]
        seen, used = parameters["cond_nconsts"], parameters["body_nconsts"]
        asks, known = inputs[:seen], inputs[seen : seen + used]
        state = inputs[seen + used :]
        avals = [atom.aval for atom in body.jaxpr.invars[used:]]
        each = len(cond.jaxpr.outvars[0].aval.shape)

        def goes_on(state: Sequence[str]) -> str:
            (going,) = self.add(cond, [*asks, *state])
            return self._any(going, range(each)) if each else going

        def round_of(state: Sequence[str]) -> list[str]:
            after = self.add(body, [*known, *state])
            if not each:
                return after
            (going,) = self.add(cond, [*asks, *state])
            return [
                self.choice(self._in_front(going, each, aval), new, old, aval.dtype)
                for new, old, aval in zip(after, state, avals, strict=True)
            ]

        begins = goes_on(state)
        outer, self.nodes = self.nodes, []
        number, going = self._fresh(), self._fresh()
        carried = [self._fresh() for _ in state]
        after = round_of(carried)
        # Outputs are made inside, even where the body passes something on as it is.
        ends = [self.node("Identity", value) for value in (goes_on(after), *after)]
        inside, self.nodes = self.nodes, outer

        kinds = [_type(aval.dtype) for aval in avals]

        def values(names: Sequence[str], kinds: Sequence[int], scalars: int) -> list[Any]:
            shapes = [() if k < scalars else None for k in range(len(names))]
            return list(map(helper.make_tensor_value_info, names, kinds, shapes))

        head = [TensorProto.INT64, TensorProto.BOOL]
        graph = helper.make_graph(
            inside,
            "body",
            values([number, going, *carried], [*head, *kinds], 2),
            values(ends, [TensorProto.BOOL, *kinds], 1),
        )
        outputs = [self._fresh() for _ in state]
        self.nodes.append(helper.make_node("Loop", ["", begins, *state], outputs, body=graph))
        return outputs

    def _any(self, value: str, axes: Sequence[int]) -> str:
        number = self.node("Cast", value, to=TensorProto.INT32)
        most = self.node("ReduceMax", number, self.whole(axes), keepdims=0)
        return self.node("Cast", most, to=TensorProto.BOOL)

    def _in_front(self, value: str, axes: int, aval: Any) -> str:
        """A value with its axes as the first of a larger array."""
        more = range(axes, len(aval.shape))
        return self.node("Unsqueeze", value, self.whole(more)) if more else value


Rule = Callable[[Graph, core.JaxprEqn, list[str]], str]


def _aval(atom: Any) -> Any:
    """Shape and type of what goes in or comes out."""
    return atom.aval


def _type(dtype: Any) -> int:
    return int(helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))


def _broadcast_in_dim(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    shape, places = equation.params["shape"], equation.params["broadcast_dimensions"]
    sizes = dict(zip(places, _aval(equation.invars[0]).shape, strict=True))
    ones = [sizes.get(axis, 1) for axis in range(len(shape))]
    value = graph.shaped(inputs[0], ones)
    return value if tuple(ones) == tuple(shape) else graph.expanded(value, shape)


def _reshaped(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.shaped(inputs[0], _aval(equation.outvars[0]).shape)


def _transpose(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Transpose", inputs[0], perm=list(equation.params["permutation"]))


def _concatenate(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Concat", *inputs, axis=equation.params["dimension"])


def _stack(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    axis = equation.params["axis"]
    shape = list(_aval(equation.outvars[0]).shape)
    shape[axis] = 1
    return graph.node("Concat", *(graph.shaped(value, shape) for value in inputs), axis=axis)


def _slice(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    parameters = equation.params
    starts, limits = parameters["start_indices"], parameters["limit_indices"]
    strides = parameters["strides"] or [1] * len(starts)
    # An axis of all cases is kept whole.
    axes = [axis for axis, limit in enumerate(limits) if isinstance(limit, int)]
    first, last, step = ([values[axis] for axis in axes] for values in (starts, limits, strides))
    return graph.node("Slice", inputs[0], *map(graph.whole, (first, last, axes, step)))


def _pad(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    low, high, inside = zip(*equation.params["padding_config"], strict=True)
    if any(inside) or min(*low, *high) < 0:
        raise InputError(
            "ONNX export does not know padding between numbers: export as stablehlo instead."
        )
    return graph.node("Pad", inputs[0], graph.whole([*low, *high]), inputs[1])


def _dot_general(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    (left_sum, right_sum), (left_batch, right_batch) = equation.params["dimension_numbers"]
    letters = iter(string.ascii_letters)
    left = [next(letters) for _ in _aval(equation.invars[0]).shape]
    right = [next(letters) for _ in _aval(equation.invars[1]).shape]
    for ours, theirs in ((left_sum, right_sum), (left_batch, right_batch)):
        for k, other in zip(ours, theirs, strict=True):
            right[other] = left[k]
    result = [left[k] for k in left_batch]
    result += [x for k, x in enumerate(left) if k not in (*left_sum, *left_batch)]
    result += [x for k, x in enumerate(right) if k not in (*right_sum, *right_batch)]
    rule = f"{''.join(left)},{''.join(right)}->{''.join(result)}"
    return graph.node("Einsum", *inputs, equation=rule)


def _select_n(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    which, *choices = inputs
    if len(choices) != 2 or _aval(equation.invars[0]).dtype != np.bool_:
        raise InputError(
            "ONNX export does not know a choice of more than two: export as stablehlo instead."
        )
    return graph.choice(which, choices[1], choices[0], _aval(equation.outvars[0]).dtype)


def _clamp(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    low, value, high = inputs
    return graph.node("Min", graph.node("Max", value, low), high)


def _cast(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Cast", inputs[0], to=_type(equation.params["new_dtype"]))


def _integer_pow(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Pow", inputs[0], graph.like(equation.params["y"], equation.invars[0]))


def _square(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Mul", inputs[0], inputs[0])


def _rsqrt(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Reciprocal", graph.node("Sqrt", inputs[0]))


def _log1p(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Log", graph.node("Add", inputs[0], graph.like(1, equation.invars[0])))


def _expm1(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    return graph.node("Sub", graph.node("Exp", inputs[0]), graph.like(1, equation.invars[0]))


def _unequal(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    if _aval(equation.invars[0]).dtype == np.bool_:
        return graph.node("Xor", *inputs)
    return graph.node("Not", graph.node("Equal", *inputs))


def _atan2(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    """By the arc tangent, which ONNX has, and the quadrant."""
    y, x = inputs
    zero, pi, half = (graph.like(v, equation.invars[0]) for v in (0.0, np.pi, 0.5 * np.pi))
    nowhere = graph.node("Equal", x, zero)
    safe = graph.node("Where", nowhere, graph.like(1.0, equation.invars[0]), x)
    angle = graph.node("Atan", graph.node("Div", y, safe))
    upward = graph.node("GreaterOrEqual", y, zero)
    turn = graph.node("Where", upward, pi, graph.node("Neg", pi))
    beside = graph.node("Mul", graph.node("Sign", y), half)
    behind = graph.node("Where", graph.node("Less", x, zero), graph.node("Add", angle, turn), angle)
    return graph.node("Where", nowhere, beside, behind)


def _iota(graph: Graph, equation: core.JaxprEqn, inputs: list[str]) -> str:
    shape, axis = _aval(equation.outvars[0]).shape, equation.params["dimension"]
    ones = [size if k == axis else 1 for k, size in enumerate(shape)]
    if not isinstance(shape[axis], int):
        raise InputError(
            "ONNX export does not know the number of a case: export as stablehlo instead."
        )
    values = np.arange(shape[axis], dtype=_aval(equation.outvars[0]).dtype).reshape(ones)
    return graph.expanded(graph.constant(values), shape)


_RULES: dict[str, Rule] = {
    "atan2": _atan2,
    "broadcast_in_dim": _broadcast_in_dim,
    "clamp": _clamp,
    "concatenate": _concatenate,
    "convert_element_type": _cast,
    "dot_general": _dot_general,
    "expand_dims": _reshaped,
    "expm1": _expm1,
    "integer_pow": _integer_pow,
    "iota": _iota,
    "log1p": _log1p,
    "ne": _unequal,
    "pad": _pad,
    "reshape": _reshaped,
    "rsqrt": _rsqrt,
    "select_n": _select_n,
    "slice": _slice,
    "square": _square,
    "squeeze": _reshaped,
    "stack": _stack,
    "transpose": _transpose,
}
