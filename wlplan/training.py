"""Training, evaluating, saving and loading the learned models. Paper, section 6.4.

A saved model is a directory: an orbax checkpoint of the weights, and `model.json`, which says what
they are, where they come from, how good they are, and which bytes belong to them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import secrets
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float

from wlplan.dataset import Dataset, fingerprint, split, versions
from wlplan.errors import InputError
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import INPUTS, OUTPUTS, PerformanceModel, PsiLow

MODEL_FORMAT = "wlplan.model/1"

_DESCRIPTION, _WEIGHTS = "model.json", "weights"

# Training, validation and test. Paper, section 6.4: 10,718 cycles, 1,072 of them for the test,
# 10 % of the rest for validation.
_FRACTIONS = (0.8, 0.1, 0.1)
# Load from which an error relative to it says something [tonne]: a sixth of a full bucket. Of a
# bucket that comes out nearly empty any error is many times the load.
_LOADED = 0.5
# Weight decay of AdamW, and the part of the steps over which the learning rate rises before its
# cosine decay. Our choice; the paper uses Adam at a constant 1e-5 for up to 2,000 epochs.
_WEIGHT_DECAY, _WARM_UP = 1e-4, 0.05
# Gradients of more than this norm are scaled down to it.
_LARGEST_GRADIENT = 1.0


# --- evaluation


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors of predicted mass, time and work over a number of cycles."""

    cycles: int
    # Mean of |predicted - simulated| / simulated [1].
    mean_relative: dict[str, float]
    # Mean of |predicted - simulated| [tonne, s, kJ].
    mean_absolute: dict[str, float]
    # Sum of predicted over sum of simulated, less one [1]: what a long sequence accumulates.
    total_relative: dict[str, float]


@dataclasses.dataclass(frozen=True)
class EvaluationReport:
    """How a performance predictor does on cycles that it has not seen."""

    loaded_mass: float  # load from which a cycle counts as loaded [tonne]
    loaded: Errors  # over cycles with at least that load
    every: Errors  # over all valid cycles

    def as_dict(self) -> dict[str, Any]:
        """The report as JSON has it."""
        return dataclasses.asdict(self)


def evaluate_psi_low(model: PerformanceModel, dataset: Dataset) -> EvaluationReport:
    """Compares a model with the simulated cycles of a data set, or of a part of one.

    Errors relative to the load of a nearly empty bucket are large whatever the model does, so the
    report has them both with and without such cycles. Cycles that are not valid do not count.

    Raises:
        InputError: If no cycle is valid and loaded.
    """
    dataset = dataset.select(dataset.valid)
    loaded = dataset.mass >= _LOADED
    if not loaded.any():
        raise InputError(
            f"No cycle has a load of {_LOADED:g} t or more: there is nothing to evaluate on."
        )
    predicted = _predict(model, dataset.characteristics, dataset.action)
    by_name = {name: np.asarray(getattr(predicted, name)) for name in ("mass", "time", "work")}

    def errors(which: np.ndarray) -> Errors:
        parts: dict[str, list[float]] = {"relative": [], "absolute": [], "total": []}
        for name, values in by_name.items():
            got = values[which].astype(np.float64)
            want = getattr(dataset, name)[which].astype(np.float64)
            error = np.abs(got - want)
            # A load of nothing at all would make the mean infinite, which JSON cannot hold.
            parts["relative"].append(float(np.mean(error / np.maximum(np.abs(want), 1e-3))))
            parts["absolute"].append(float(np.mean(error)))
            parts["total"].append(float(got.sum() / want.sum() - 1.0))
        named = {key: dict(zip(by_name, values, strict=True)) for key, values in parts.items()}
        return Errors(int(which.sum()), named["relative"], named["absolute"], named["total"])

    return EvaluationReport(_LOADED, errors(loaded), errors(np.ones_like(loaded)))


