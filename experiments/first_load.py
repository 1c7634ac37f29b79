"""What the first load of a plan does to its totals, in each world and over 1 to 40 loads.

The gradient through the whole rollout, beside differences over a planner's step, and how much of
it comes from the loads after the first.
"""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wlplan
from experiments._common.gradients import NARROW
from experiments._common.results import main
from experiments._common.rows import Rows
from wlplan import studies
from wlplan.io import write_bytes_atomic
from wlplan.planning.job import Decisions, make_job, with_toe
from wlplan.planning.playing import cusps_of_plans, outcomes
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, GREEN, INK, ORANGE, new_figure, tidy
from wlplan.types import LoadingPlan, Pile

KIND, SLOPE_DEGREES, SEED = "conical", 30.0, 1
PLANS, LOADS = 2, (1, 2, 5, 10, 20, 40)
WORLDS = {"low": BLUE, "hybrid": ORANGE, "high": GREEN, "simulator": INK}
# A component whose difference is less than this part of the largest has no sign to speak of.
_NOTHING = 0.02


def run(preset: str, rows: Path) -> dict[str, Any]:
    """Gradients and differences of the totals, and what they say, by world."""
    smoke = preset == "smoke"
    loads, plans = ((1, 2), 1) if smoke else (LOADS, PLANS)
    pile = wlplan.relax(wlplan.seed_pile(KIND, slope=math.radians(SLOPE_DEGREES), seed=SEED))
    kept = Rows(rows, {"pile": (KIND, SLOPE_DEGREES, SEED), "loads": loads})
    found: dict[str, list[Any]] = {name: [] for name in (("low",) if smoke else WORLDS)}
    for number in range(plans):
        plan = np.array(kept.get(f"plan {number}", partial(_random_plan, pile, max(loads), number)))
        for name, tables in found.items():
            tables.append(
                kept.get(
                    f"{name}, plan {number}",
                    partial(_horizon, name, pile, plan, loads),
                )
            )
    return {
        "pile": {"kind": KIND, "slope_degrees": SLOPE_DEGREES, "seed": SEED},
        "plans": plans,
        "loads": loads,
        "steps": studies.STEPS,
        "worlds": {name: _summary(tables) for name, tables in found.items()},
    }


def _random_plan(pile: Pile, loads: int, number: int) -> list[Any]:
    """Random digs along the toe as it retreats in the low world, [loads, 7]."""
    random = np.random.default_rng([SEED, number])
    decisions = Decisions(
        position=jnp.asarray(random.uniform(size=(1, loads)), jnp.float32),
        offset=jnp.asarray(random.normal(0.0, 0.5, (1, loads)), jnp.float32),
        action=jnp.asarray(random.normal(size=(1, loads, 4)), jnp.float32),
    )
    plan = outcomes(with_toe(make_job(wlplan.load_world("low"), pile)), decisions).plan
    columns = jax.tree.leaves((plan.pose, plan.action))
    table: list[Any] = np.stack(columns, axis=-1)[0].tolist()
    return table


def _horizon(name: str, pile: Pile, table: np.ndarray, loads: tuple[int, ...]) -> dict[str, Any]:
    """Totals, gradients and differences of one plan in one world."""
    by_differences = name == "simulator"
    with jax.enable_x64(by_differences):
        columns = [jnp.asarray(column) for column in table.T]
        plan = LoadingPlan(wlplan.Pose(*columns[:3]), wlplan.Action(*columns[3:]))
        if by_differences:
            pile = pile.replace(
                height=jnp.asarray(np.asarray(pile.height, np.float64)),
                origin=jnp.asarray(np.asarray(pile.origin, np.float64)),
            )
        job = make_job(wlplan.load_world(name), pile)
        cusps = cusps_of_plans(job, jax.tree.map(lambda leaf: leaf[None], plan))
        found = studies.horizon(
            job,
            plan,
            loads,
            narrow=NARROW if by_differences else None,
            cusps=jax.tree.map(lambda leaf: leaf[0], cusps),
        )
    return {
        name: [[[float(f"{v:.5g}") for v in row] for row in t] for t in np.asarray(table)]
        for name, table in (("gradient", found.gradient), ("difference", found.difference))
    }


def _summary(tables: list[dict[str, Any]]) -> dict[str, Any]:
    """By total, over the numbers of loads: size of the gradient, what is later, agreement."""
    gradient, difference = (
        np.array([table[name] for table in tables]) for name in ("gradient", "difference")
    )
    found = {}
    for k, total in enumerate(studies.TOTALS):
        steep, wide = gradient[:, :, k], difference[:, :, k]  # [plans, horizons, 7]
        first, size = np.linalg.norm(steep[:, :1], axis=-1), np.linalg.norm(wide, axis=-1)
        later = np.linalg.norm(steep - steep[:, :1], axis=-1) / np.maximum(first, 1e-12)
        later_wide = np.linalg.norm(wide - wide[:, :1], axis=-1) / np.maximum(size[:, :1], 1e-12)
        cosine = (steep * wide).sum(axis=-1) / np.maximum(
            np.linalg.norm(steep, axis=-1) * size, 1e-12
        )
        counts = np.abs(wide) > _NOTHING * np.abs(wide).max(axis=-1, keepdims=True)
        same = (np.sign(steep) == np.sign(wide)) & counts
        found[total] = {
            "size": np.median(np.linalg.norm(steep, axis=-1), axis=0).round(5).tolist(),
            "size_of_difference": np.median(size, axis=0).round(5).tolist(),
            "later": np.median(later, axis=0).round(4).tolist(),
            "later_of_difference": np.median(later_wide, axis=0).round(4).tolist(),
            "cosine": np.median(cosine, axis=0).round(4).tolist(),
            "same_sign": (same.sum(axis=(0, 2)) / counts.sum(axis=(0, 2))).round(4).tolist(),
        }
    return found


def draw(folder: Path) -> None:
    """Size of the gradient, part of the later loads, and agreement, against the loads."""
    result = json.loads((folder / "first_load.json").read_text())
    shown = {
        "size": "size of the gradient [per step]",
        "later": "later loads, over the first's own",
        "cosine": "cosine with the difference over a step",
    }
    figure = new_figure(12.5, 8.0)
    rows = figure.subplots(len(shown), len(studies.TOTALS), sharex=True)
    for (what, label), row in zip(shown.items(), rows, strict=True):
        for panel, total in zip(row, studies.TOTALS, strict=True):
            for name, worlds in result["worlds"].items():
                panel.plot(
                    result["loads"],
                    worlds[total][what],
                    marker="o",
                    ms=3,
                    color=WORLDS[name],
                    label=name,
                )
            panel.set_xscale("log")
            if what == "later":
                # Linear up to a tenth: it begins at none.
                panel.set_yscale("symlog", linthresh=0.1)
                panel.set_ylim(bottom=0.0)
            panel.set_xticks(result["loads"], [str(n) for n in result["loads"]])
            panel.minorticks_off()
            tidy(panel)
        row[0].set_ylabel(label, fontsize=8)
    for panel, total in zip(rows[0], studies.TOTALS, strict=True):
        panel.set_title(total, fontsize=9)
    for panel in rows[-1]:
        panel.set_ylim(-1.05, 1.05)
        panel.set_xlabel("loads in the total", fontsize=8)
    rows[0, 0].legend(fontsize=8, frameon=False)
    write_bytes_atomic(folder / "first_load.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("first_load", run, draw)
