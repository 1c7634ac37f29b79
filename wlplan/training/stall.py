"""Training and errors of the predictor of stalls."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from wlplan.dataset import Dataset
from wlplan.engines.limits import STOP_REASONS
from wlplan.errors import InputError
from wlplan.models.stall import StallModel, StallNetwork
from wlplan.training.fitting import even_sample, mirror_some
from wlplan.training.performance import normalised_examples
from wlplan.training.settings import StallSettings
from wlplan.training.trainer import Progress, Trainer
from wlplan.types import PyTree

EDGES = (0.0, 0.001, 0.01, 0.03, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Bounds of the bins of probability. Stalls are rare: even bins would have all cycles in one."""

# Cycles predicted at a time, which bounds the memory.
_CHUNK = 256
# Steps of Newton's method; it is exact to rounding after about ten.
_STEPS = 50


@dataclasses.dataclass(frozen=True)
class Bin:
    """Cycles of like probability."""

    cycles: int
    foreseen: float  # mean probability [1]
    stalled: float  # part of them that stalled [1]


@dataclasses.dataclass(frozen=True)
class Score:
    """How good probabilities are, the less the better."""

    negative_log_likelihood: float  # mean [nat]
    brier: float  # mean square of the probability less what happened [1]


@dataclasses.dataclass(frozen=True)
class StallReport:
    """How foreseen stalls agree with those that happened."""

    cycles: int
    stalled: int
    score: Score
    # Of the same probability for all, the part that stalled: what any predictor has to beat.
    constant: Score
    # Probability that a cycle that stalled was given more than one that did not [1]; None where
    # there are no cycles of both kinds.
    area_under_curve: float | None
    # Mean over the cycles of |foreseen - stalled| of their bin [1].
    calibration_error: float
    foreseen: float  # mean probability [1]
    bins: list[Bin | None]  # between `EDGES`; None: no cycles

    def as_dict(self) -> dict[str, Any]:
        """The report as JSON has it, with the bounds of the bins."""
        return {**dataclasses.asdict(self), "edges": list(EDGES)}


