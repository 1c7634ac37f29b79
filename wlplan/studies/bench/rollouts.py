"""The low world: a loading, rollouts and inferences."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import jax
import numpy as np
from jaxtyping import Array

from wlplan.planning.rollout import rollout
from wlplan.studies.bench.setup import LOADS, Item, Measured, Setup, floats, random_actions
from wlplan.studies.bench.timing import compiled
from wlplan.terrain.characteristics import as_vector, characteristics
from wlplan.terrain.heightmap import sample_local
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import LoadingPlan, Performance, Pile, World, action_from
from wlplan.worlds.learned import LearnedWorld

_LOCATIONS = 150  # of a batch of inferences
_ROLLOUTS = 1024  # of a batch on a GPU


def _measure_loading(setup: Setup) -> Measured:
    actions = random_actions(len(setup.digs), np.random.default_rng(setup.seed))
    cases = [
        (setup.world, dig.pile, dig.pose, action_from(action))
        for dig, action in zip(setup.digs, actions, strict=True)
    ]
    run, seconds = compiled(lambda world, *loading: world(*loading), *cases[0])
    (found,) = setup.timed([run], cases)
    return Measured(seconds, found.timing)


def _work_a_tonne(world: World, pile: Pile, plan: LoadingPlan) -> Array:
    performance = rollout(world, pile, plan).performance
    return performance.work.sum() / performance.mass.sum()


def _measure_rollout(setup: Setup) -> Measured:
    run, seconds = setup.rollout
    (found,) = setup.timed([run], [(setup.world, setup.cone, setup.plan)])
    return Measured(seconds, found.timing)


def _measure_rollout_gradient(setup: Setup) -> Measured:
    case = (setup.world, setup.cone, setup.plan)
    forward, _ = setup.rollout
    gradient, seconds = compiled(jax.grad(_work_a_tonne, 2), *case)
    one, both = setup.timed([forward, gradient], [case])
    figures = {"ratio_to_forward": both.timing.median / one.timing.median}
    memory = gradient.memory_analysis()  # type: ignore[attr-defined]
    if memory is not None:
        figures["temporary_mebibytes"] = memory.temp_size_in_bytes / 2**20
    return Measured(seconds, both.timing, figures)


def _characteristics(setup: Setup, count: int) -> tuple[Array, Array]:
    """Inputs of ψ_low at places around the toe of the cone: characteristics and actions."""
    pile = setup.cone
    poses = jax.tree.map(floats, edge_poses(toe_contour(pile), count))
    local = jax.jit(jax.vmap(lambda pose: as_vector(characteristics(sample_local(pile, pose)))))
    return local(poses), random_actions(count, np.random.default_rng(setup.seed))


def _predictor(setup: Setup) -> Callable[[Array, Array], Performance]:
    model = cast(LearnedWorld, setup.world).performance
    return lambda characteristics, action: model.of_view(characteristics, action)


def _measure_psi_low(setup: Setup) -> Measured:
    cases = list(zip(*_characteristics(setup, _LOCATIONS), strict=True))
    # With its weights compiled in, as in a planner: to hand them over takes as long again.
    run, seconds = compiled(_predictor(setup), *cases[0])
    (found,) = setup.timed([run], cases)
    return Measured(seconds, found.timing)


def _measure_psi_low_batch(setup: Setup) -> Measured:
    pairs = _characteristics(setup, _LOCATIONS)
    run, seconds = compiled(jax.vmap(_predictor(setup)), *pairs)
    (found,) = setup.timed([run], [pairs])
    return Measured(seconds, found.timing, {"seconds_each": found.timing.median / _LOCATIONS})


def _measure_gpu_rollouts(setup: Setup) -> Measured:
    if jax.default_backend() == "cpu":
        return Measured(note="no GPU")
    return measure_rollouts(setup, _ROLLOUTS)


def measure_rollouts(setup: Setup, count: int) -> Measured:
    """Many rollouts of 40 loads in one call."""
    case = (setup.world, setup.cone, setup.plans(count))
    run, seconds = compiled(jax.vmap(rollout, (None, None, 0)), *case)
    (found,) = setup.timed([run], [case])
    return Measured(
        seconds, found.timing, {"loads_per_second": count * LOADS / found.timing.median}
    )


ROLLOUTS = (
    Item("loading", "one loading in the low world", _measure_loading, "low world"),
    Item(
        "rollout",
        f"{LOADS} loads in the low world",
        _measure_rollout,
        "low world",
        "paper 44.3 s",
        "≤ 0.1 s",
        most={"run": 0.1},
    ),
    Item(
        "rollout-gradient",
        "gradient of it with respect to the plan",
        _measure_rollout_gradient,
        "low world",
        "naive reverse mode 11 × forward",
        "≤ 4 × forward",
        most={"ratio_to_forward": 4.0},
    ),
    Item(
        "psi-low",
        "one inference of ψ_low",
        _measure_psi_low,
        "low world",
        "paper 0.36 ms",
        "≤ 0.05 ms",
        most={"run": 5e-5},
    ),
    Item(
        "psi-low-batch",
        f"{_LOCATIONS} inferences in one call",
        _measure_psi_low_batch,
        "low world",
        "paper 0.36 ms each",
        "≤ 0.05 ms each",
        most={"seconds_each": 5e-5},
    ),
    Item(
        "gpu-rollouts",
        f"{_ROLLOUTS} rollouts of {LOADS} loads in one call",
        _measure_gpu_rollouts,
        "low world",
    ),
)
"""Loadings, rollouts and inferences."""