@jax.jit
def _predict(model: PerformanceModel, characteristics: Array, action: Array) -> Any:
    return jax.vmap(model)(characteristics, action)


# --- training


def train_psi_low(
    dataset: Dataset,
    *,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    epochs: int = 300,
    batch: int = 256,
    hidden: tuple[int, ...] = (512, 512),
    activation: str = "swish",
    dropout: float = 0.1,
    learning_rate: float = 1e-3,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PerformanceModel, EvaluationReport]:
    """Trains ψ_low on a data set and saves it.

    The data set is split by rollout. Of all epochs the weights with the least loss on the
    validation part are kept; the report is on the test part, which plays no role in training.

    Args:
        dataset: Loading cycles; those that are not valid are left out.
        out: Directory to save to; an older model there is replaced. None: nothing is saved.
        seed: Seed of the initial weights, the order of the cycles and the dropout. The split is
            the same for all seeds, so that their errors can be compared.
        epochs: Passes over the training part.
        batch: Cycles a step; at most those of the training part.
        hidden: Units of each hidden layer.
        activation: "swish" or "leaky_relu".
        dropout: Part of the hidden units that is dropped in training.
        learning_rate: Peak learning rate.
        progress: Called with the number of epochs done and in all.

    Returns:
        The model and its errors on the test part.

    Raises:
        InputError: If the data set is too small or not finite, if training diverges, or if the
            model cannot be saved.
    """
    if epochs < 1 or batch < 1:
        raise InputError(
            f"{epochs} epochs of batches of {batch} asked for: both have to be at least 1."
        )
    if out is not None:
        _check_target(Path(out))
    parts = [part.select(part.valid) for part in split(dataset, fractions=_FRACTIONS)]
    if not all(len(part) for part in parts):
        raise InputError("The data set has too few valid cycles to split: collect more cycles.")
    tables = [(_inputs(part), _targets(part)) for part in parts]
    if not all(np.isfinite(values).all() for table in tables for values in table):
        raise InputError("The data set holds numbers that are not finite: collect it again.")
    inputs, outputs = (Normaliser.of(values) for values in tables[0])
    (x, y), (x_val, y_val), _ = [
        (jax.vmap(inputs.normalise)(jnp.asarray(a)), jax.vmap(outputs.normalise)(jnp.asarray(b)))
        for a, b in tables
    ]

    network = PsiLow(hidden, activation=activation, dropout=dropout, rngs=nnx.Rngs(seed))
    graph, params = nnx.split(network)
    batch = min(batch, len(x))
    optimiser = _optimiser(learning_rate, epochs * (len(x) // batch))
    run_epoch = jax.jit(partial(_epoch, graph, optimiser, batch))
    fit = Fit(params, optimiser.init(params), params, jnp.asarray(jnp.inf, x.dtype), jnp.asarray(0))
    for done in range(epochs):
        key = jax.random.fold_in(jax.random.key(seed), done)
        fit, losses = run_epoch(fit, key, jnp.asarray(done), (x, y), (x_val, y_val))
        if progress is not None:
            jax.block_until_ready(losses)
            progress(done + 1, epochs)
    training_loss, validation_loss = (float(loss) for loss in losses)
    if not np.isfinite(float(fit.best_loss)):
        raise InputError("The training diverged: use a smaller learning rate.")

    model = PerformanceModel(fit.best, inputs, outputs, graph)
    report = evaluate_psi_low(model, parts[2])
    if out is not None:
        description = {
            "training": {
                "seed": seed,
                "epochs": epochs,
                "batch": batch,
                "optimiser": "AdamW, cosine schedule",
                "learning_rate": learning_rate,
                "weight_decay": _WEIGHT_DECAY,
                "fractions": _FRACTIONS,
                "cycles": [len(part) for part in parts],
                "best_epoch": int(fit.best_epoch) + 1,
                "best_validation_loss": float(fit.best_loss),
                "last_training_loss": training_loss,
                "last_validation_loss": validation_loss,
            },
            "dataset": {"fingerprint": fingerprint(dataset), **dataset.attributes},
            "held_out": report.as_dict(),
        }
        save_model(out, model, description)
    return model, report


def held_out(dataset: Dataset, description: Mapping[str, Any]) -> Dataset:
    """The cycles of a data set that a model was not trained on.

    Args:
        dataset: Any data set.
        description: Description of the model, see `read_description`.

    Returns:
        Of the data set that the model was trained on, the test part; of another, everything.
    """
    if description.get("dataset", {}).get("fingerprint") != fingerprint(dataset):
        return dataset
    return split(dataset, fractions=tuple(description["training"]["fractions"]))[2]


def _inputs(dataset: Dataset) -> Float[np.ndarray, "n 8"]:
    return np.concatenate([dataset.characteristics, dataset.action], axis=1)


def _targets(dataset: Dataset) -> Float[np.ndarray, "n 3"]:
    return np.stack([dataset.mass, dataset.time, dataset.work], axis=1)


def _optimiser(learning_rate: float, steps: int) -> optax.GradientTransformation:
    rate = optax.warmup_cosine_decay_schedule(
        0.0, learning_rate, int(_WARM_UP * steps), max(steps, 1)
    )
    return optax.chain(
        optax.clip_by_global_norm(_LARGEST_GRADIENT),
        optax.adamw(rate, weight_decay=_WEIGHT_DECAY),
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fit:
    """What training carries from epoch to epoch."""

    params: Any
    optimiser: Any
    best: Any  # weights with the least validation loss so far
    best_loss: Any
    best_epoch: Any


def _epoch(
    graph: Any,
    optimiser: optax.GradientTransformation,
    batch: int,
    fit: Fit,
    key: Array,
    number: Array,
    train: tuple[Array, Array],
    validation: tuple[Array, Array],
) -> tuple[Fit, tuple[Array, Array]]:
    """One pass over the shuffled training data; the fit, training loss and validation loss."""
    order_key, dropout_key = jax.random.split(key)
    count = len(train[0])
    steps = count // batch
    # What does not fill a batch is left out, of each epoch another part.
    order = jax.random.permutation(order_key, count)[: steps * batch].reshape(steps, batch)
    keys = jax.random.split(dropout_key, steps)

    def loss_of(params: Any, x: Array, y: Array, dropout: Array | None) -> Array:
        rngs = None if dropout is None else nnx.Rngs(dropout=dropout)
        return jnp.mean((nnx.merge(graph, params)(x, rngs=rngs) - y) ** 2)

    def step(carry: tuple[Any, Any], inputs: tuple[Array, Array]) -> tuple[tuple[Any, Any], Array]:
        params, state = carry
        which, dropout = inputs
        loss, gradient = jax.value_and_grad(loss_of)(
            params, train[0][which], train[1][which], dropout
        )
        updates, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, updates), state), loss

    (params, state), losses = jax.lax.scan(step, (fit.params, fit.optimiser), (order, keys))
    loss = loss_of(params, *validation, None)
    better = loss < fit.best_loss
    best = jax.tree.map(partial(jnp.where, better), params, fit.best)
    return (
        Fit(
            params,
            state,
            best,
            jnp.where(better, loss, fit.best_loss),
            jnp.where(better, number, fit.best_epoch),
        ),
        (losses.mean(), loss),
    )


# --- saving and loading


def save_model(
    directory: str | os.PathLike[str], model: PerformanceModel, meta: Mapping[str, Any]
) -> None:
    """Saves a model as a directory, in one piece or not at all.

    Args:
        directory: Directory to write; an older model there is replaced.
        model: Model to save.
        meta: Further fields of `model.json`: data set, training, errors.

    Raises:
        InputError: If something that is not a model is there, or it cannot be written.
    """
    import orbax.checkpoint as ocp

    directory = Path(directory)
    _check_target(directory)
    network = nnx.merge(model.graph, model.params)
    # Arrays of the host: the checkpoint then holds no devices, and loads on any.
    weights = jax.tree.map(np.asarray, nnx.to_pure_dict(model.params))
    token = secrets.token_hex(4)
    beside = directory.with_name(f".{directory.name}.{token}.tmp").absolute()
    old = directory.with_name(f".{directory.name}.{token}.old")
    try:
        try:
            beside.mkdir(parents=True)
            with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as checkpointer:
                checkpointer.save(beside / _WEIGHTS, args=ocp.args.PyTreeSave(weights))
            # Names the directory it was made in, and nothing reads it on a file system that
            # renames in one step.
            (beside / _WEIGHTS / "commit_success.txt").unlink(missing_ok=True)
            description = {
                "format": MODEL_FORMAT,
                "kind": "psi_low",
                "architecture": {
                    "hidden": [layer.out_features for layer in network.hidden],
                    "activation": network.activation,
                    "dropout": network.dropout.rate,
                },
                "normaliser": {
                    "inputs": _normaliser_to_dict(model.inputs),
                    "outputs": _normaliser_to_dict(model.outputs),
                },
                "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
                "versions": versions(),
                **meta,
                "files": _digests(beside / _WEIGHTS),
            }
            text = json.dumps(description, indent=2, allow_nan=False) + "\n"
            (beside / _DESCRIPTION).write_text(text, "utf-8")
            if directory.exists():
                os.replace(directory, old)
            os.replace(beside, directory)
        except BaseException:
            if old.exists() and not directory.exists():
                os.replace(old, directory)
            raise
        finally:
            shutil.rmtree(beside, ignore_errors=True)
            shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(
            f"{directory}: cannot be written ({reason}): choose another place."
        ) from error


def load_model(directory: str | os.PathLike[str]) -> PerformanceModel:
    """Reads a model; writes nothing, so the directory may be read-only.

    Raises:
        InputError: If it is missing, damaged, or of another format.
    """
    import orbax.checkpoint as ocp

    directory = Path(directory)
    description = read_description(directory)
    try:
        shape = description["architecture"]
        network = nnx.eval_shape(
            lambda: PsiLow(
                tuple(shape["hidden"]),
                activation=shape["activation"],
                dropout=shape["dropout"],
                rngs=nnx.Rngs(0),
            )
        )
        graph, params = nnx.split(network)
        inputs, outputs = (
            _normaliser_of_dict(description["normaliser"][name], size)
            for name, size in (("inputs", INPUTS), ("outputs", OUTPUTS))
        )
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
    except Exception as error:
        # A damaged description makes anything fail; to the user it means the same.
        what = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{directory}: is damaged ({what}): copy or train it again.") from error
    nnx.replace_by_pure_dict(params, jax.tree.map(jnp.asarray, weights))
    return PerformanceModel(params, inputs, outputs, graph)


def read_description(directory: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of the `model.json` of a saved model.

    Raises:
        InputError: If it is missing, damaged, or of another format or kind.
    """
    directory = Path(directory)
    if not os.path.lexists(directory):
        raise InputError(f"{directory}: no such model: check the name, or train it first.")
    try:
        description = json.loads((directory / _DESCRIPTION).read_text("utf-8"))
        found, kind = description["format"], description["kind"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{directory}: is not a model of wlplan: name a directory that `wlplan train` wrote."
        ) from error
    if (found, kind) != (MODEL_FORMAT, "psi_low"):
        raise InputError(
            f"{directory}: is {kind!r} of format {found!r}, not 'psi_low' of {MODEL_FORMAT!r}: "
            f"choose another model."
        )
    return description


def _check_target(directory: Path) -> None:
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
        if any(directory.iterdir()) and not (directory / _DESCRIPTION).is_file():
            raise InputError(
                f"{directory}: holds something that is not a model: choose another place."
            )


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
    return Normaliser(*(jnp.asarray(part) for part in parts))
