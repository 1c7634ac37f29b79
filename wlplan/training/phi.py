"""Training of our φ. Paper, section 6.4.2."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from wlplan.dataset import Dataset
from wlplan.models.phi import HeightChange, HeightChangeModel
from wlplan.training.fitting import even_sample
from wlplan.training.pile_state import PileStateErrors, evaluate_pile_state, state_tables
from wlplan.training.settings import PhiSettings
from wlplan.training.trainer import Progress, Trainer
from wlplan.types import PyTree

# Cycles whose components are taken at a time, which bounds the memory.
_PORTION = 4096


def train(
    settings: PhiSettings,
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> tuple[HeightChangeModel, PileStateErrors]:
    """Trains our φ, see `wlplan.training.train`; with mirrored maps, as ψ_high."""
    trainer = Trainer(dataset, out, settings, state_tables)
    network = HeightChange(
        settings.hidden,
        activation=settings.activation,
        dropout=settings.dropout,
        rngs=nnx.Rngs(settings.seed),
    )
    network.fit_scales(**even_sample(trainer.tables[0]))
    # The components are not trained: what they make of the maps is the same in every epoch.
    examples = [_components(network, table) for table in trainer.tables]
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

    best = trainer.fit([network], loss, examples, augment=mirror, progress=progress)
    model = HeightChangeModel(best, nnx.graphdef(network))
    return model, trainer.finish(model, evaluate_pile_state)


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
