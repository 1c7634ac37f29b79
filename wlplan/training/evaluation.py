"""Errors of a performance predictor on simulated cycles. Paper, section 7.1."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.constants import QUANTITIES
from wlplan.dataset import Dataset, fingerprint, split
from wlplan.errors import InputError
from wlplan.models.ensemble import PERCENT_90, Ensemble
from wlplan.models.performance import PerformanceModel
from wlplan.types import Performance

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
class Interval:
    """How the errors of an ensemble in one quantity agree with the deviations that it predicts."""

    # Part of the cycles inside the interval that ought to hold 0.9 of them [1].
    coverage: float
    # The same of fifths of the cycles, from the least predicted deviation to the largest.
    coverage_by_fifths: list[float]
    # Root mean square of the predicted deviations, and of the errors, of each fifth.
    deviation_by_fifths: list[float]
    error_by_fifths: list[float]


@dataclasses.dataclass(frozen=True)
class EvaluationReport:
    """How a performance predictor does on cycles that it has not seen."""

    loaded_mass: float  # load from which a cycle counts as loaded [tonne]
    loaded: Errors  # over cycles with at least that load
    every: Errors  # over all valid cycles
    # Of an ensemble, over all valid cycles: mass [tonne], time [s], work [kJ].
    intervals: dict[str, Interval] | None = None

    def as_dict(self) -> dict[str, Any]:
        """The report as JSON has it; without intervals where there are none."""
        record = dataclasses.asdict(self)
        return record if self.intervals else {k: v for k, v in record.items() if k != "intervals"}


def held_out(dataset: Dataset, description: Mapping[str, Any]) -> Dataset:
    """The cycles of a data set that a model was not trained on.

    Args:
        dataset: Any data set.
        description: Description of the model, see `read_description`.

    Returns:
        Of a data set that the model was trained on, the test part; of another, everything.

    Raises:
        InputError: If the description does not say how that was split.
    """
    if fingerprint(dataset) not in description.get("dataset", {}).get("fingerprints", ()):
        return dataset
    fractions = description.get("training", {}).get("fractions", ())
    if len(fractions) != 3 or not all(isinstance(one, float) for one in fractions):
        raise InputError("the model does not say what it was trained on: copy or train it again.")
    by = description["training"].get("settings", {}).get("split", "rollout")
    return split(dataset, fractions=tuple(fractions), by=by)[2]


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


def evaluate_performance(model: PerformanceModel | Ensemble, dataset: Dataset) -> EvaluationReport:
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
    predicted, deviation = predict_with_deviation(model, dataset)
    by_name = {name: np.asarray(getattr(predicted, name)) for name in QUANTITIES}

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

    intervals = None
    if deviation is not None:
        intervals = {
            name: _interval(values - getattr(dataset, name), np.asarray(getattr(deviation, name)))
            for name, values in by_name.items()
        }
    return EvaluationReport(_LOADED, errors(loaded), errors(np.ones_like(loaded)), intervals)


def _interval(error: Float[np.ndarray, " n"], deviation: Float[np.ndarray, " n"]) -> Interval:
    """Agreement of errors with their standard deviations."""
    inside = np.abs(error) <= PERCENT_90 * deviation
    fifths = [part for part in np.array_split(np.argsort(deviation), 5) if len(part)]

    def sizes(values: np.ndarray) -> list[float]:
        return [float(np.sqrt(np.mean(values[part].astype(np.float64) ** 2))) for part in fifths]

    return Interval(
        float(inside.mean()),
        [float(inside[part].mean()) for part in fifths],
        sizes(deviation),
        sizes(error),
    )


def shortfall(ensemble: Ensemble, dataset: Dataset) -> Float[Array, "3"]:
    """What an ensemble has to add to each prediction, in deviations, for its sums to come out.

    That of the mass is zero: of a bucket that comes out empty nothing can be taken.

    Args:
        ensemble: Ensemble without a bias, whose own factors are one.
        dataset: Cycles that its members were not trained on.
    """
    predicted, deviation = predict_with_deviation(ensemble, dataset)
    assert deviation is not None
    bias = {}
    for name in QUANTITIES:
        short = getattr(dataset, name).astype(np.float64) - np.asarray(getattr(predicted, name))
        bias[name] = short.sum() / np.asarray(getattr(deviation, name), np.float64).sum()
    return jnp.asarray(np.array([0.0, bias["time"], bias["work"]], np.float32))


def widening(ensemble: Ensemble, dataset: Dataset) -> Float[Array, "3"]:
    """Factors by which an ensemble has to widen its deviations of mass, time and work.

    With them nine in ten cycles lie within `PERCENT_90` deviations of the prediction.

    Args:
        ensemble: Ensemble whose own factors are one.
        dataset: Cycles that its members were not trained on.
    """
    predicted, deviation = predict_with_deviation(ensemble, dataset)
    assert deviation is not None
    factors = []
    for name in QUANTITIES:
        error = np.abs(np.asarray(getattr(predicted, name)) - getattr(dataset, name))
        ratios = error / np.asarray(getattr(deviation, name))
        factors.append(np.quantile(ratios, 0.9) / PERCENT_90)
    return jnp.asarray(np.array(factors, np.float32))


def predict(model: PerformanceModel | Ensemble, dataset: Dataset) -> Performance:
    """The performance that a model predicts for each cycle; leaves of shape [n]."""
    return predict_with_deviation(model, dataset)[0]


def predict_with_deviation(
    model: PerformanceModel | Ensemble, dataset: Dataset
) -> tuple[Performance, Performance | None]:
    """Prediction of each cycle and, by an ensemble, its standard deviation; leaves of shape [n]."""
    views = getattr(dataset, model.view_variable)
    predicted: tuple[Performance, Performance | None] = _of_views(
        model, jnp.asarray(views), jnp.asarray(dataset.action)
    )
    return predicted


@jax.jit
def _of_views(model: Any, views: Array, action: Array) -> tuple[Performance, Performance | None]:
    def one(cycle: tuple[Array, Array]) -> tuple[Performance, Performance | None]:
        if isinstance(model, Ensemble):
            return model.of_view_with_deviation(*cycle)
        return model.of_view(*cycle), None

    predicted: tuple[Performance, Performance | None] = jax.lax.map(
        one, (views, action), batch_size=_CHUNK
    )
    return predicted
