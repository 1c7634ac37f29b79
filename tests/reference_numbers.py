"""Numbers that a change of the architecture must not change, and the script that writes them.

    python tests/reference_numbers.py [FILE.npz]

Only what users call: rollouts, plays, gradients, maps, uncertainties, plans and collected cycles of
a fixed set of inputs. What follows from the way to the receiver (costs, transport, what greedy
chooses) is of version 0.2.0, all else is as version 0.1.0 wrote it. Write the file anew only when
the numbers are meant to change, and say so in CHANGELOG.md.
"""

from __future__ import annotations

import functools
import math
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wlplan
from wlplan.dataset import collect, open_dataset
from wlplan.io import bundled_pile_path

FILE = Path(__file__).parent / "references" / "numbers.npz"
WORLDS = ("low", "hybrid", "high", "simulator")
LOADS = 10
# A place of its own, whatever the default is.
SITE = wlplan.Site(
    receiver=wlplan.Receiver(*(jnp.float32(v) for v in (-1.3567866, 18.930288, -2.5853984)))
)


def fixed_plan(pile: wlplan.Pile) -> wlplan.LoadingPlan:
    """Ten digs along the toe of the bundled pile, with random actions."""
    contour = wlplan.toe_contour(pile)
    spots = np.flatnonzero(contour.accessible)[::25][:LOADS]
    low, high = np.zeros(4), np.array([0.7, 5.0, 0.7, 5.0])
    action = low + (high - low) * np.random.default_rng(0).uniform(0.2, 0.8, (LOADS, 4))
    pose = (*contour.points[spots].T, contour.heading[spots])
    return wlplan.LoadingPlan(
        wlplan.Pose(*(jnp.asarray(v, jnp.float32) for v in pose)),
        wlplan.Action(*(jnp.asarray(v, jnp.float32) for v in action.T)),
    )


def numbers_of(name: str) -> dict[str, Any]:
    """Rollout, play, map, uncertainty and gradient in one world."""
    world, pile = wlplan.load_world(name), wlplan.read_pile(bundled_pile_path())
    plan = fixed_plan(pile)
    outcome = wlplan.rollout(world, pile, plan)
    played = wlplan.play(world, pile, plan, site=SITE)
    around = wlplan.diggability_map(world, pile, locations=40)
    found = {
        "rollout": outcome.performance,
        # A sixteenth of the cells.
        "pile after": outcome.pile.height[::4, ::4],
        "costs": played.costs,
        "transport time": played.transport.time,
        "transport work": played.transport.work,
        "map": around.performance,
    }
    if name == "simulator":
        return found
    first, three = (jax.tree.map(lambda leaf, k=k: leaf[k], plan) for k in (0, slice(3)))

    def cost(plan: wlplan.LoadingPlan) -> jax.Array:
        outcome = wlplan.rollout(world, pile, plan)
        performance = outcome.performance
        total = performance.work.sum() / performance.mass.sum() + 0.01 * performance.time.sum()
        return total + 1e-3 * (outcome.pile.height**2).sum()

    return found | {
        "uncertainty": world.uncertainty(pile, first.pose, first.action),  # type: ignore[attr-defined]
        "gradient": jax.grad(cost)(three),
    }


def greedy_numbers() -> dict[str, Any]:
    """What a greedy plan of two loads on a cone costs in the low world; not its digs.

    Of poses that are worth the same, rounding picks one.
    """
    pile = wlplan.relax(wlplan.seed_pile("conical", slope=math.radians(30.0), seed=1))
    world = wlplan.load_world("low")
    result = wlplan.plan_loads(world, pile, loads=2, planner="greedy", site=SITE, seed=3)
    return {"relaxed": pile.height[::4, ::4], "cost": result.cost}


def cycle_numbers() -> dict[str, Any]:
    """Collected cycles of the paper's protocol."""
    with tempfile.TemporaryDirectory() as folder:
        collect(Path(folder) / "data.zarr", cycles=180, seed=7)
        data = open_dataset(Path(folder) / "data.zarr")
    names = ("mass", "time", "work", "pose", "characteristics", "stop_reason")
    return {name: getattr(data, name)[::6] for name in names}


GROUPS: dict[str, Callable[[], dict[str, Any]]] = {
    **{name: functools.partial(numbers_of, name) for name in WORLDS},
    "greedy": greedy_numbers,
    "cycles": cycle_numbers,
}
"""What makes each group of numbers."""


def flat(group: str, values: Any) -> dict[str, np.ndarray]:
    """Arrays by the path to them."""
    leaves = jax.tree_util.tree_flatten_with_path(values)[0]
    return {f"{group} {jax.tree_util.keystr(path)}": np.asarray(leaf) for path, leaf in leaves}


if __name__ == "__main__":
    file, found = Path(sys.argv[1]) if sys.argv[1:] else FILE, dict[str, Any]()
    for group, make in GROUPS.items():
        found |= flat(group, make())
    np.savez_compressed(file, allow_pickle=False, **found)
    print(f"{file}: {len(found)} arrays, {file.stat().st_size / 1024:.0f} KiB")
