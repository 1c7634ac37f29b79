"""Functions whose traces are kept from one process to the next.

What XLA compiled JAX keeps by itself, but to find it there it traces and lowers the function anew:
half of what a short command takes. So what was lowered is kept too, as StableHLO, under a name made
of all that it hangs on: the source of this package, what is static in the arguments, and shapes and
types of the arrays. Where something cannot be named for certain, as a function of a user's, it is
traced as ever.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import hashlib
import importlib
import importlib.resources
import inspect
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

from wlplan.io.files import replace_file

VARIABLE = "WLPLAN_TRACES"
"""Of the environment: the folder where traces are kept, for the present versions of all packages;
if it is not set, none are."""
ENDING = ".stablehlo"
"""Of their files."""

# Packages in which a name stands for one thing, as long as the versions are the same.
_KNOWN = ("wlplan", "jax", "jaxlib", "flax", "optax", "numpy", "builtins")


class Traced:
    """A compiled function, as of `jax.jit`, whose trace is kept.

    Called while another function is traced, and elsewhere than on a single CPU, it is what
    `jax.jit` makes of it.

    Args:
        function: Pure function of pytrees.
        static_argnames: Of arguments that are no pytrees; they are given by keyword.
    """

    def __init__(self, function: Callable[..., Any], static_argnames: Sequence[str] = ()):
        functools.update_wrapper(self, function)
        self._function, self._static = function, frozenset(static_argnames)
        self._jitted = jax.jit(function, static_argnames=tuple(static_argnames))
        self._programs: dict[Any, Callable[..., Any] | None] = {}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """The function's result."""
        folder = os.environ.get(VARIABLE)
        if not folder or jax.default_backend() != "cpu" or jax.local_device_count() > 1:
            return self._jitted(*arguments, **named)
        static = {name: value for name, value in named.items() if name in self._static}
        of_arrays = {name: value for name, value in named.items() if name not in self._static}
        leaves, tree = jax.tree.flatten((arguments, of_arrays))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self._jitted(*arguments, **named)
        call = _Call(self._function, tree, tuple(map(_kind, leaves)), tuple(sorted(static.items())))
        if call not in self._programs:
            self._programs[call] = _program(call, Path(folder), leaves)
        program = self._programs[call]
        return self._jitted(*arguments, **named) if program is None else program(*leaves)


def traced(static_argnames: Sequence[str] = ()) -> Callable[[Callable[..., Any]], Traced]:
    """`Traced` as a decorator."""
    return functools.partial(Traced, static_argnames=static_argnames)


def _kind(leaf: Any) -> tuple[Any, ...]:
    of = jax.typeof(leaf)
    return of.shape, of.dtype, of.weak_type


class NamelessError(Exception):
    """Something that the name of a trace cannot hold."""


@dataclasses.dataclass(frozen=True)
class _Call:
    """What a trace hangs on, beside the package and its settings."""

    function: Callable[..., Any]
    tree: Any  # of the arguments
    kinds: tuple[Any, ...]  # of their leaves: shape, type, whether that is weak
    static: tuple[tuple[str, Any], ...]
    # The precision is a setting of the thread.
    number: Any = dataclasses.field(default_factory=lambda: jax.dtypes.canonicalize_dtype(float))

    def name(self) -> str:
        """One that no other call has.

        Raises:
            NamelessError: If that cannot be said.
        """
        # Settings of JAX may change what is traced.
        settings = {k: v for k, v in sorted(os.environ.items()) if k.startswith("JAX_")}
        kinds = [[list(shape), str(dtype), bool(weak)] for shape, dtype, weak in self.kinds]
        parts = [_source(), settings, name_of(self.function), _tree(self.tree), kinds]
        parts += [plain(self.static), str(self.number)]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]

    def lowered(self, leaves: Sequence[Any]) -> export.Exported:
        """What is kept of it."""

        def flat(*leaves: Any) -> Any:
            arguments, named = self.tree.unflatten(leaves)
            return self.function(*arguments, **named, **dict(self.static))

        flat.__name__ = getattr(self.function, "__name__", "flat")
        return export.export(jax.jit(flat), platforms=["cpu"])(*leaves)


def _program(call: _Call, folder: Path, leaves: Sequence[Any]) -> Callable[..., Any] | None:
    """The call as a function of its leaves, from its file or else traced and then kept.

    None: it has no name. What cannot be written is for this process alone: it is not traced twice.
    """
    try:
        path = folder / (call.name() + ENDING)
    except NamelessError:
        return None
    kept = read(path)
    if kept is None:
        kept = call.lowered(leaves)
        # No room, something static in the result, or no flatbuffers, which JAX does not install.
        with contextlib.suppress(OSError, NamelessError, ImportError):
            write(path, kept)

    def run(*leaves: Any) -> Any:
        return kept.call(*leaves)

    # As profiles have it.
    run.__name__ = getattr(call.function, "__name__", "run")
    compiled = jax.jit(run)

    def free(*leaves: Any) -> Any:
        # JAX has what comes of a kept trace committed to its device, and would compile all anew
        # that is called with it. On a CPU nothing is copied here. Other threads go on meanwhile,
        # as they would not while numpy waits.
        tree: Any
        done, tree = jax.tree.flatten(jax.block_until_ready(compiled(*leaves)))
        return tree.unflatten(jax.device_put([np.asarray(leaf) for leaf in done]))

    return free


