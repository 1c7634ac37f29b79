"""Errors of the pile state predictors, and what their trainings share. Paper, 6.4.2 and 7.2."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.constants import CELL_SIZE, KG_PER_TONNE
from wlplan.dataset import Dataset
from wlplan.errors import InputError
from wlplan.models.pile_state import PileStatePredictor
from wlplan.site.soil import GRAVEL
from wlplan.terrain.heightmap import STATE_DISPLACEMENT
from wlplan.types import LocalHeightmap

# Cycles predicted at a time, which bounds the memory.
_CHUNK = 64


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


def evaluate_pile_state(model: PileStatePredictor, dataset: Dataset) -> PileStateErrors:
    """Compares a model with the simulated cycles of a data set, or of a part of one.

    The volume that leaves is the simulated one, so that the model answers for its own errors alone.
    The floor is the lowest cell of each map.

    Args:
        model: Pile state predictor.
        dataset: Cycles; those that are not valid do not count.

    Raises:
        InputError: If no cycle is valid.
    """
    dataset = dataset.select(dataset.valid)
    if not len(dataset):
        raise InputError("No cycle is valid: there is nothing to evaluate on.")
    return pile_state_errors(predict_pile_state(model, dataset), dataset)


def pile_state_errors(predicted: Float[np.ndarray, "n 52 52"], dataset: Dataset) -> PileStateErrors:
    """The errors of predicted maps, see `evaluate_pile_state`.

    Args:
        predicted: Maps after the loading, over the reference of those before [m].
        dataset: The cycles.
    """
    wrong = misplaced_volume(predicted, dataset)
    under = np.abs(dataset.h52_after.astype(np.float64)).sum(axis=(1, 2)) * CELL_SIZE**2
    left = (dataset.h52.astype(np.float64) - predicted).sum() * CELL_SIZE**2
    loaded = action_and_volume(dataset)[:, 4].astype(np.float64).sum()
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
    volume: np.ndarray = wrong.sum(axis=(1, 2)) * CELL_SIZE**2
    return volume


def predict_pile_state(model: PileStatePredictor, dataset: Dataset) -> Float[np.ndarray, "n 52 52"]:
    """Maps after the loading [m], over the reference of those before; see `evaluate_pile_state`."""
    before, known = jnp.asarray(dataset.h52), jnp.asarray(action_and_volume(dataset))
    return np.asarray(_predicted(model, before, known))


@jax.jit
def _predicted(model: Any, before: Array, known: Array) -> Array:
    def one(cycle: tuple[Array, Array]) -> Array:
        height, known = cycle
        local = LocalHeightmap(height, CELL_SIZE, STATE_DISPLACEMENT)
        ground = jnp.full_like(height, height.min())
        after: Array = height + model(local, known[:4], known[4], ground)
        return after

    maps: Array = jax.lax.map(one, (before, known), batch_size=_CHUNK)
    return maps


def state_tables(dataset: Dataset) -> dict[str, np.ndarray]:
    """Maps before [m] and their changes [m], [n, 52, 52]; action and volume [m³], [n, 5]."""
    changes = dataset.h52_after - dataset.h52
    return {"maps": dataset.h52, "changes": changes, "known": action_and_volume(dataset)}


def action_and_volume(dataset: Dataset) -> Float[np.ndarray, "n 5"]:
    """Action, and the volume of the load at the density of the soil [m³]."""
    # A data set that does not name its soil is of gravel, the paper's.
    soil = dataset.attributes.get("soil")
    named = soil if isinstance(soil, dict) else {}
    density = named.get("density", GRAVEL.density)
    volume = dataset.mass * np.float32(KG_PER_TONNE / density)
    return np.concatenate([dataset.action, volume[:, None]], axis=1).astype(np.float32)
