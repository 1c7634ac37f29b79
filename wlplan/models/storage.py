"""Models on disk: a directory with an orbax checkpoint of the weights, and `model.json`.

The latter says what the weights are, where they come from, how good they are, and which bytes
belong to them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import nnx

from wlplan.errors import InputError, one_line
from wlplan.io.documents import check_kinds, parse_json
from wlplan.io.files import atomic_folder, is_ours, named
from wlplan.io.provenance import command, versions
from wlplan.models.ensemble import Ensemble, members_of
from wlplan.models.grid import GRID
from wlplan.models.layers import Mlp
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import INPUTS, OUTPUTS, PerformanceModel
from wlplan.models.phi import HeightChange, HeightChangeModel
from wlplan.models.phi_vae import PhiVae, VaePileStateModel
from wlplan.models.psi_high import HighPerformanceModel, PsiHigh
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.models.stall import StallModel, StallNetwork
from wlplan.xla import on_device

MODEL_FORMAT = "wlplan.model/1"

Model = PerformanceModel | HeightChangeModel | VaePileStateModel | StallModel | Ensemble

_DESCRIPTION, _WEIGHTS = "model.json", "weights"
# What the fields of a description are that are looked at.
_FIELDS = {
    **dict.fromkeys(("architecture", "normaliser", "grid", "ensemble", "files"), dict),
    **dict.fromkeys(("dataset", "training", "versions", "held_out"), dict),
}

# Most hidden layers of a network, most units of each, and most members of an ensemble: a network is
# built before its weights are read, and a description may name any number.
_MOST_LAYERS, _MOST_UNITS, _MOST_MEMBERS = 64, 1 << 16, 1000


class _Kind(NamedTuple):
    """What belongs to a kind of model. Its name is what is saved; those of the classes are not."""

    model: Any
    network: Any
    perceptron: Callable[[Any], Mlp]  # of a network, the part that has hidden layers
    normalisers: dict[str, int]  # fields of the model, and how many numbers are in each


_KINDS = {
    "psi_low": _Kind(
        LowPerformanceModel,
        PsiLow,
        lambda network: network,
        {"inputs": INPUTS, "outputs": OUTPUTS},
    ),
    "psi_high": _Kind(
        HighPerformanceModel,
        PsiHigh,
        lambda network: network.head,
        {"maps": 1, "inputs": INPUTS, "outputs": OUTPUTS},
    ),
    "phi": _Kind(HeightChangeModel, HeightChange, lambda network: network.weights, {}),
    "phi_vae": _Kind(VaePileStateModel, PhiVae, lambda network: network.step, {}),
    "stall": _Kind(
        StallModel, StallNetwork, lambda network: network.head, {"maps": 1, "inputs": INPUTS}
    ),
}


def kind_of(model: Model) -> str:
    """The name under which a model is saved."""
    made = type(members_of(model))
    return next(name for name, kind in _KINDS.items() if kind.model is made)


def architecture(network: Any) -> dict[str, Any]:
    """What a network has to be built with anew: arguments of its class, as JSON has them."""
    kind = next(kind for kind in _KINDS.values() if isinstance(network, kind.network))
    perceptron: Any = kind.perceptron(network)
    record = {
        "hidden": [layer.out_features for layer in perceptron.hidden],
        "dropout": perceptron.dropout.rate,
    }
    # The paper's φ has one activation function only.
    if not isinstance(network, PhiVae):
        record["activation"] = perceptron.activation
    if isinstance(network, PsiHigh):
        record["encoder"] = network.encoder_name
    if isinstance(network, PsiLow | PsiHigh):
        record["scattered"] = perceptron.scatter is not None
    return record


def _network(kind: str, record: Mapping[str, Any]) -> Any:
    hidden = record["hidden"]
    if len(hidden) > _MOST_LAYERS or not all(
        type(units) is int and 0 < units <= _MOST_UNITS for units in hidden
    ):
        raise ValueError(f"its hidden layers are {hidden}")
    arguments = {**record, "hidden": tuple(hidden)}
    # The record of the ψ_low that ships says that it is standardised, as all are.
    arguments.pop("standardised", None)
    return _KINDS[kind].network(rngs=nnx.Rngs(0), **arguments)


def save_model(directory: str | os.PathLike[str], model: Model, meta: Mapping[str, Any]) -> None:
    """Saves a model as a directory, in one piece or not at all.

    Args:
        directory: Directory to write; an older model there is replaced.
        model: Model to save.
        meta: Further fields of `model.json`: data set, training, errors.

    Raises:
        InputError: If something that is not a model is there, or it cannot be written.
    """
    directory = Path(directory)
    check_target(directory)
    kind = kind_of(model)
    member = members_of(model)
    network = nnx.merge(member.graph, member.params)
    # Arrays of the host: the checkpoint then holds no devices, and loads on any.
    weights = jax.tree.map(np.asarray, nnx.to_pure_dict(member.params))
    try:
        with atomic_folder(directory, existing="replace") as new:
            _write_weights(new / _WEIGHTS, weights)
            # Names the directory it was made in, and nothing reads it on a file system that
            # renames in one step.
            (new / _WEIGHTS / "commit_success.txt").unlink(missing_ok=True)
            description = {
                "format": MODEL_FORMAT,
                "kind": kind,
                "architecture": architecture(network),
                "normaliser": {
                    name: _normaliser_to_dict(getattr(member, name))
                    for name in _KINDS[kind].normalisers
                },
                "grid": GRID,
                **({"ensemble": _ensemble_to_dict(model)} if isinstance(model, Ensemble) else {}),
                "command": command(),
                "versions": versions(),
                **meta,
                "files": _digests(new / _WEIGHTS),
            }
            text = json.dumps(description, indent=2, allow_nan=False) + "\n"
            (new / _DESCRIPTION).write_text(text, "utf-8")
    except OSError as error:
        reason = one_line(error.strerror or error)
        raise InputError(
            f"{directory}: cannot be written ({reason}): choose another place."
        ) from error


def _write_weights(path: Path, weights: Any) -> None:
    """Writes a checkpoint.

    Raises:
        OSError: If it cannot be written.
    """
    import orbax.checkpoint as ocp

    # It logs pages on stderr of what it also raises.
    log = logging.getLogger("absl")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as checkpointer:
            checkpointer.save(path, args=ocp.args.PyTreeSave(weights))
    except ValueError as error:
        # What writes the arrays is no Python and knows no `OSError`.
        if (told := re.search(r"os_error_code='(\d+)'", str(error))) is None:
            raise
        code = int(told[1])
        raise OSError(code, os.strerror(code)) from error
    finally:
        log.setLevel(level)


def load_model(directory: str | os.PathLike[str], kind: str = "psi_low") -> Model:
    """Reads a model; writes nothing, so the directory may be read-only.

    Args:
        directory: Where `save_model` wrote it.
        kind: "psi_low", "psi_high", "phi" (ours), "phi_vae" (as in the paper) or "stall".

    Returns:
        The model; an `Ensemble` if there are several of it.

    Raises:
        InputError: If it is missing, damaged, of another format or kind, or for another grid.
    """
    import orbax.checkpoint as ocp

    directory = Path(directory)
    description = read_description(directory, kind)
    if (grid := description.get("grid")) != GRID:
        raise InputError(
            f"{directory}: was trained on local maps of another grid than today's "
            f"({_of_grid(grid)}): train it again."
        )
    try:
        shape = description["architecture"]
        graph, params = nnx.split(nnx.eval_shape(lambda: _network(kind, shape)))
        members, calibration = _ensemble_of_dict(description.get("ensemble"))
        if members:
            params = jax.tree.map(
                lambda leaf: jax.ShapeDtypeStruct((members, *leaf.shape), leaf.dtype), params
            )
        normalisers = {
            name: _normaliser_of_dict(description["normaliser"][name], size)
            for name, size in _KINDS[kind].normalisers.items()
        }
        # Checked before orbax reads them: it would report damage at length, or wait.
        if _digests(directory / _WEIGHTS) != description["files"]:
            raise ValueError("the weights are not those that were saved")
        expected = nnx.to_pure_dict(params)
        as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), expected)
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as checkpointer:
            weights = checkpointer.restore(
                (directory / _WEIGHTS).absolute(),
                args=ocp.args.PyTreeRestore(item=expected, restore_args=as_numpy),
            )
        for want, got in zip(jax.tree.leaves(expected), jax.tree.leaves(weights), strict=True):
            if want.shape != got.shape:
                raise ValueError(f"weights of shape {got.shape}, not {want.shape}")
            if got.dtype.kind != "f" or not np.isfinite(got).all():
                raise ValueError("weights that are no finite numbers")
    except Exception as error:
        # A damaged description makes anything fail; to the user it means the same.
        what = one_line(error)
        raise InputError(f"{directory}: is damaged ({what}): copy or train it again.") from error
    nnx.replace_by_pure_dict(params, jax.tree.map(on_device, weights))
    model = _KINDS[kind].model(params=params, graph=graph, **normalisers)
    return Ensemble(model, **calibration) if members else model


def read_description(
    directory: str | os.PathLike[str], kind: str | None = "psi_low"
) -> dict[str, Any]:
    """The content of the `model.json` of a saved model.

    Args:
        directory: Where `save_model` wrote it.
        kind: Kind of model that is expected; None: any.

    Raises:
        InputError: If it is missing, damaged, or of another format or kind.
    """
    directory = Path(directory)
    if not os.path.lexists(directory):
        raise InputError(f"{directory}: no such model: check the name, or train it first.")
    try:
        description: dict[str, Any] = parse_json((directory / _DESCRIPTION).read_bytes())
        found, got = description["format"], description["kind"]
    except (OSError, InputError, KeyError, TypeError) as error:
        raise InputError(
            f"{directory}: is not a model of wlplan: name a directory that `wlplan train` wrote."
        ) from error
    kinds = tuple(_KINDS) if kind is None else (kind,)
    with named(directory):
        check_kinds(description, _FIELDS)
        check_kinds(description.get("dataset", {}), {"fingerprints": list, "seeds": list})
        check_kinds(description.get("training", {}), {"fractions": list, "settings": dict})
    if found != MODEL_FORMAT or got not in kinds:
        raise InputError(
            f"{directory}: is {got!r} of format {found!r}, not {' or '.join(map(repr, kinds))} of "
            f"{MODEL_FORMAT!r}: choose another model."
        )
    return description


def check_target(directory: Path) -> None:
    """Refuses to replace anything but a model."""
    place = directory.absolute().parent
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise InputError(f"{directory}: {place} is a file: name a directory for the model.")
    if not os.path.lexists(directory):
        return
    if not directory.is_dir():
        raise InputError(f"{directory}: is a file: name a directory for the model.")
    with contextlib.suppress(OSError):
        found = {entry.name for entry in directory.iterdir()}
        others = sorted(found - {_DESCRIPTION, _WEIGHTS})
        # It is replaced as a whole.
        if others or (found and not is_ours(directory / _DESCRIPTION)):
            what = one_line(others[0]) if others else "something"
            raise InputError(f"{directory}: is not a model, it holds {what}: choose another place.")


def _digests(directory: Path) -> dict[str, str]:
    """Hash of every file below a directory, by its path there."""
    files = sorted(path for path in directory.rglob("*") if path.is_file())
    return {
        path.relative_to(directory).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def _normaliser_to_dict(normaliser: Normaliser) -> dict[str, list[float]]:
    return {name: np.asarray(getattr(normaliser, name)).tolist() for name in ("low", "span")}


def _normaliser_of_dict(record: Mapping[str, Any], size: int) -> Normaliser:
    parts = [np.array(record[name], np.float32) for name in ("low", "span")]
    if any(part.shape != (size,) or not np.isfinite(part).all() for part in parts):
        raise ValueError("the normaliser does not fit")
    return Normaliser(*map(on_device, parts))


def _ensemble_to_dict(ensemble: Ensemble) -> dict[str, Any]:
    return {
        "members": ensemble.size,
        "factor": np.asarray(ensemble.factor).tolist(),
        "bias": np.asarray(ensemble.bias).tolist(),
    }


def _ensemble_of_dict(record: Mapping[str, Any] | None) -> tuple[int, dict[str, jax.Array]]:
    """Number of members, 0 of a model that is no ensemble, and how they are calibrated."""
    if record is None:
        return 0, {}
    factor = np.array(record["factor"], np.float32)
    # Models of before had none.
    bias = np.array(record.get("bias", np.zeros(3)), np.float32)
    if (
        not 2 <= record["members"] <= _MOST_MEMBERS
        or factor.shape != (3,)
        or not (factor > 0.0).all()
    ):
        raise ValueError("the record of the ensemble makes no sense")
    if bias.shape != (3,) or not np.isfinite(bias).all():
        raise ValueError("the bias of the ensemble makes no sense")
    return int(record["members"]), {"factor": on_device(factor), "bias": on_device(bias)}


def _of_grid(record: Any) -> str:
    """What is different about a grid, in words."""
    found = record if isinstance(record, dict) else {}
    wrong = (name for name in GRID if found.get(name) != GRID[name])
    return ", ".join(f"{name} {found.get(name)}, not {GRID[name]:g}" for name in wrong) or "unknown"
