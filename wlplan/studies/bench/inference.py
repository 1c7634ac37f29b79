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
from wlplan.models.ensemble import Ensemble, members_of
from wlplan.models.height_change import HeightChangeModel
from wlplan.models.performance import PerformanceModel
from wlplan.models.performance_high import HighPerformanceModel
from wlplan.models.pile_state import PileStateModel
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
    deviation: bool  # whether an ensemble tells how far it may be off, too
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


def inference_times(
    model: PerformanceModel | HighPerformanceModel | Ensemble | HeightChangeModel | PileStateModel,
    dataset: Dataset,
    *,
    blend: bool = True,
) -> list[InferenceTime]:
    """Times a predictor on one input, and on 150 in one call; an ensemble also with its deviation.

    The weights are compiled in, as in a planner: to hand them over takes a small model as long
    again.

    Args:
        model: Predictor.
        dataset: Cycles to take the inputs from; where there are fewer than 150, some come again.
        blend: Whether the paper's pile state predictor blends with the map before along the edges.
    """
    which = jnp.arange(BATCH) % len(dataset)
    times = []
    for deviation in (False, True) if isinstance(model, Ensemble) else (False,):
        function, inputs = _inputs(model, dataset, blend, deviation)
        batch = tuple(jnp.asarray(values)[which] for values in inputs)
        singles = [tuple(values[n] for values in batch) for n in range(BATCH)]
        one, first = compiled(function, *singles[0])
        many, second = compiled(jax.vmap(function), *batch)
        (single,) = timed([one], singles, seconds=_SECONDS, least=1)
        (together,) = timed([many], [batch], seconds=_SECONDS, least=_LEAST)
        times.append(InferenceTime(1, deviation, first, single.timing))
        times.append(InferenceTime(BATCH, deviation, second, together.timing))
    return times


def _inputs(
    model: Any, dataset: Dataset, blend: bool, deviation: bool
) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """The predictor as a function of arrays, and a table of each of them."""
    seen_by = members_of(model)
    predict = model.with_deviation if deviation else model
    if isinstance(seen_by, PerformanceModel):
        return (
            lambda characteristics, action: predict(characteristics, action),
            (dataset.characteristics, dataset.action),
        )
    if isinstance(seen_by, HighPerformanceModel):
        return (
            lambda height, action: predict(LocalHeightmap(height, CELL_SIZE, 0.0), action),
            (dataset.h36, dataset.action),
        )

    def state(height: Array, action: Array, volume: Array) -> Array:
        local = LocalHeightmap(height, CELL_SIZE, STATE_DISPLACEMENT)
        if isinstance(model, PileStateModel):
            return model(local, action, blend=blend)
        return model(local, action, volume, jnp.full_like(height, height.min()))

    # At the density of gravel: the time does not depend on the volume.
    volume = dataset.mass * (KG_PER_TONNE / GRAVEL.density)
    return state, (dataset.h52, dataset.action, volume.astype(dataset.mass.dtype))
