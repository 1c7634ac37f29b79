"""Time of one inference of a trained predictor, and of each of a batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from wlplan.constants import CELL_SIZE, KG_PER_TONNE
from wlplan.dataset import Dataset
from wlplan.models.ensemble import Ensemble
from wlplan.models.performance import PerformanceModel
from wlplan.models.pile_state import PileStatePredictor
from wlplan.models.stall import StallModel
from wlplan.site.soil import GRAVEL
from wlplan.studies.bench.timing import Timing, compiled, timed
from wlplan.terrain.heightmap import STATE_DISPLACEMENT
from wlplan.types import LocalHeightmap

BATCH = 150
"""Inputs of a batch: the places of the paper's diggability map."""
_SECONDS, _LEAST = 1.5, 5


@dataclasses.dataclass(frozen=True)
class InferenceTime:
    """Wall-clock time of calls of one compiled function [s]."""

    inputs: int  # of one call
    deviation: bool  # whether an ensemble predicts the deviation of its error, too
    compile: float  # tracing and compiling
    call: Timing

    @property
    def each(self) -> float:
        """Median time of a call over its inputs."""
        return self.call.median / self.inputs

    def as_dict(self) -> dict[str, Any]:
        """The times as JSON has them."""
        return {
            "inputs": self.inputs,
            "deviation": self.deviation,
            "compile_s": self.compile,
            "call_s": dataclasses.asdict(self.call),
            "each_s": self.each,
        }


def performance_times(
    model: PerformanceModel | Ensemble | StallModel, dataset: Dataset
) -> list[InferenceTime]:
    """Times ψ on one input, and on 150 in one call; an ensemble also with its deviation.

    An input is what a data set stores of the local heightmap, see `PerformanceModel.view`. The
    weights are compiled in, as in a planner: to hand them over takes a small model as long again.

    Args:
        model: Performance predictor, or the predictor of stalls.
        dataset: Cycles to take the inputs from; where there are fewer than 150, some come again.
    """
    table = (getattr(dataset, model.view_variable), dataset.action)
    # Not the methods themselves: JAX hashes what it compiles, and weights have no hash.
    times = _times(lambda view, action: model.of_view(view, action), table)
    if isinstance(model, Ensemble):
        ensemble = model
        times += _times(
            lambda view, action: ensemble.of_view_with_deviation(view, action),
            table,
            deviation=True,
        )
    return times


def pile_state_times(model: PileStatePredictor, dataset: Dataset) -> list[InferenceTime]:
    """Times φ on one input, and on 150 in one call.

    Args:
        model: Pile state predictor; its weights are compiled in.
        dataset: Cycles to take the inputs from; where there are fewer than 150, some come again.
    """

    def change(height: Array, action: Array, volume: Array) -> Array:
        local = LocalHeightmap(height, CELL_SIZE, STATE_DISPLACEMENT)
        return model(local, action, volume, jnp.full_like(height, height.min()))

    # At the density of gravel: the time does not depend on the volume.
    volume = (dataset.mass * (KG_PER_TONNE / GRAVEL.density)).astype(dataset.mass.dtype)
    return _times(change, (dataset.h52, dataset.action, volume))


def _times(
    function: Callable[..., Any], table: tuple[Any, ...], *, deviation: bool = False
) -> list[InferenceTime]:
    """Times of one input and of a batch of a function of rows of a table."""
    which = jnp.arange(BATCH) % len(table[0])
    batch = tuple(jnp.asarray(values)[which] for values in table)
    singles = [tuple(values[n] for values in batch) for n in range(BATCH)]
    one, first = compiled(function, *singles[0])
    many, second = compiled(jax.vmap(function), *batch)
    (single,) = timed([one], singles, seconds=_SECONDS, least=1)
    (together,) = timed([many], [batch], seconds=_SECONDS, least=_LEAST)
    return [
        InferenceTime(1, deviation, first, single.timing),
        InferenceTime(BATCH, deviation, second, together.timing),
    ]
