"""Training of ψ_low and ψ_high. Paper, section 6.4.1."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from wlplan.dataset import Dataset, fingerprint, split, versions
from wlplan.errors import InputError
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import PerformanceModel, PsiLow
from wlplan.models.performance_high import HighPerformanceModel, PsiHigh
from wlplan.training.evaluation import EvaluationReport, evaluate_performance
from wlplan.training.fitting import Recipe, SavedState, fitted
from wlplan.training.storage import architecture, check_target, save_model
from wlplan.types import PyTree

# Training, validation and test. Paper, section 6.4: 10,718 cycles, 1,072 of them for the test,
# 10 % of the rest for validation.
_FRACTIONS = (0.8, 0.1, 0.1)


def train_psi_low(
    dataset: Dataset,
    *,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    epochs: int = 150,
    batch: int = 128,
    hidden: tuple[int, ...] = (512, 512),
    activation: str = "swish",
    dropout: float = 0.02,
    learning_rate: float = 2e-3,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PerformanceModel, EvaluationReport]:
    """Trains ψ_low on a data set and saves it.

    The data set is split by rollout. Of all epochs the weights with the least loss on the
    validation part are kept; the report is on the test part, which plays no role in training.
    Killed, the same call goes on where it was and ends with the same weights.

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
    recipe = Recipe(epochs, batch, learning_rate, seed=seed)
    data = _prepared(dataset, out)
    network = PsiLow(hidden, activation=activation, dropout=dropout, rngs=nnx.Rngs(seed))
    assert network.scale_in is not None
    assert network.scale_out is not None
    network.scale_in.fit(data.examples[0]["inputs"])
    network.scale_out.fit(data.examples[0]["outputs"])
    model, record = _trained(
        PerformanceModel,
        network,
        lambda network, e, rngs: _loss(network, network(e["inputs"], rngs=rngs), e["outputs"]),
        data,
        recipe,
        None,
        progress,
    )
    return model, _finished(model, dataset, data, record)


