"""How large the gradient of a plan's cost gets with the horizon, and what memory it takes."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.io import write_bytes_atomic
from wlplan.parallel import ParallelMap
from wlplan.planning.job import Decisions, Job, make_job, with_toe
from wlplan.planning.playing import outcomes
from wlplan.report.figures import png_bytes
from wlplan.studies.gradcheck import as_table, cost_and_gradient
from wlplan.types import LoadingPlan
from wlplan.worlds.capabilities import with_derivatives

# A cone that holds twice what 100 loadings take: a bucket that comes back empty from the last of a
# pile has a large gradient of its own.
KIND, SLOPE_DEGREES, HEIGHT, SEED = "conical", 30.0, 5.0, 1
PLANS = 8
HORIZONS = {"low": (1, 2, 5, 10, 20, 50, 100), "simulator": (1, 2, 5, 10, 20, 50, 100)}
MEMORY_LOADS = (10, 100)
MEMORY_LIMIT = 2 * 2**30
# A change of a component that is about as much as any other [m, m, rad, then of the action].
UNITS = (1.0, 1.0, 0.1, *(0.1 * (np.asarray(ACTION_HIGH) - np.asarray(ACTION_LOW))))

_gradients = ParallelMap(cost_and_gradient)


def run(preset: str) -> dict[str, Any]:
    """Norms of the gradient over horizons, load by load, and memory of one long gradient."""
    smoke = preset == "smoke"
    pile = wlplan.relax(
        wlplan.seed_pile(
            KIND, slope=math.radians(SLOPE_DEGREES), height=2.0 if smoke else HEIGHT, seed=SEED
        )
    )
    horizons = {"low": (1, 2)} if smoke else HORIZONS
    plans = 2 if smoke else PLANS
    worlds = {}
    for name, lengths in horizons.items():
        job, plan = _random_plans(name, pile, plans, max(lengths))
        worlds[name] = [_row(job, plan, loads) for loads in lengths]
        if name == "low":
            memory = [_memory(job, plan, n) for n in ((2,) if smoke else MEMORY_LOADS)]
    return {
        "pile": {"kind": KIND, "slope_degrees": SLOPE_DEGREES, "seed": SEED},
        "plans": plans,
        "units": UNITS,
        "worlds": worlds,
        "memory_limit_bytes": MEMORY_LIMIT,
        "memory": memory,
    }


def _random_plans(name: str, pile: wlplan.Pile, count: int, loads: int) -> tuple[Job, LoadingPlan]:
    """Random digs along the toe as it retreats, leaves [count, loads], and what they cost."""
    rng = np.random.default_rng(SEED)
    decisions = Decisions(
        position=jnp.asarray(rng.uniform(size=(count, loads)), jnp.float32),
        offset=jnp.asarray(rng.normal(0.0, 0.5, (count, loads)), jnp.float32),
        action=jnp.asarray(rng.normal(size=(count, loads, 4)), jnp.float32),
    )
    job = with_toe(make_job(wlplan.load_world(name), pile))
    plan = outcomes(job, decisions).plan
    return job.replace(world=with_derivatives(job.world), toe=None), plan


def _row(job: Job, plan: LoadingPlan, loads: int) -> dict[str, Any]:
    """The first loads of each plan: cost and norms of the gradient."""
    costs, gradient = _gradients(job, jax.tree.map(lambda leaf: leaf[:, :loads], plan))
    table = np.asarray(as_table(gradient), np.float64) * UNITS
    norms = {
        "first": np.linalg.norm(table[:, 0], axis=-1),
        "last": np.linalg.norm(table[:, -1], axis=-1),
        "all": np.linalg.norm(table, axis=(-2, -1)),
    }
    medians = {name: round(float(np.median(values)), 4) for name, values in norms.items()}
    say(f"{loads} loads: {json.dumps(medians)}")
    return {
        "horizon": loads,
        "cost_per_load": float(np.median(costs)) / loads,
        "finite": bool(np.isfinite(table).all()),
        **{name: _spread(values) for name, values in norms.items()},
    }


def _spread(values: np.ndarray) -> dict[str, float]:
    low, middle, high = np.percentile(values, [10.0, 50.0, 90.0])
    return {"p10": float(low), "median": float(middle), "p90": float(high)}


def _memory(job: Job, plan: LoadingPlan, loads: int) -> dict[str, Any]:
    """Temporary memory that forward and backward pass of one plan need at most, as compiled."""
    one = jax.tree.map(lambda leaf: leaf[0, :loads], plan)
    analysis = jax.jit(cost_and_gradient).lower(job, one).compile().memory_analysis()
    assert analysis is not None, "this backend does not say how much memory it takes"
    return {
        "loads": loads,
        "precision": str(one.pose.x.dtype),
        "cells": list(job.pile.height.shape),
        "temp_bytes": analysis.temp_size_in_bytes,
        "below_limit": analysis.temp_size_in_bytes < MEMORY_LIMIT,
    }


def draw(folder: Path) -> None:
    """Norm of the gradient against the horizon, one panel a world."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "gradient_horizon.json").read_text())
    figure = Figure(figsize=(4.4 * len(result["worlds"]), 3.6), layout="constrained")
    axes = figure.subplots(1, len(result["worlds"]), squeeze=False, sharey=True)[0]
    kinds = {
        "all": ("all loads", "#555555", "s"),
        "first": ("first load", "#1f5fa8", "o"),
        "last": ("last load", "#d9700a", "^"),
    }
    for axis, (name, rows) in zip(axes, result["worlds"].items(), strict=True):
        horizon = [row["horizon"] for row in rows]
        for kind, (label, colour, marker) in kinds.items():
            middle, low, high = (
                [row[kind][part] for row in rows] for part in ("median", "p10", "p90")
            )
            axis.loglog(horizon, middle, marker=marker, ms=4, color=colour, label=label)
            axis.fill_between(horizon, low, high, color=colour, alpha=0.15, lw=0)
        axis.set_title(f"{name} world", fontsize=10)
        axis.set_xlabel("loads in the plan")
        axis.set_xticks(horizon, [str(n) for n in horizon])
        axis.minorticks_off()
    axes[0].set_ylabel("norm of the scaled gradient")
    axes[0].legend(frameon=False, fontsize=8, title="with respect to", title_fontsize=8)
    write_bytes_atomic(folder / "gradient_horizon.png", png_bytes(figure))


if __name__ == "__main__":
    main("gradient_horizon", run, draw)
