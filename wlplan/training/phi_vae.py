"""Training of φ of the paper: the autoencoder, then the step between codes. Section 6.4.2."""

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
from wlplan.models.phi_vae import PhiVae, VaePileStateModel, scaled
from wlplan.training.fitting import mirror_some
from wlplan.training.pile_state import PileStateErrors, evaluate_pile_state, state_tables
from wlplan.training.settings import PhiVaeSettings
from wlplan.training.trainer import Progress, Trainer
from wlplan.types import PyTree

# Weight of the divergence beside the squared error. Paper, section 6.4.2. We read both as sums,
# over cells and over the code: with the mean over 2,704 cells the code would hold nothing.
_DIVERGENCE = 0.1


def train(
    settings: PhiVaeSettings,
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> tuple[VaePileStateModel, PileStateErrors]:
    """Trains φ of the paper, see `wlplan.training.train`; the errors are with blended edges.

    Both stages have as many epochs, and mirrored maps.
    """
    trainer = Trainer(dataset, out, settings, state_tables)
    phi = PhiVae(settings.hidden, dropout=settings.dropout, rngs=nnx.Rngs(settings.seed))
    mean = trainer.tables[0]["maps"].mean(axis=0)
    phi.mean[...] = jnp.asarray((mean + mean[:, ::-1]) / 2.0)
    pairs = [_scaled_pairs(table, phi.mean[...]) for table in trainer.tables]

    def reconstruction(vae: Any, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        code, log_variance = vae.encode(e["maps"])
        divergence = 0.5 * (jnp.exp(log_variance) + code**2 - 1.0 - log_variance).sum(axis=-1)
        if rngs is not None:
            code = code + jnp.exp(0.5 * log_variance) * jax.random.normal(rngs(), code.shape)
        squared = ((vae.decode(code) - e["maps"]) ** 2).sum(axis=(1, 2))
        return jnp.mean(squared + _DIVERGENCE * divergence)

    epochs = settings.epochs

    def progress_after(before: int) -> Progress | None:
        return None if progress is None else lambda done, _: progress(before + done, 2 * epochs)

    best = trainer.fit(
        [phi.vae],
        reconstruction,
        # Every map is scaled by its own range here.
        [{"maps": jnp.concatenate([pair["before"], pair["after_own"]])} for pair in pairs],
        stage="vae",
        augment=lambda key, e: {**e, "maps": mirror_some(key, e["maps"])[0]},
        progress=progress_after(0),
    )
    nnx.update(phi.vae, best)

    codes = [_codes(phi, table, pair) for table, pair in zip(trainer.tables, pairs, strict=True)]
    phi.step.scale_in.fit(codes[0]["inputs"])
    phi.step.scale_out.fit(codes[0]["outputs"])
    best = trainer.fit(
        [phi.step],
        lambda step, e, rngs: jnp.mean((step(e["inputs"], rngs=rngs) - e["outputs"]) ** 2),
        codes,
        stage="step",
        progress=progress_after(epochs),
    )
    nnx.update(phi.step, best)
    graph, params = nnx.split(phi)
    model = VaePileStateModel(params, graph)
    return model, trainer.finish(model, evaluate_pile_state)


def _codes(
    phi: PhiVae, table: Mapping[str, np.ndarray], pair: dict[str, Array]
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
    pairs: dict[str, Array] = jax.vmap(pair)(before, before + jnp.asarray(table["changes"]))
    return pairs