# --- files: classes of the result, check sum, program


def write(path: Path, program: export.Exported) -> None:
    """Writes what was lowered.

    Raises:
        NamelessError: If its result has something that cannot be written.
        OSError: If the file cannot be written.
    """
    classes = sorted(set(_register_all(program.out_tree)))
    body = bytes(program.serialize())
    head = json.dumps({"classes": classes, "sha256": hashlib.sha256(body).hexdigest()})
    replace_file(path, head.encode() + b"\n" + body)


def read(path: Path) -> export.Exported | None:
    """What was lowered; None if there is no such file, or not a whole one."""
    try:
        head, _, body = path.read_bytes().partition(b"\n")
        said = json.loads(head)
        if said["sha256"] != hashlib.sha256(body).hexdigest():
            return None
        for name in said["classes"]:
            _register(_object(name))
        return export.deserialize(bytearray(body))
    except (OSError, ValueError, KeyError, TypeError, ImportError, NamelessError):
        return None


# Programs are traced in several threads, and JAX takes a class once.
_registering = threading.Lock()


def _register(kind: type) -> None:
    """Has JAX write and read results of a class of ours."""
    with _registering:
        _register_once(kind)


@functools.cache
def _register_once(kind: type) -> None:
    if issubclass(kind, tuple):
        export.register_namedtuple_serialization(kind, serialized_name=name_of(kind))
        return
    export.register_pytree_node_serialization(
        kind,
        serialized_name=name_of(kind),
        serialize_auxdata=_packed,
        deserialize_auxdata=lambda text: tuple(json.loads(bytes(text))),
    )


def _register_all(tree: Any) -> Iterator[str]:
    """Registers our classes in a tree, and yields their names."""
    node = tree.node_data()
    if node is not None and node[0].__module__.partition(".")[0] not in ("builtins", "jax"):
        _register(node[0])
        yield name_of(node[0])
    for child in tree.children():
        yield from _register_all(child)


def _packed(static: Any) -> bytes:
    kinds = (bool, int, float, str, type(None))
    if type(static) is not tuple or not all(type(one) in kinds for one in static):
        raise NamelessError
    return json.dumps(static).encode()


# --- names


@functools.cache
def _source() -> str:
    """Of the package: while it is written its version stays the same."""
    found = hashlib.sha256()
    folder = Path(str(importlib.resources.files("wlplan")))
    for path in sorted(folder.rglob("*.py")):
        found.update(path.relative_to(folder).as_posix().encode() + b"\n" + path.read_bytes())
    return found.hexdigest()


def name_of(one: Any) -> str:
    """Module and name of a class or function, where it is what is found under them.

    Of a part of a function the arguments that it has, too.

    Raises:
        NamelessError: If it is not: one made in a function, or of a package that is not known.
    """
    if isinstance(one, functools.partial):
        return json.dumps([name_of(one.func), plain(one.args), plain(one.keywords)])
    name = f"{getattr(one, '__module__', '')}:{getattr(one, '__qualname__', '')}"
    if one is not type(None) and inspect.unwrap(_object(name)) is not inspect.unwrap(one):
        raise NamelessError
    return name


def _object(name: str) -> Any:
    module, _, path = name.partition(":")
    if module.partition(".")[0] not in _KNOWN:
        raise NamelessError
    try:
        return functools.reduce(getattr, path.split("."), importlib.import_module(module))
    except (AttributeError, ImportError) as error:
        raise NamelessError from error


def _tree(tree: Any) -> Any:
    node = tree.node_data()
    children = [_tree(child) for child in tree.children()]
    return children if node is None else [name_of(node[0]), plain(node[1]), children]


def plain(value: Any) -> Any:
    """Something static as JSON can hold it; where two differ, so do these.

    Raises:
        NamelessError: If it holds something that is not known.
    """
    kind = type(value)
    if kind in (bool, int, str, type(None)):
        return value
    if kind is float:
        return ["float", value.hex()]
    if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
        return ["array", str(value.dtype), list(value.shape), value.tobytes().hex()]
    if isinstance(value, np.dtype):
        return ["dtype", value.str]
    if kind is type(jax.tree.structure(0)):
        return ["tree", _tree(value)]
    if callable(value) and hasattr(value, "__qualname__"):
        return ["named", name_of(value)]
    of_kind = name_of(kind)
    if isinstance(value, enum.Enum):
        return [of_kind, value.name]
    if isinstance(value, tuple | list):
        return [of_kind, *map(plain, value)]
    if isinstance(value, Mapping):
        return [of_kind, *([plain(key), plain(one)] for key, one in value.items())]
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return [of_kind, *([name, plain(getattr(value, name))] for name in names)]
    if of_kind.startswith("wlplan.") and hasattr(value, "__dict__"):
        return [of_kind, plain(vars(value))]
    raise NamelessError
