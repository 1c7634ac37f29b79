"""Errors of a performance predictor on simulated cycles. Paper, section 7.1."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from wlplan.dataset import Dataset
from wlplan.errors import InputError
from wlplan.models.performance import PerformanceModel
from wlplan.models.performance_high import HighPerformanceModel
from wlplan.types import LocalHeightmap, Performance
from wlplan.units import CELL_SIZE

# Load from which an error relative to it says something [tonne]: a sixth of a full bucket. Of a
# bucket that comes out nearly empty any error is many times the load.
_LOADED = 0.5
# Cycles predicted at a time, which bounds the memory.
_CHUNK = 256


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


def evaluate_performance(
    model: PerformanceModel | HighPerformanceModel, dataset: Dataset
) -> EvaluationReport:
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
    predicted = predict(model, dataset)
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


def predict(model: PerformanceModel | HighPerformanceModel, dataset: Dataset) -> Performance:
    """The performance that a model predicts for each cycle; leaves of shape [n]."""
    if isinstance(model, PerformanceModel):
        return _predict_low(
            model, jnp.asarray(dataset.characteristics), jnp.asarray(dataset.action)
        )
    return _predict_high(model, jnp.asarray(dataset.h36), jnp.asarray(dataset.action))


@jax.jit
def _predict_low(model: PerformanceModel, characteristics: Array, action: Array) -> Performance:
    return jax.vmap(model)(characteristics, action)


@jax.jit
def _predict_high(model: HighPerformanceModel, maps: Array, action: Array) -> Performance:
    return jax.lax.map(
        lambda cycle: model(LocalHeightmap(cycle[0], CELL_SIZE, 0.0), cycle[1]),
        (maps, action),
        batch_size=_CHUNK,
    )