def train(
    settings: StallSettings,
    dataset: Dataset | Sequence[Dataset],
    *,
    out: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> tuple[StallModel, StallReport]:
    """Trains the predictor of stalls, see `wlplan.training.train`.

    By cross-entropy; half of the maps of a step are mirrored. Then the log odds are calibrated on
    the validation part, see `scaling`.

    Raises:
        InputError: If no cycle stalled in some part of the data.
    """
    trainer = Trainer(dataset, out, settings, _tables)
    stalls = [table["stalls"] for table in trainer.tables] + [stalled(trainer.test)]
    if not all(part.any() for part in stalls):
        raise InputError(
            "The data set has too few cycles that stall to train on, calibrate by and test with: "
            "collect more cycles, by --protocol slow for instance."
        )
    normalisers, examples = normalised_examples(trainer)
    scales = {name: normalisers[name] for name in ("maps", "inputs")}

    network = StallNetwork(
        settings.hidden,
        activation=settings.activation,
        dropout=settings.dropout,
        rngs=nnx.Rngs(settings.seed),
    )
    sample = even_sample(examples[0])
    network.fit_scales(sample["maps"], sample["inputs"])

    def loss(network: StallNetwork, e: PyTree, rngs: nnx.Rngs | None) -> Array:
        odds = network(e["maps"], e["inputs"], rngs=rngs)
        return jnp.mean(_unlikely(odds, e["stalls"][:, 0]))

    best = trainer.fit(
        [network],
        loss,
        examples,
        augment=lambda key, e: {**e, "maps": mirror_some(key, e["maps"])[0]},
        progress=progress,
    )
    raw = StallModel(params=best, graph=nnx.graphdef(network), **scales)
    slope, shift = scaling(log_odds(raw, trainer.validation), stalled(trainer.validation))
    model = raw.calibrated(slope, shift)
    return model, trainer.finish(model, evaluate_stalls)


def stalled(dataset: Dataset) -> Bool[np.ndarray, " n"]:
    """Which cycles stalled: the limit of time ended their filling."""
    which: np.ndarray = dataset.stop_reason == STOP_REASONS.index("timeout")
    return which


def scaling(odds: Float[np.ndarray, " n"], happened: Bool[np.ndarray, " n"]) -> tuple[float, float]:
    """Slope and shift that make log odds fit what happened (Platt 1999), by Newton's method.

    As there, what happened counts a little less than certain, so that the slope stays finite where
    the odds part all that stalled from all that did not.

    Args:
        odds: Log odds of stalls.
        happened: Which of them happened.
    """
    yes = float(happened.sum())
    no = len(happened) - yes
    wanted = np.where(happened, (yes + 1.0) / (yes + 2.0), 1.0 / (no + 2.0))
    rows = np.stack([odds.astype(np.float64), np.ones(len(odds))], axis=1)
    line = np.array([1.0, 0.0])

    def loss(line: np.ndarray) -> float:
        return float(np.mean(np.logaddexp(0.0, rows @ line) - wanted * (rows @ line)))

    for _ in range(_STEPS):
        found = 1.0 / (1.0 + np.exp(-rows @ line))
        gradient = rows.T @ (found - wanted) / len(rows)
        curvature = (rows * (found * (1.0 - found))[:, None]).T @ rows / len(rows)
        step = np.linalg.solve(curvature + 1e-12 * np.eye(2), gradient)
        # Newton's step can overshoot where all odds are far from even.
        size = 1.0
        while loss(line - size * step) > loss(line) and size > 1e-6:
            size *= 0.5
        line = line - size * step
    return float(line[0]), float(line[1])


def evaluate_stalls(model: StallModel, dataset: Dataset) -> StallReport:
    """Compares a predictor of stalls with the simulated cycles of a data set, or of a part of one.

    Cycles that are not valid do not count.

    Raises:
        InputError: If no cycle is valid.
    """
    dataset = dataset.select(dataset.valid)
    if not len(dataset):
        raise InputError("No cycle is valid: there is nothing to evaluate on.")
    return stall_report(log_odds(model, dataset), stalled(dataset))


def stall_report(odds: Float[np.ndarray, " n"], happened: Bool[np.ndarray, " n"]) -> StallReport:
    """How log odds of stalls agree with what happened.

    Args:
        odds: Log odds that were foreseen.
        happened: Which cycles stalled.
    """
    odds = odds.astype(np.float64)
    foreseen = 1.0 / (1.0 + np.exp(-odds))
    # The last bin holds its upper bound.
    place = np.minimum(np.searchsorted(EDGES, foreseen, side="right") - 1, len(EDGES) - 2)
    bins: list[Bin | None] = []
    for number in range(len(EDGES) - 1):
        which = place == number
        bins.append(
            Bin(int(which.sum()), float(foreseen[which].mean()), float(happened[which].mean()))
            if which.any()
            else None
        )
    filled = [one for one in bins if one is not None]
    part = float(happened.mean())
    return StallReport(
        cycles=len(happened),
        stalled=int(happened.sum()),
        score=Score(
            float(np.mean(np.logaddexp(0.0, odds) - happened * odds)),
            float(np.mean((foreseen - happened) ** 2)),
        ),
        constant=Score(_entropy(part), part * (1.0 - part)),
        area_under_curve=_area_under_curve(odds, happened),
        calibration_error=sum(one.cycles * abs(one.foreseen - one.stalled) for one in filled)
        / len(happened),
        foreseen=float(foreseen.mean()),
        bins=bins,
    )


def log_odds(model: StallModel, dataset: Dataset) -> Float[np.ndarray, " n"]:
    """The log odds that a model gives a stall in each cycle."""
    views = jnp.asarray(getattr(dataset, model.view_variable))
    return np.asarray(_log_odds(model, views, jnp.asarray(dataset.action)))


@jax.jit
def _log_odds(model: Any, views: Array, action: Array) -> Array:
    odds: Array = jax.lax.map(
        lambda cycle: model.log_odds(*cycle), (views, action), batch_size=_CHUNK
    )
    return odds


def _unlikely(odds: Float[Array, " n"], happened: Float[Array, " n"]) -> Float[Array, " n"]:
    """Cross-entropy of log odds with what happened, 0 or 1."""
    return jnp.logaddexp(0.0, odds) - happened * odds


def _entropy(part: float) -> float:
    parts = np.array([part, 1.0 - part])
    return float(-np.sum(parts * np.log(np.maximum(parts, 1e-300))))


def _area_under_curve(
    odds: Float[np.ndarray, " n"], happened: Bool[np.ndarray, " n"]
) -> float | None:
    """By ranks (Mann and Whitney); equal odds share theirs."""
    # Imported here, as it takes long.
    from scipy.stats import rankdata

    yes, no = int(happened.sum()), int((~happened).sum())
    if not yes or not no:
        return None
    ranks = rankdata(odds)
    return float((ranks[happened].sum() - 0.5 * yes * (yes + 1)) / (yes * no))


def _tables(dataset: Dataset) -> dict[str, np.ndarray]:
    return {
        "maps": dataset.h36,
        "inputs": np.concatenate([dataset.characteristics, dataset.action], axis=1),
        "stalls": stalled(dataset).astype(np.float32)[:, None],
    }
