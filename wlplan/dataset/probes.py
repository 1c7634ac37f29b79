"""Probes: a few cycles of a data set that show later whether the simulator has changed.

A hash of the source would change with every comment, one of outcomes with the processor. So the
outcomes themselves are kept, and compared within a tolerance with those of the same cycles today:
piles, local maps, characteristics, simulator and automaton all have a say in them. They are the
first loadings of one episode on each seed pile, so nothing has to be kept of the pile but its
number. What is a plain value, soil and machine among them, is compared as it is.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from wlplan.constants import CELL_SIZE
from wlplan.dataset.episode import Episode, grid_origin
from wlplan.dataset.variables import Dataset
from wlplan.engines.simulator import Simulator
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.terrain.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    local_points,
    sample,
    sample_local,
)
from wlplan.terrain.seed_piles import SEED_PILES
from wlplan.types import Pile, Pose, action_from

# Loadings of each episode.
_LOADS = 5
# Largest difference of an outcome, over the size that it usually has. Simulated again on the same
# machine outcomes agree to 2e-5, in float64 to 4e-4 over whole episodes: another instruction set
# changes less.
_TOLERANCE = 1e-3
# Mass [tonne], time [s], work [kJ], volume that moved [m³], characteristics [rad, rad, 1/m, 1/m].
_USUAL = {"mass": 3.0, "time": 10.0, "work": 400.0, "moved": 3.0, "characteristics": 1.0}
_SETTINGS = ("soil", "machine", "settings", "schedule")


def probes_of(dataset: Dataset) -> list[dict[str, Any]]:
    """What a few cycles of a data set began with and came to, as JSON has it; perhaps none."""
    found = []
    for number in range(len(SEED_PILES)):
        for load in range(_LOADS):
            (where,) = np.nonzero((dataset.rollout == number) & (dataset.load == load))
            if len(where) != 1:
                # A data set of one's own need not be made up of episodes.
                return []
            k = int(where[0])
            moved = np.abs(dataset.h52_after[k] - dataset.h52[k]).sum(dtype=np.float64)
            found.append(
                {
                    "rollout": number,
                    "pose": dataset.pose[k].tolist(),
                    "action": dataset.action[k].tolist(),
                    "mass": float(dataset.mass[k]),
                    "time": float(dataset.time[k]),
                    "work": float(dataset.work[k]),
                    "moved": float(moved) * CELL_SIZE**2,
                    "characteristics": dataset.characteristics[k].tolist(),
                }
            )
    return found


def simulator_changes(data: Mapping[str, Any]) -> list[str]:
    """How today's simulator differs from the one that a data set was collected with, in words.

    Args:
        data: Attributes of the data set and its `probes`, as the `model.json` of a model has them.

    Returns:
        A line for each setting or outcome that is another one; empty if all are the same.
    """
    simulator = Simulator()
    wrong = []
    for name in _SETTINGS:
        now = json.loads(json.dumps(dataclasses.asdict(getattr(simulator, name))))
        then = data.get(name)
        if not then:
            wrong.append(f"{name} was not recorded")
            continue
        # A field that came later had no say: everything was as it is by default.
        changed = sorted(key for key in then if now.get(key) != then[key])
        wrong += [f"{name}.{k} was {then.get(k)}, is {now.get(k)}" for k in changed]
    probes = data.get("probes")
    if not probes:
        return [*wrong, "the data set had no cycles to compare with"]
    for probe, again in zip(probes, _simulated_again(probes, data["seed"], simulator), strict=True):
        for name, usual in _USUAL.items():
            off = np.abs(np.asarray(again[name]) - np.asarray(probe[name])).max() / usual
            if not off <= _TOLERANCE:
                wrong.append(
                    f"{name} of a cycle of episode {probe['rollout']} was {probe[name]}, is "
                    f"{again[name]}"
                )
    return wrong


def _simulated_again(
    probes: list[dict[str, Any]], seed: int, simulator: Simulator
) -> Iterator[dict[str, Any]]:
    """The outcomes of the same cycles in today's simulator."""
    height, number = jnp.zeros(0), None
    for probe in probes:
        if probe["rollout"] != number:
            number = probe["rollout"]
            episode = Episode(number, seed, _LOADS, simulator)
            episode.reset()
            height = episode.height
        pose, action = (jnp.asarray(probe[name], jnp.float32) for name in ("pose", "action"))
        height, outcome = _compiled(simulator)(height, pose, action)
        yield {name: np.asarray(value, float).tolist() for name, value in outcome.items()}


@functools.cache
def _compiled(simulator: Simulator) -> Callable[..., tuple[Array, dict[str, Array]]]:
    @jax.jit
    def simulate(height: Array, pose: Array, action: Array) -> tuple[Array, dict[str, Array]]:
        pile, at = Pile(height, CELL_SIZE, grid_origin()), Pose(*pose)
        after, performance = simulator(pile, at, action_from(action))
        points = local_points(at, STATE_CELLS, STATE_DISPLACEMENT, height.dtype)
        moved = jnp.abs(sample(after.height - height, pile, *points)).sum() * CELL_SIZE**2
        return after.height, {
            "mass": performance.mass,
            "time": performance.time,
            "work": performance.work,
            "moved": moved,
            "characteristics": as_vector(characteristics(sample_local(pile, at))),
        }

    return simulate
