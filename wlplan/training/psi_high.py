"""Training of ψ_high. Paper, section 6.4.1."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from flax import nnx
from jaxtyping import Array

from wlplan.dataset import Dataset
from wlplan.models.ensemble import Ensemble
from wlplan.models.performance import PerformanceModel
from wlplan.models.psi_high import HighPerformanceModel, PsiHigh
from wlplan.training.evaluation import EvaluationReport
from wlplan.training.fitting import even_sample, member_seeds, mirror_some
from wlplan.training.performance import (
    finished,
    normalised_examples,
    performance_loss,
    performance_tables,
)
from wlplan.training.settings import PsiHighSettings
from wlplan.training.trainer import Progress, Trainer
from wlplan.types import PyTree


def train(
    settings: PsiHighSettings,
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> tuple[PerformanceModel | Ensemble, EvaluationReport]:
    """Trains ψ_high, see `wlplan.training.train`.

    A part of the maps of a step, chosen anew each time, is mirrored: what a loading yields does not
    depend on left and right.
    """
    trainer = Trainer(dataset, out, settings, _tables, by=settings.split, samples=settings.samples)
    normalisers, examples = normalised_examples(trainer)

    def start(seed: int) -> PsiHigh:
        network = PsiHigh(
            settings.hidden,
            encoder=settings.encoder,
            activation=settings.activation,
            dropout=settings.dropout,
            scattered=settings.members > 1,
            rngs=nnx.Rngs(seed),
        )
        if settings.scaling == "spread":
            network.fit_scales(**even_sample(examples[0]))
        return network

    def loss(network: PsiHigh, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        features = network.features(e["maps"], e["inputs"], training=rngs is not None)
        return performance_loss(network.head, features, e["outputs"], settings.loss, rngs)

    networks = [start(seed) for seed in member_seeds(settings.seed, settings.members)]
    best = trainer.fit(
        networks,
        loss,
        examples,
        augment=lambda key, e: {**e, "maps": mirror_some(key, e["maps"], settings.mirrored)[0]},
        progress=progress,
    )
    model = HighPerformanceModel(params=best, graph=nnx.graphdef(networks[0]), **normalisers)
    return finished(trainer, model, settings.members)


def _tables(dataset: Dataset) -> dict[str, np.ndarray]:
    return performance_tables(dataset) | {"maps": dataset.h36}
