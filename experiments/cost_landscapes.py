"""Seconds per tonne over two variables of a plan, and where the planners' descent goes there.

Two neighbouring loads on a cone. The descent is made in a learned world; what it finds is played in
the simulator.
"""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

import wlplan
from experiments._common.results import main
from experiments._common.rows import Rows
from wlplan import studies
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import FAINT, new_figure
from wlplan.types import Action, LoadingPlan, Pile, Pose, World

KIND, SLOPE_DEGREES, SEED = "conical", 30.0, 1
# How far the second load lies along the toe, in its points of 0.1 m: half a bucket.
APART = 12
POINTS, REACH = 11, 4.0
LEARNED, WORLDS = ("hybrid",), ("hybrid", "simulator")
# Component and load of either axis.
PLANES = {
    "where to dig": (("ahead", 1), ("aside", 1)),
    "how to tilt": (("delta_bk", 1), ("k_bk", 1)),
    "two loads": (("aside", 1), ("aside", 2)),
}
STARTS = np.array([[-3.0, -3.0], [3.0, 2.0]])
ITERATIONS = 20


def run(preset: str, rows: Path) -> dict[str, Any]:
    """Landscapes of all worlds, paths of the learned ones."""
    smoke = preset == "smoke"
    points, iterations = (3, 2) if smoke else (POINTS, ITERATIONS)
    worlds = LEARNED if smoke else WORLDS
    costs = _costs(worlds)
    kept = Rows(rows, {"points": points, "iterations": iterations, "starts": STARTS.tolist()})
    place = np.linspace(-REACH, REACH, points).astype(np.float32)
    at = np.zeros((2, len(studies.COMPONENTS)), np.float32)
    planes: dict[str, Any] = {}
    for title, axes in PLANES.items():
        one, other = (
            studies.direction(name, load=load, loads=2).astype(np.float32) for name, load in axes
        )

        def of(name: str, one: np.ndarray = one, other: np.ndarray = other) -> dict[str, Any]:
            found: dict[str, Any] = {}
            seen = studies.landscape(costs[name], at, (one, other), place, place)
            found["cost"] = np.asarray(seen.value, float).round(5).tolist()
            if name in LEARNED:
                path = studies.descent_path(
                    costs[name],
                    at,
                    (one, other),
                    STARTS.astype(np.float32),
                    iterations=iterations,
                )
                found["path"] = np.asarray(path.place, float).round(3).tolist()
                # The start of each row and the best of it, in all worlds.
                ends = np.stack([STARTS, np.asarray(path.best)]).reshape(-1, 2)
                ends = ends.astype(np.float32)
                found["ends"] = {
                    world: np.round(
                        [_cost(costs[world], at + u * one + v * other) for u, v in ends], 5
                    )
                    .reshape(2, -1)
                    .tolist()
                    for world in costs
                }
            return found

        planes[title] = {
            name: kept.get(f"{title}, {name}", functools.partial(of, name)) for name in worlds
        }
    return {
        "pile": {"kind": KIND, "slope_degrees": SLOPE_DEGREES, "seed": SEED},
        "axes": PLANES,
        "steps": studies.STEPS,
        "place": place.tolist(),
        "planes": planes,
    }


@no_type_check
class SecondsPerTonne(struct.PyTreeNode):
    """Time over mass of a plan [s/tonne], driving apart, over the steps of its loads, [N, 7]."""

    world: World
    pile: Pile
    plan: LoadingPlan

    def __call__(self, steps: Float[Array, "n 7"]) -> Float[Array, ""]:
        """What the plan so moved takes for a tonne."""
        pose, action = studies.moved(self.plan.pose, self.plan.action, steps)
        plan = self.plan.replace(pose=pose, action=action)
        performance = wlplan.rollout(self.world, self.pile, plan).performance
        return performance.time.sum() / performance.mass.sum()


def _costs(worlds: tuple[str, ...]) -> dict[str, SecondsPerTonne]:
    """Two neighbouring loads with actions in the middle of their box, in each world."""
    pile = wlplan.relax(wlplan.seed_pile(KIND, slope=math.radians(SLOPE_DEGREES), seed=SEED))
    toe = wlplan.toe_contour(pile)
    first = int(np.flatnonzero(toe.accessible)[0])
    spots = [first, first + APART]
    x, y = jnp.asarray(toe.points[spots].T, jnp.float32)
    middle = [jnp.full(2, value) for value in (0.35, 2.5, 0.35, 2.5)]
    plan = LoadingPlan(Pose(x, y, jnp.asarray(toe.heading[spots], jnp.float32)), Action(*middle))
    return {name: SecondsPerTonne(wlplan.load_world(name), pile, plan) for name in worlds}


@jax.jit
def _cost(cost: Any, steps: jax.Array | np.ndarray) -> jax.Array:
    value: jax.Array = cost(steps)
    return value


def draw(folder: Path) -> None:
    """A row a plane, a column a world; on the simulator's the paths of the last learned world."""
    result = json.loads((folder / "cost_landscapes.json").read_text())
    planes, place = result["planes"], result["place"]
    figure = new_figure(11.0, 3.1 * len(planes))
    columns = len(next(iter(planes.values())))
    rows = figure.subplots(len(planes), columns, squeeze=False)
    for row, (title, worlds) in zip(rows, planes.items(), strict=True):
        (first, load), (second, other) = result["axes"][title]
        paths = [world["path"] for world in worlds.values() if "path" in world]
        for panel, (name, world) in zip(row, worlds.items(), strict=True):
            cost = np.array(world["cost"])
            image = panel.pcolormesh(place, place, cost.T, cmap="viridis_r", shading="nearest")
            panel.contour(place, place, cost.T, levels=8, colors="white", linewidths=0.5)
            own = "path" in world
            for path in world["path"] if own else paths[-1]:
                x, y = np.array(path).T
                panel.plot(x, y, "-" if own else ":", color="black", lw=1.1)
                panel.plot(x[0], y[0], "o", ms=4, mfc="white", mec="black")
                panel.plot(x[-1], y[-1], "*", ms=9, mfc="white", mec="black")
            panel.set_xlim(min(place), max(place))
            panel.set_ylim(min(place), max(place))
            panel.set_xlabel(f"{first}, load {load} [steps]", fontsize=8)
            panel.set_title(f"{title}: {name}", fontsize=9)
            panel.tick_params(colors=FAINT, labelsize=7)
            figure.colorbar(image, ax=panel, pad=0.01, label="s/t")
        row[0].set_ylabel(f"{second}, load {other} [steps]", fontsize=8)
    write_bytes_atomic(folder / "cost_landscapes.png", png_bytes(figure, dpi=100))


if __name__ == "__main__":
    main("cost_landscapes", run, draw)
