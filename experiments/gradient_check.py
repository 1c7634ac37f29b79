"""The gradient of a plan's cost against central differences, component by component, in float64."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wlplan
from experiments.record import main
from wlplan.io import write_bytes_atomic
from wlplan.objective import OBJECTIVES
from wlplan.planner.job import Job, play_plan
from wlplan.plots import png_bytes
from wlplan.transport import default_receiver

KIND, SLOPE_DEGREES, SEED, LOADS, STEP = "conical", 30.0, 1, 5, 1e-6
COMPONENTS = ("x", "y", "heading", "delta_bm", "k_bm", "delta_bk", "k_bk")


def run(preset: str) -> dict[str, Any]:
    """Reverse mode and central differences over every pose and action component."""
    loads = 1 if preset == "smoke" else LOADS
    pile = wlplan.relax(wlplan.seed_pile(KIND, slope=math.radians(SLOPE_DEGREES), seed=SEED))
    contour = wlplan.toe_contour(pile)
    rng = np.random.default_rng(SEED)
    # Neighbouring digs, so that each feels what the ones before did.
    index = (np.arange(loads) * 11) % len(contour.points)
    pose = np.c_[contour.points[index], contour.heading[index] + 0.1 * rng.normal(size=loads)]
    action = np.array([0.35, 2.5, 0.35, 2.5]) * rng.uniform(0.6, 1.4, (loads, 4))
    with jax.enable_x64(True):
        wide = jax.tree.map(_widened, (wlplan.load_world("low"), pile, default_receiver(pile)))
        world, pile, receiver = wide
        job = Job(world, pile, receiver, OBJECTIVES["efficiency"])

        def cost(flat: jax.Array) -> jax.Array:
            table = flat.reshape(loads, 7)
            plan = wlplan.LoadingPlan(wlplan.Pose(*table[:, :3].T), wlplan.Action(*table[:, 3:].T))
            return play_plan(job, plan).cost

        flat = np.c_[pose, action].ravel()
        exact = np.asarray(jax.jit(jax.grad(cost))(flat))
        value = jax.jit(cost)
        here = float(value(flat))
        rows = []
        for k in range(flat.size):
            ahead, behind = flat.copy(), flat.copy()
            ahead[k] += STEP
            behind[k] -= STEP
            up, down = float(value(ahead)), float(value(behind))
            central = (up - down) / (2 * STEP)
            scale = max(abs(central), abs(exact[k]), 1e-3 * np.abs(exact).max())
            error = abs(central - exact[k]) / scale
            bend = abs(up - 2 * here + down) / STEP / scale
            rows.append(
                {
                    "load": k // 7 + 1,
                    "component": COMPONENTS[k % 7],
                    "reverse": float(exact[k]),
                    "central": central,
                    "relative_error": error,
                    # One-sided differences that disagree by half the error: a kink within STEP.
                    "kink": bool(error > 1e-4 and bend > 0.5 * error),
                }
            )
    smooth = [row["relative_error"] for row in rows if not row["kink"]]
    return {
        "loads": loads,
        "step": STEP,
        "components": len(rows),
        "kinks": sum(row["kink"] for row in rows),
        "largest_relative_error": max(smooth),
        "median_relative_error": float(np.median(smooth)),
        "rows": rows,
    }


def _widened(leaf: Any) -> Any:
    array = np.asarray(leaf)
    return jnp.asarray(array, jnp.float64) if array.dtype.kind == "f" else leaf


def draw(folder: Path) -> None:
    """Relative error of every component, load by load."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "gradient_check.json").read_text())
    figure = Figure(figsize=(5.6, 3.4), layout="constrained")
    axis = figure.subplots()
    for name in COMPONENTS:
        rows = [row for row in result["rows"] if row["component"] == name and not row["kink"]]
        errors = [max(row["relative_error"], 1e-14) for row in rows]
        axis.semilogy([row["load"] for row in rows], errors, "o", ms=4, label=name)
    axis.axhline(1e-4, color="#999999", lw=1)
    axis.set_xticks(range(1, result["loads"] + 1))
    axis.set_xlabel("load")
    axis.set_ylabel("relative error of the gradient")
    axis.legend(frameon=False, ncols=2, fontsize=8)
    write_bytes_atomic(folder / "gradient_check.png", png_bytes(figure))


if __name__ == "__main__":
    main("gradient_check", run, draw)
