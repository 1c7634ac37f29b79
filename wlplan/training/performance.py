"""Training of ψ_low and ψ_high. Paper, section 6.4.1."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from wlplan.dataset import Dataset, fingerprint, split
from wlplan.models.ensemble import Ensemble
from wlplan.models.layers import Mlp
from wlplan.models.normaliser import Normaliser
from wlplan.models.performance import PerformanceModel, PsiLow
from wlplan.models.performance_high import HighPerformanceModel, PsiHigh
from wlplan.training.evaluation import EvaluationReport, evaluate_performance, widening
from wlplan.training.fitting import Recipe, evenly, mirror_some, of_errors
from wlplan.training.session import Session
from wlplan.types import PyTree

# Weight of the likelihood of the errors in the loss of a member. The error itself and the hidden
# layers count there as given (Stirn et al. 2023), so that the likelihood does not lead the network
# to give up on what scatters much: trained by likelihood alone, members erred by 9.7 % in work in
# place of 5.7 %.
_SCATTER = 0.1


def train_psi_low(
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    epochs: int = 150,
    batch: int = 128,
    hidden: tuple[int, ...] = (512, 512),
    activation: str = "swish",
    dropout: float = 0.02,
    learning_rate: float = 2e-3,
    members: int = 1,
    loss: str = "huber",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PerformanceModel | Ensemble, EvaluationReport]:
    """Trains ψ_low on a data set and saves it.

    The data set is split by rollout. Of all epochs the weights with the least loss on the
    validation part are kept; the report is on the test part, which plays no role in training.
    Killed, the same call goes on where it was and ends with the same weights.

    Args:
        dataset: Loading cycles, of one or several data sets, each split by itself; those that are
            not valid are left out.
        out: Directory to save to; an older model there is replaced. None: nothing is saved.
        seed: Seed of the initial weights, the order of the cycles and the dropout. The split is
            the same for all seeds, so that their errors can be compared.
        epochs: Passes over the training part.
        batch: Cycles a step; at most those of the training part.
        hidden: Units of each hidden layer.
        activation: "swish" or "leaky_relu".
        dropout: Part of the hidden units that is dropped in training.
        learning_rate: Peak learning rate.
        members: More than one: an ensemble of so many, which also tells how far it may be off. They
            share data and split, and differ in initial weights, order of the cycles and dropout;
            the interval of nine in ten cycles is fitted to the validation part.
        loss: One of `LOSSES`: "huber" (ours) or "squared" (the paper's).
        progress: Called with the number of epochs done and in all.

    Returns:
        The model and its errors on the test part.

    Raises:
        InputError: If the data set is too small or not finite, if training diverges, or if the
            model cannot be saved.
    """
    recipe = Recipe(epochs, batch, learning_rate, seed=seed, members=members, loss=loss)
    session = Session(dataset, out, recipe, _tables)
    normalisers, examples = _normalised(session)

    def start(seed: int) -> PsiLow:
        network = PsiLow(
            hidden,
            activation=activation,
            dropout=dropout,
            scattered=members > 1,
            rngs=nnx.Rngs(seed),
        )
        assert network.scale_in is not None
        assert network.scale_out is not None
        network.scale_in.fit(examples[0]["inputs"])
        network.scale_out.fit(examples[0]["outputs"])
        return network

    def mean_loss(network: PsiLow, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        return _mean_loss(network, e["inputs"], e["outputs"], loss, rngs)

    networks = [start(number) for number in recipe.seeds]
    best = session.fit(_all_or_one(networks), mean_loss, examples, progress=progress)
    model = PerformanceModel(params=best, graph=nnx.graphdef(networks[0]), **normalisers)
    return _finished(session, model, members)


def train_psi_high(
    dataset: Dataset | Sequence[Dataset],
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
    members: int = 1,
    loss: str = "huber",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[HighPerformanceModel | Ensemble, EvaluationReport]:
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
        members: More than one: an ensemble of so many.
        loss: "huber" (ours) or "squared" (the paper's).
        progress: Called with the number of epochs done and in all.

    Returns:
        The model and its errors on the test part.

    Raises:
        InputError: As for `train_psi_low`.
    """
    recipe = Recipe(epochs, batch, learning_rate, seed=seed, members=members, loss=loss)
    session = Session(dataset, out, recipe, _tables_with_maps)
    normalisers, examples = _normalised(session)

    def start(seed: int) -> PsiHigh:
        network = PsiHigh(
            hidden,
            encoder=encoder,
            activation=activation,
            dropout=dropout,
            scattered=members > 1,
            rngs=nnx.Rngs(seed),
        )
        network.fit_scales(**evenly(examples[0]))
        return network

    def mean_loss(network: PsiHigh, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        features = network.features(e["maps"], e["inputs"], training=rngs is not None)
        return _mean_loss(network.head, features, e["outputs"], loss, rngs)

    networks = [start(number) for number in recipe.seeds]
    best = session.fit(
        _all_or_one(networks),
        mean_loss,
        examples,
        augment=lambda key, e: {**e, "maps": mirror_some(key, e["maps"])[0]},
        progress=progress,
    )
    model = HighPerformanceModel(params=best, graph=nnx.graphdef(networks[0]), **normalisers)
    return _finished(session, model, members)


def held_out(dataset: Dataset, description: Mapping[str, Any]) -> Dataset:
    """The cycles of a data set that a model was not trained on.

    Args:
        dataset: Any data set.
        description: Description of the model, see `read_description`.

    Returns:
        Of a data set that the model was trained on, the test part; of another, everything.
    """
    if fingerprint(dataset) not in description.get("dataset", {}).get("fingerprints", ()):
        return dataset
    return split(dataset, fractions=tuple(description["training"]["fractions"]))[2]


def shares_piles(dataset: Dataset, description: Mapping[str, Any]) -> bool:
    """Whether a model was trained on a data set of the same seed.

    Data sets of one seed begin with the same piles and actions, whatever their protocol and size:
    of a data set that the model was not trained on, it still knows piles.

    Args:
        dataset: Any data set.
        description: Description of the model, see `read_description`.
    """
    seed = dataset.attributes.get("seed")
    return seed is not None and seed in description.get("dataset", {}).get("seeds", ())


def _tables(dataset: Dataset) -> dict[str, np.ndarray]:
    return {
        "inputs": np.concatenate([dataset.characteristics, dataset.action], axis=1),
        "outputs": np.stack([dataset.mass, dataset.time, dataset.work], axis=1),
    }


def _tables_with_maps(dataset: Dataset) -> dict[str, np.ndarray]:
    return _tables(dataset) | {"maps": dataset.h36}


def _normalised(session: Session) -> tuple[dict[str, Normaliser], list[dict[str, Array]]]:
    """Normalisers of the training part; both parts' examples in their units."""
    normalisers = {
        # All cells of all maps are one component: heights keep their proportions.
        name: Normaliser.of(values.reshape(-1, 1) if name == "maps" else values)
        for name, values in session.tables[0].items()
    }

    def units(name: str, values: np.ndarray) -> Array:
        rows = jnp.asarray(values).reshape(-1, len(normalisers[name].low))
        return jax.vmap(normalisers[name].normalise)(rows).reshape(values.shape)

    examples = [
        {name: units(name, values) for name, values in table.items()} for table in session.tables
    ]
    return normalisers, examples


def _all_or_one(networks: list[Any]) -> Any:
    return networks if len(networks) > 1 else networks[0]


def _mean_loss(
    head: Mlp,
    inputs: Float[Array, "n k"],
    wanted: Float[Array, "n 3"],
    loss: str,
    rngs: nnx.Rngs | None,
) -> Array:
    """Mean loss in units of the spread of each output; see `_SCATTER` for members."""
    if head.scatter is None:
        return jnp.mean(of_errors(head.in_spreads(head(inputs, rngs=rngs) - wanted), loss))
    predicted, variances = head.outputs_and_variances(inputs, rngs=rngs)
    errors = head.in_spreads(predicted - wanted)
    unlikely = jnp.log(variances) + jax.lax.stop_gradient(errors) ** 2 / variances
    return jnp.mean(of_errors(errors, loss)) + _SCATTER * jnp.mean(0.5 * unlikely)


def _finished(session: Session, model: Any, members: int) -> tuple[Any, EvaluationReport]:
    if members > 1:
        unfitted = Ensemble(model, factor=jnp.ones(3))
        model = unfitted.replace(factor=widening(unfitted, session.validation))
    return model, session.finish(model, evaluate_performance)
