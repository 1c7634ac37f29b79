"""Training of ψ_low. Paper, section 6.4.1."""

from __future__ import annotations

import os
from collections.abc import Sequence

from flax import nnx
from jaxtyping import Array

from wlplan.dataset import Dataset
from wlplan.models.ensemble import Ensemble
from wlplan.models.performance import PerformanceModel
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.training.evaluation import EvaluationReport
from wlplan.training.fitting import member_seeds
from wlplan.training.performance import (
    finished,
    normalised_examples,
    performance_loss,
    performance_tables,
)
from wlplan.training.settings import PsiLowSettings
from wlplan.training.trainer import Progress, Trainer
from wlplan.types import PyTree


def train(
    settings: PsiLowSettings,
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> tuple[PerformanceModel | Ensemble, EvaluationReport]:
    """Trains ψ_low, see `wlplan.training.train`."""
    trainer = Trainer(
        dataset, out, settings, performance_tables, by=settings.split, samples=settings.samples
    )
    normalisers, examples = normalised_examples(trainer)

    def start(seed: int) -> PsiLow:
        network = PsiLow(
            settings.hidden,
            activation=settings.activation,
            dropout=settings.dropout,
            scattered=settings.members > 1,
            rngs=nnx.Rngs(seed),
        )
        if settings.scaling == "spread":
            network.scale_in.fit(examples[0]["inputs"])
            network.scale_out.fit(examples[0]["outputs"])
        return network

    def loss(network: PsiLow, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        return performance_loss(network, e["inputs"], e["outputs"], settings.loss, rngs)

    networks = [start(seed) for seed in member_seeds(settings.seed, settings.members)]
    best = trainer.fit(networks, loss, examples, progress=progress)
    model = LowPerformanceModel(params=best, graph=nnx.graphdef(networks[0]), **normalisers)
    return finished(trainer, model, settings.members)
