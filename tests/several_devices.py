"""What `test_devices.py` runs in a process of its own, which has several devices.

A host has one CPU device; XLA makes more of it only if it is told before it starts.
"""

import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from cones import SITE, bowl_world, cone
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import wlplan
from wlplan.parallel import ParallelMap
from wlplan.planning.amounts import Loads
from wlplan.planning.job import make_job
from wlplan.planning.planners import Greedy
from wlplan.planning.playing import costs_and_gradients, cusps_of_plans, outcomes, play_candidate
from wlplan.planning.rollout import rollout
from wlplan.types import Action, LoadingPlan, Pose

DEVICES = 4
# Sums in another order.
_ROUNDING = 2e-5


def grown(shared: jax.Array, row: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """A loop that is longer for some rows than for others."""

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return state[0] + 1.0, state[1] * shared

    steps, value = jax.lax.while_loop(
        lambda state: state[0] < row["steps"], step, (jnp.zeros(()), row["value"])
    )
    return {"steps": steps, "value": value}


def plans(count: int, loads: int = 2) -> LoadingPlan:
    """Digs into the cone from all sides, leaves [count, loads]."""
    random = np.random.default_rng(0)
    bearing = random.uniform(-np.pi, np.pi, (count, loads))
    action = (
        random.uniform(0.2, 0.5, (4, count, loads)) * np.array([1.0, 7.0, 1.0, 7.0])[:, None, None]
    )
    inward = np.remainder(bearing + 2.0 * np.pi, 2.0 * np.pi) - np.pi
    plan = LoadingPlan(Pose(4.7 * np.cos(bearing), 4.7 * np.sin(bearing), inward), Action(*action))
    digs: LoadingPlan = jax.tree.map(jnp.float32, plan)
    return digs


def same(found: Any, expected: Any) -> None:
    """Equal to rounding."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)  # type: ignore[operator]
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=_ROUNDING, atol=_ROUNDING)


def spread(tree: Any) -> bool:
    """Whether each device holds a part of its own, and all of them the same number of rows."""
    for leaf in jax.tree.leaves(tree):
        parts = [(shard.device, shard.index[0]) for shard in leaf.addressable_shards]
        rows = sorted((index.start or 0, index.stop) for _, index in parts)
        size = len(leaf) // DEVICES
        if len({device for device, _ in parts}) != DEVICES:
            return False
        if rows != [(k * size, (k + 1) * size) for k in range(DEVICES)]:
            return False
    return True


def maps() -> None:
    """Rows of any number, each as long as it takes."""
    each, two = ParallelMap(grown), jnp.float32(1.5)
    for count in (1, 3, 4, 7, 8):
        rows = {"steps": jnp.arange(float(count)), "value": jnp.ones((count, 3))}
        found = each(two, rows)
        same(found, jax.vmap(grown, in_axes=(None, 0))(two, rows))
        assert len(found["steps"]) == count
        if count % DEVICES == 0:
            assert spread(found)
        # The check can fail: what lies on one device is not spread.
        assert not spread(jax.device_put(rows, jax.devices()[0]))


def rollouts() -> None:
    """A batch that the caller lays over the devices stays there, in a world with avalanches."""
    world, pile, many = wlplan.load_world("low"), cone(), plans(8)
    batch = jax.jit(jax.vmap(rollout, (None, None, 0)))
    alone = batch(world, pile, many)
    mesh = Mesh(np.array(jax.devices()), ("plans",))
    laid = jax.device_put(many, NamedSharding(mesh, PartitionSpec("plans")))
    found = batch(world, pile, laid)
    same(found, alone)
    assert spread(found.performance)
    assert spread(found.pile.height)


def candidates() -> None:
    """Plans, their ways and their gradients, on three devices and a rest."""
    job = make_job(bowl_world, cone(), site=SITE, amount=Loads(2))
    many = plans(5)
    found = outcomes(job, many)
    alone = jax.jit(play_candidate)
    members = [alone(job, jax.tree.map(lambda leaf, k=k: leaf[k], many)) for k in range(5)]
    expected = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)
    same((found.cost, found.rollout), (expected.cost, expected.rollout))
    costs, gradients = costs_and_gradients(job, (many, cusps_of_plans(job, many)))
    np.testing.assert_allclose(costs, found.cost, rtol=1e-3)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert np.abs(gradients.action.k_bm).min() > 0.0


def planning() -> None:
    """A whole planner."""
    planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3)
    result = wlplan.plan_loads(bowl_world, cone(), loads=2, planner=planner, site=SITE)
    assert np.isfinite(float(result.cost))
    assert float(result.rollout.performance.mass.min()) > 1.0


PARTS: dict[str, Callable[[], None]] = {
    part.__name__: part for part in (maps, rollouts, candidates, planning)
}

if __name__ == "__main__":
    assert len(jax.devices()) == DEVICES
    PARTS[sys.argv[1]]()