def train_psi_high(
    dataset: Dataset,
    *,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    epochs: int = 150,
    batch: int = 128,
    hidden: tuple[int, ...] = (512, 512),
    encoder: str = "principal",
    activation: str = "swish",
    dropout: float = 0.1,
    learning_rate: float = 2e-3,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[HighPerformanceModel, EvaluationReport]:
    """Trains ψ_high on a data set and saves it.

    Half of the maps of a step, chosen anew each time, are mirrored: what a loading yields does not
    depend on left and right. All else as for `train_psi_low`, the arguments included.

    Args:
        dataset: Loading cycles.
        out: Directory to save to, or None.
        seed: Seed of everything random but the split.
        epochs: Passes over the training part.
        batch: Cycles a step.
        hidden: Units of each hidden layer behind the encoder; the paper's special models have
            (2048, 2048).
        encoder: "convolutional" (the paper's) or "principal" (ours).
        activation: "swish" or "leaky_relu".
        dropout: Part of the hidden units that is dropped in training.
        learning_rate: Peak learning rate.
        progress: Called with the number of epochs done and in all.

    Returns:
        The model and its errors on the test part.

    Raises:
        InputError: As for `train_psi_low`.
    """
    recipe = Recipe(epochs, batch, learning_rate, seed=seed)
    data = _prepared(dataset, out, with_maps=True)
    network = PsiHigh(
        hidden, encoder=encoder, activation=activation, dropout=dropout, rngs=nnx.Rngs(seed)
    )
    network.fit_scales(**data.examples[0])
    model, record = _trained(
        HighPerformanceModel,
        network,
        lambda network, e, rngs: _loss(
            network.head, network(e["maps"], e["inputs"], rngs=rngs), e["outputs"]
        ),
        data,
        recipe,
        _mirror_some,
        progress,
    )
    return model, _finished(model, dataset, data, record)


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


@dataclasses.dataclass(frozen=True)
class _Prepared:
    """A data set, split and normalised."""

    out: Path | None
    fingerprint: str
    parts: list[Dataset]
    normalisers: dict[str, Normaliser]
    examples: list[dict[str, Array]]  # of each part, by the names of the normalisers


def _prepared(
    dataset: Dataset, out: str | os.PathLike[str] | None, *, with_maps: bool = False
) -> _Prepared:
    if out is not None:
        check_target(Path(out))
    parts = [part.select(part.valid) for part in split(dataset, fractions=_FRACTIONS)]
    if not all(len(part) for part in parts):
        raise InputError("The data set has too few valid cycles to split: collect more cycles.")
    tables = [_tables(part, with_maps) for part in parts]
    if not all(np.isfinite(values).all() for table in tables for values in table.values()):
        raise InputError("The data set holds numbers that are not finite: collect it again.")
    normalisers = {
        # All cells of all maps are one component: heights keep their proportions.
        name: Normaliser.of(values.reshape(-1, 1) if name == "maps" else values)
        for name, values in tables[0].items()
    }
    examples = [
        {name: _normalised(normalisers[name], values) for name, values in table.items()}
        for table in tables
    ]
    return _Prepared(
        None if out is None else Path(out), fingerprint(dataset), parts, normalisers, examples
    )


def _tables(dataset: Dataset, with_maps: bool) -> dict[str, np.ndarray]:
    tables = {
        "inputs": np.concatenate([dataset.characteristics, dataset.action], axis=1),
        "outputs": np.stack([dataset.mass, dataset.time, dataset.work], axis=1),
    }
    return tables | ({"maps": dataset.h36} if with_maps else {})


def _normalised(normaliser: Normaliser, values: np.ndarray) -> Array:
    """A table, or maps as one component, in units of the range."""
    rows = jnp.asarray(values).reshape(-1, len(normaliser.low))
    return jax.vmap(normaliser.normalise)(rows).reshape(values.shape)


def _loss(head: Any, predicted: Float[Array, "n 3"], wanted: Float[Array, "n 3"]) -> Array:
    """Mean squared error in units of the spread of each output."""
    return jnp.mean(head.in_spreads(predicted - wanted) ** 2)


def _mirror_some(key: Array, examples: PyTree) -> PyTree:
    maps = examples["maps"]
    mirrored = jax.random.bernoulli(key, 0.5, (len(maps), 1, 1))
    return {**examples, "maps": jnp.where(mirrored, maps[:, :, ::-1], maps)}


def _trained(
    make: Callable[..., Any],
    network: nnx.Module,
    loss: Callable[..., Array],
    data: _Prepared,
    recipe: Recipe,
    augment: Callable[[Array, PyTree], PyTree] | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[Any, dict[str, Any]]:
    graph = nnx.graphdef(network)
    state = None
    if data.out is not None:
        identity = {
            "dataset": data.fingerprint,
            "recipe": recipe.as_dict(),
            "architecture": architecture(network),
            "versions": versions(),
        }
        place = data.out.absolute()
        state = SavedState(place.with_name(f".{place.name}.training.npz"), identity)
    best, record = fitted(
        network,
        loss,
        data.examples[0],
        data.examples[1],
        recipe,
        augment=augment,
        state=state,
        progress=progress,
    )
    record |= {"fractions": _FRACTIONS, "cycles": [len(part) for part in data.parts]}
    return make(params=best, graph=graph, **data.normalisers), {"training": record, "state": state}


def _finished(
    model: PerformanceModel | HighPerformanceModel,
    dataset: Dataset,
    data: _Prepared,
    record: dict[str, Any],
) -> EvaluationReport:
    """Evaluates the model and saves it."""
    report = evaluate_performance(model, data.parts[2])
    if data.out is not None:
        description = {
            "training": record["training"],
            "dataset": {"fingerprint": data.fingerprint, **dataset.attributes},
            "held_out": report.as_dict(),
        }
        save_model(data.out, model, description)
        record["state"].remove()
    return report
