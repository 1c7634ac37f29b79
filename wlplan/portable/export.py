"""Writes a function to files, reads them back, and compares what they compute with the original."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Shaped

from wlplan.errors import InputError, one_line
from wlplan.io.files import atomic_folder
from wlplan.io.libraries import library
from wlplan.io.provenance import command, versions
from wlplan.portable import FORMATS, TOLERANCE, formats
from wlplan.portable.function import Port, PortableFunction

FORMAT = "wlplan.export/1"

_DESCRIPTION, _CHECK = "export.json", "check.npz"

Numbers = tuple[Shaped[np.ndarray, "n ..."], ...]


@dataclasses.dataclass(frozen=True)
class Compared:
    """What a file computes, beside the original.

    Attributes:
        file: Name of the file.
        largest: Largest difference of each output, in its unit.
        relative: The same in parts of the largest value of that output.
    """

    file: str
    largest: Mapping[str, float]
    relative: Mapping[str, float]

    @property
    def worst(self) -> str:
        """The output that is off the most, in parts of its largest value."""
        return max(self.relative, key=lambda name: self.relative[name])


def check_formats(kinds: Sequence[str]) -> None:
    """Finds out whether all is there that kinds of files need, before anything long is begun.

    Raises:
        InputError: If a library is missing.
    """
    for kind in kinds:
        for name in _format(kind).LIBRARIES:
            try:
                with library(name, install="wlplan[export]"):
                    pass
            except InputError as error:
                raise InputError(f"{kind}: {error}") from error


def check_place(folder: str | os.PathLike[str]) -> None:
    """Refuses to replace anything but an earlier export.

    Raises:
        InputError: If a file is there, or a folder that holds something else.
    """
    place = Path(folder)
    if not os.path.lexists(place):
        return
    if not place.is_dir():
        raise InputError(f"{place}: is a file: name a folder for the export.")
    present = {entry.name for entry in place.iterdir()}
    if present - _files_of(place):
        raise InputError(
            f"{place}: holds something that is no export of wlplan: choose another folder."
        )


def _files_of(place: Path) -> set[str]:
    """Names of the files of the export in a folder; none if there is no export."""
    try:
        record = json.loads((place / _DESCRIPTION).read_text("utf-8"))
        if record["format"] != FORMAT:
            return set()
        return {_DESCRIPTION, _CHECK, *record["files"]}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def export(
    function: PortableFunction,
    folder: str | os.PathLike[str],
    *,
    kinds: Sequence[str] = ("stablehlo",),
    tolerance: float = TOLERANCE,
) -> list[Compared]:
    """Writes a function to a folder: a file of each kind, what it is, and a check of its numbers.

    Each file is read back and run on the cases of the function. What it computes is compared with
    what the function itself computes, case by case. `export.json` names inputs and outputs,
    `check.npz` holds the cases as `input_NAME` and what the function makes of them as
    `output_NAME`, so that the check can be made again elsewhere.

    Args:
        function: What is exported.
        folder: Where to. An earlier export there is replaced.
        kinds: Of `wlplan.portable.FORMATS`.
        tolerance: See `wlplan.portable.TOLERANCE`.

    Returns:
        How each file compares.

    Raises:
        InputError: If a library is missing, a kind of file cannot hold the function, a file is off
            by more than the tolerance, or the place is taken or cannot be written. Nothing is left
            behind then.
    """
    if not kinds:
        raise InputError(f"no kind of file was asked for: choose of {', '.join(FORMATS)}.")
    if unknown := [kind for kind in kinds if kind not in FORMATS]:
        raise InputError(f"unknown kind of file {unknown[0]!r}: choose of {', '.join(FORMATS)}.")
    if not 0.0 <= tolerance < float("inf"):
        raise InputError(f"the tolerance is {tolerance:g}: give 0 or more.")
    check_formats(kinds)
    check_place(folder)
    expected = _outputs(function)
    contents: dict[str, bytes] = {}
    facts: dict[str, dict[str, Any]] = {}
    compared = []
    for kind in dict.fromkeys(kinds):
        made = _format(kind)
        name = f"{function.name}.{made.ENDING}"
        contents[name] = made.content(function)
        found = compare(function, name, made.outputs(contents[name], function), expected)
        check_agrees(found, tolerance)
        compared.append(found)
        facts[name] = {
            "kind": kind,
            "sha256": hashlib.sha256(contents[name]).hexdigest(),
            **made.facts(contents[name], function),
            "largest_difference": dict(found.largest),
            "relative_difference": dict(found.relative),
        }
    contents[_CHECK] = _check_file(function, expected)
    contents[_DESCRIPTION] = _description(function, facts, tolerance)
    try:
        with atomic_folder(folder, existing="replace") as new:
            for name, content in contents.items():
                (new / name).write_bytes(content)
    except OSError as error:
        reason = one_line(error.strerror or error)
        raise InputError(f"{folder}: cannot be written ({reason}): choose another.") from error
    return compared


def compare(function: PortableFunction, file: str, found: Numbers, expected: Numbers) -> Compared:
    """How far outputs are off.

    Args:
        function: Whose they are.
        file: That they came from.
        found: Outputs of the file.
        expected: Outputs of the function.

    Raises:
        InputError: If an output has another shape or type.
    """
    largest, relative = {}, {}
    for port, got, want in zip(function.outputs, found, expected, strict=True):
        if got.shape != want.shape or got.dtype != want.dtype:
            raise InputError(
                f"{file}: {port.name} comes back as {got.dtype}{got.shape}, not as "
                f"{want.dtype}{want.shape}: this kind of file cannot hold the function."
            )
        off = np.abs(got.astype(np.float64) - want.astype(np.float64))
        # What is no number on one side only is off without bound.
        both = (
            np.isnan(got) & np.isnan(want) if want.dtype.kind == "f" else np.zeros_like(off, bool)
        )
        off = np.where(both, 0.0, np.where(np.isnan(off), np.inf, off))
        size = float(np.abs(np.where(np.isfinite(want), want, 0)).max(initial=0.0))
        largest[port.name] = float(off.max(initial=0.0))
        relative[port.name] = largest[port.name] / size if size else largest[port.name]
    return Compared(file, largest, relative)


def check_agrees(compared: Compared, tolerance: float) -> None:
    """Refuses a file that computes something else than the function.

    Raises:
        InputError: If an output is off by more than the tolerance.
    """
    worst = compared.worst
    if not compared.relative[worst] <= tolerance:
        raise InputError(
            f"{compared.file}: {worst} is off by {compared.largest[worst]:.3g}, "
            f"{compared.relative[worst]:.2g} of its largest value, more than the tolerance of "
            f"{tolerance:g}: nothing was written; choose another kind of file or --tolerance."
        )


def _format(kind: str) -> Any:
    return importlib.import_module(f"{formats.__name__}.{kind}")


def _outputs(function: PortableFunction) -> Numbers:
    """What the function makes of its cases, one after the other, as whoever calls it would."""
    one = jax.jit(function.function)
    rows = [
        [np.asarray(output) for output in one(*(case[n] for case in function.cases))]
        for n in range(len(function.cases[0]))
    ]
    return tuple(np.stack(column) for column in zip(*rows, strict=True))


def _check_file(function: PortableFunction, expected: Numbers) -> bytes:
    arrays = {
        **{
            f"input_{port.name}": v for port, v in zip(function.inputs, function.cases, strict=True)
        },
        **{f"output_{port.name}": v for port, v in zip(function.outputs, expected, strict=True)},
    }
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _description(function: PortableFunction, facts: Mapping[str, Any], tolerance: float) -> bytes:
    record = {
        "format": FORMAT,
        "name": function.name,
        "meaning": function.meaning,
        "inputs": [_port(port) for port in function.inputs],
        "outputs": [_port(port) for port in function.outputs],
        "files": facts,
        "check": {
            "file": _CHECK,
            "cases": len(function.cases[0]),
            "tolerance": tolerance,
        },
        "origin": dict(function.origin),
        "command": command(),
        "versions": versions(),
    }
    # A difference without bound never gets here.
    return (json.dumps(record, indent=2, allow_nan=False) + "\n").encode()


def _port(port: Port) -> dict[str, Any]:
    return {
        "name": port.name,
        "meaning": port.meaning,
        "shape": ["batch", *port.shape],
        "dtype": port.dtype,
        "unit": port.unit,
        "frame": port.frame,
    }
