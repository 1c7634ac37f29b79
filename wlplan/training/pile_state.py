"""Training and errors of the pile state predictors. Paper, sections 6.4.2 and 7.2."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE, KG_PER_TONNE
from wlplan.dataset import Dataset
from wlplan.errors import InputError
from wlplan.models.height_change import HeightChange, HeightChangeModel
from wlplan.models.pile_state import Phi, PileStateModel, scaled
from wlplan.terrain.heightmap import STATE_DISPLACEMENT
from wlplan.training.fitting import Recipe, evenly, mirror_some
from wlplan.training.session import Session
from wlplan.types import LocalHeightmap, PyTree

# Density where a data set does not name its soil [kg/m³]: gravel. Paper, table of the simulator.
_DENSITY = 1727.0
# Weight of the divergence beside the squared error. Paper, section 6.4.2. We read both as sums,
# over cells and over the code: with the mean over 2,704 cells the code would tell nothing.
_DIVERGENCE = 0.1
# Cycles predicted at a time, and whose components are taken at a time: they bound the memory.
_CHUNK, _PORTION = 64, 4096


@dataclasses.dataclass(frozen=True)
class PileStateErrors:
    """Errors of a predicted pile state over a number of cycles. Paper, equation 15."""

    cycles: int
    # Mean of the volume between predicted and simulated surface [m³].
    mean_absolute: float
    # Mean of that volume over the volume under the simulated surface [1].
    mean_relative: float
    # Predicted over loaded volume, less one, of the sums over all cycles [1].
    total_volume: float

    def as_dict(self) -> dict[str, Any]:
        """The errors as JSON has them."""
        return dataclasses.asdict(self)


def evaluate_pile_state(
    model: HeightChangeModel | PileStateModel, dataset: Dataset, *, blend: bool = True
) -> PileStateErrors:
    """Compares a model with the simulated cycles of a data set, or of a part of one.

    A model that asks for the load is given the simulated one, so that it answers for its own errors
    alone. As floor it has the lowest cell of each map.

    Args:
        model: Pile state predictor.
        dataset: Cycles; those that are not valid do not count.
        blend: Whether the paper's predictor blends with the map before along the edges.

    Raises:
        InputError: If no cycle is valid.
    """
    dataset = dataset.select(dataset.valid)
    if not len(dataset):
        raise InputError("No cycle is valid: there is nothing to evaluate on.")
    return pile_state_errors(predict_pile_state(model, dataset, blend=blend), dataset)


def pile_state_errors(predicted: Float[np.ndarray, "n 52 52"], dataset: Dataset) -> PileStateErrors:
    """The errors of predicted maps, see `evaluate_pile_state`.

    Args:
        predicted: Maps after the loading, over the reference of those before [m].
        dataset: The cycles.
    """
    wrong = misplaced_volume(predicted, dataset)
    under = np.abs(dataset.h52_after.astype(np.float64)).sum(axis=(1, 2)) * CELL_SIZE**2
    left = (dataset.h52.astype(np.float64) - predicted).sum() * CELL_SIZE**2
    loaded = _known(dataset)[:, 4].astype(np.float64).sum()
    return PileStateErrors(
        len(dataset),
        float(wrong.mean()),
        float((wrong / np.maximum(under, 1e-9)).mean()),
        float(left / max(loaded, 1e-9) - 1.0),
    )


def misplaced_volume(
    predicted: Float[np.ndarray, "n 52 52"], dataset: Dataset
) -> Float[np.ndarray, " n"]:
    """Volume between predicted and simulated surface of each cycle [m³]. Paper, equation 15.

    Args:
        predicted: Maps after the loading, over the reference of those before [m].
        dataset: The cycles.
    """
    wrong = np.abs(predicted - dataset.h52_after.astype(np.float64))
    return wrong.sum(axis=(1, 2)) * CELL_SIZE**2


def predict_pile_state(
    model: HeightChangeModel | PileStateModel, dataset: Dataset, *, blend: bool = True
) -> Float[np.ndarray, "n 52 52"]:
    """Maps after the loading [m], over the reference of those before; see `evaluate_pile_state`."""
    before, known = jnp.asarray(dataset.h52), jnp.asarray(_known(dataset))
    return np.asarray(_predicted(model, before, known, blend=blend))


@partial(jax.jit, static_argnames="blend")
def _predicted(model: Any, before: Array, known: Array, *, blend: bool) -> Array:
    def one(cycle: tuple[Array, Array]) -> Array:
        height, known = cycle
        local = LocalHeightmap(height, CELL_SIZE, STATE_DISPLACEMENT)
        if isinstance(model, PileStateModel):
            return model(local, known[:4], blend=blend)
        ground = jnp.full_like(height, height.min())
        return height + model(local, known[:4], known[4], ground)

    return jax.lax.map(one, (before, known), batch_size=_CHUNK)


def train_phi(
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    epochs: int = 100,
    batch: int = 128,
    hidden: tuple[int, ...] = (512, 512),
    activation: str = "swish",
    dropout: float = 0.05,
    learning_rate: float = 2e-3,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[HeightChangeModel, PileStateErrors]:
    """Trains our pile state predictor on a data set and saves it.

    Split, choice of the weights, mirrored maps and resuming are as for `train_psi_high`.

    Args:
        dataset: Loading cycles, of one or several data sets; those that are not valid are left out.
        out: Directory to save to; an older model there is replaced. None: nothing is saved.
        seed: Seed of everything random but the split.
        epochs: Passes over the training part.
        batch: Cycles a step.
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
    session = Session(dataset, out, recipe, _tables)
    network = HeightChange(hidden, activation=activation, dropout=dropout, rngs=nnx.Rngs(seed))
    network.fit_scales(**evenly(session.tables[0]))
    # The components are not trained: what they make of the maps is the same in every epoch.
    examples = [_components(network, table) for table in session.tables]
    # In units of the first component, which brings the loss to the order of one.
    spread = float(examples[0]["change"].std(axis=0).max()) or 1.0

    def loss(network: Any, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        error = network.of_components(e["before"], e["known"], rngs=rngs) - e["change"]
        return jnp.mean(jnp.sum((error / spread) ** 2, axis=-1))

    def mirror(key: Array, e: PyTree) -> PyTree:
        mirrored = jax.random.bernoulli(key, 0.5, (len(e["known"]), 1))
        return {
            "before": jnp.where(mirrored, e["before mirrored"], e["before"]),
            "change": jnp.where(mirrored, e["change mirrored"], e["change"]),
            "known": e["known"],
        }

    best = session.fit(network, loss, examples, augment=mirror, progress=progress)
    model = HeightChangeModel(best, nnx.graphdef(network))
    return model, session.finish(model, evaluate_pile_state)


def train_phi_vae(
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    epochs: int = 40,
    batch: int = 128,
    hidden: tuple[int, ...] = (1024, 1024),
    dropout: float = 0.1,
    learning_rate: float = 1e-3,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PileStateModel, PileStateErrors]:
    """Trains φ of the paper in its two stages: the autoencoder, then the step between codes.

    Both stages have as many epochs, and mirrored maps. All else as for `train_phi`.

    Returns:
        The model and its errors on the test part, with edge blending.

    Raises:
        InputError: As for `train_phi`.
    """
    recipe = Recipe(epochs, batch, learning_rate, seed=seed)
    session = Session(dataset, out, recipe, _tables)
    phi = Phi(hidden, dropout=dropout, rngs=nnx.Rngs(seed))
    mean = session.tables[0]["maps"].mean(axis=0)
    phi.mean[...] = jnp.asarray((mean + mean[:, ::-1]) / 2.0)
    pairs = [_scaled_pairs(table, phi.mean[...]) for table in session.tables]

    def reconstruction(vae: Any, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        code, log_variance = vae.encode(e["maps"])
        divergence = 0.5 * (jnp.exp(log_variance) + code**2 - 1.0 - log_variance).sum(axis=-1)
        if rngs is not None:
            code = code + jnp.exp(0.5 * log_variance) * jax.random.normal(rngs(), code.shape)
        squared = ((vae.decode(code) - e["maps"]) ** 2).sum(axis=(1, 2))
        return jnp.mean(squared + _DIVERGENCE * divergence)

    def told(offset: int) -> Callable[[int, int], None] | None:
        return None if progress is None else lambda done, _: progress(offset + done, 2 * epochs)

    best = session.fit(
        phi.vae,
        reconstruction,
        # Every map is scaled by its own range here.
        [{"maps": jnp.concatenate([pair["before"], pair["after_own"]])} for pair in pairs],
        stage="vae",
        whole=phi,
        augment=lambda key, e: {**e, "maps": mirror_some(key, e["maps"])[0]},
        progress=told(0),
    )
    nnx.update(phi.vae, best)

    codes = [_codes(phi, table, pair) for table, pair in zip(session.tables, pairs, strict=True)]
    assert phi.step.scale_in is not None
    assert phi.step.scale_out is not None
    phi.step.scale_in.fit(codes[0]["inputs"])
    phi.step.scale_out.fit(codes[0]["outputs"])
    best = session.fit(
        phi.step,
        lambda step, e, rngs: jnp.mean((step(e["inputs"], rngs=rngs) - e["outputs"]) ** 2),
        codes,
        stage="step",
        whole=phi,
        progress=told(epochs),
    )
    nnx.update(phi.step, best)
    graph, params = nnx.split(phi)
    model = PileStateModel(params, graph)
    return model, session.finish(model, evaluate_pile_state)


def _components(
    network: HeightChange, table: Mapping[str, np.ndarray]
) -> dict[str, Float[Array, "n k"]]:
    """Weights of the components of maps and changes, and of their mirror images."""

    @jax.jit
    def weights(maps: Array, changes: Array) -> dict[str, Array]:
        return {
            "before": network.before.weights(maps),
            "before mirrored": network.before.weights(maps[:, :, ::-1]),
            "change": network.change.weights(changes),
            "change mirrored": network.change.weights(changes[:, :, ::-1]),
        }

    starts = range(0, len(table["known"]), _PORTION)
    portions = [
        weights(table["maps"][s : s + _PORTION], table["changes"][s : s + _PORTION]) for s in starts
    ]
    rows = {name: jnp.concatenate([p[name] for p in portions]) for name in portions[0]}
    return rows | {"known": jnp.asarray(table["known"])}


def _tables(dataset: Dataset) -> dict[str, np.ndarray]:
    changes = dataset.h52_after - dataset.h52
    return {"maps": dataset.h52, "changes": changes, "known": _known(dataset)}


def _codes(
    phi: Phi, table: Mapping[str, np.ndarray], pair: dict[str, Array]
) -> dict[str, Float[Array, "n k"]]:
    """Inputs and outputs of the step between codes; of each pair also the mirror image."""
    encode = jax.jit(lambda maps: jax.lax.map(lambda m: phi.vae.encode(m)[0], maps, batch_size=128))
    action = jnp.asarray(table["known"][:, :4])
    known = jnp.concatenate([action, pair["span"][:, None]], axis=1)
    inputs, outputs = [], []
    for side in (1, -1):
        z, after = (encode(pair[name][:, :, ::side]) for name in ("before", "after"))
        inputs.append(jnp.concatenate([z, known], axis=1))
        outputs.append(after)
    return {"inputs": jnp.concatenate(inputs), "outputs": jnp.concatenate(outputs)}


def _scaled_pairs(table: Mapping[str, np.ndarray], mean: Array) -> dict[str, Array]:
    """Scaled maps before and after; the latter by the scale of the former and by their own."""

    @jax.jit
    def pair(before: Array, after: Array) -> dict[str, Array]:
        unit, low, span = scaled(before, mean)
        return {
            "before": unit,
            "after": (after - mean - low) / span,
            "after_own": scaled(after, mean)[0],
            "span": span,
        }

    before = jnp.asarray(table["maps"])
    return jax.vmap(pair)(before, before + jnp.asarray(table["changes"]))


def _known(dataset: Dataset) -> Float[np.ndarray, "n 5"]:
    """Action, and the volume of the load at the density of the soil [m³]."""
    soil = dataset.attributes.get("soil")
    density = soil.get("density", _DENSITY) if isinstance(soil, dict) else _DENSITY
    volume = dataset.mass * np.float32(KG_PER_TONNE / density)
    return np.concatenate([dataset.action, volume[:, None]], axis=1).astype(np.float32)
