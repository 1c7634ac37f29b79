"""Stalls: how well they are foreseen, on new cycles and in plans; whether caution and mending pay.

Greedy plans in the hybrid and the low world, with caution of several kinds and none, each dig at
the toe of the pile as the simulator has it, all of it played there.
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
from scipy.stats import t as students_t

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.engines.limits import STOP_REASONS
from wlplan.engines.simulator import Simulator, dig
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.models.storage import read_description
from wlplan.planning.planners import Greedy
from wlplan.planning.terms import TERMS
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, ORANGE, new_figure, tidy
from wlplan.training.stall import stall_report
from wlplan.types import LoadingPlan, Performance, Pile
from wlplan.worlds.shipped import pretrained_path

LOADS, SLOPE_DEGREES, SEEDS = 15, 30.0, (1, 2, 3)
KINDS = {"cone": "conical", "ridge": "triangular", "wedge": "wedge"}
CAUTION = {
    "none": (0.0, 0.0),
    **{f"stall {weight:g}": (weight, 0.0) for weight in (0.5, 1.0, 2.0, 8.0)},
    **{f"deviation {weight:g}": (0.0, weight) for weight in (0.5, 1.0)},
}
"""Weights of the terms "stall" and "deviation" beside those of "efficiency", by name."""
# In each world, the kinds of caution, and how many of the seeds.
WORLDS = {
    "hybrid": ((*CAUTION, "none, mended"), len(SEEDS)),
    "low": (("none", "stall 1", "stall 8", "none, mended"), 2),
}
_TIMEOUT = STOP_REASONS.index("timeout")


@no_type_check
class Cautious(struct.PyTreeNode):
    """A learned world that carries the weights of caution: with others nothing is compiled anew."""

    world: Any
    weights: Float[Array, "2"]  # of the terms "stall" and "deviation"

    differentiable = has_stall_probability = has_uncertainty = True

    def __call__(self, *loading: Any) -> tuple[Pile, Performance]:
        """As the world."""
        outcome: tuple[Pile, Performance] = self.world(*loading)
        return outcome

    def stall_probability(self, *loading: Any) -> Array:
        """As the world."""
        likely: Array = self.world.stall_probability(*loading)
        return likely

    def uncertainty(self, *loading: Any) -> Performance:
        """As the world."""
        deviation: Performance = self.world.uncertainty(*loading)
        return deviation


def caution(loading: wlplan.Loading) -> Float[Array, ""]:
    """Both terms with the weights of the world; nothing in the simulator."""
    if not isinstance(loading.world, Cautious):
        return jnp.zeros_like(loading.performance.time)
    terms = jnp.stack([TERMS[name](loading) for name in ("stall", "deviation")])
    return loading.world.weights @ terms


def cases(preset: str) -> list[tuple[str, int, Pile]]:
    """Name, seed of the planner, and pile; all on maps of one shape, so that little is compiled."""
    if preset == "smoke":
        return [("cone", 1, _seed_pile("conical", 1))]
    found = [(name, seed, _seed_pile(kind, seed)) for name, kind in KINDS.items() for seed in SEEDS]
    bundled = wlplan.read_pile(bundled_pile_path())
    found += [("bundled", seed, bundled) for seed in SEEDS]
    sides = np.max([pile.height.shape for _, _, pile in found], axis=0)
    return [(name, seed, _on_map(pile, tuple(sides))) for name, seed, pile in found]


def run(preset: str) -> dict[str, Any]:
    """Plans and plays all cases with every kind of caution, in both worlds."""
    worlds = {"hybrid": (("none", "stall 1"), 1)} if preset == "smoke" else WORLDS
    rows = []
    for name, (kinds, seeds) in worlds.items():
        rows += played(name, [c for c in cases(preset) if c[1] in SEEDS[:seeds]], kinds, preset)
    return summary(rows)


def played(
    name: str, piles: list[tuple[str, int, Pile]], kinds: tuple[str, ...], preset: str
) -> list[dict[str, Any]]:
    """The plans of a world, as foreseen there and as played."""
    smoke = preset == "smoke"
    planner = Greedy(actions=6, refine_steps=2, poses_per_metre=0.3) if smoke else Greedy()
    world, simulator = wlplan.load_world(name), wlplan.load_world("simulator")
    objective = wlplan.Objective({**wlplan.OBJECTIVES["efficiency"], "caution": caution})
    rows = []
    for pile_name, seed, pile in piles:
        for kind in kinds:
            planned = wlplan.plan_loads(
                Cautious(world, jnp.asarray(CAUTION[kind.removesuffix(", mended")])),
                pile,
                loads=2 if smoke else LOADS,
                objective=objective,
                planner=planner,
                seed=seed,
                referee=simulator,
                mend=kind.endswith("mended"),
            )
            head = {"world": name, "pile": pile_name, "seed": seed, "caution": kind}
            rows.append({**head, **_row(world, planned, pile)})
            say(json.dumps(rows[-1]))
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What all plans together say, and each of them."""
    held_out = read_description(pretrained_path("stall"), "stall")["held_out"]
    # Loads that were mended were made because they stalled.
    once = [row for row in rows if not row["caution"].endswith("mended")]
    level = [row for row in once if row["pile"] != "bundled"]
    of_world: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        of_world.setdefault(row["world"], []).append(row)
    result = {
        "slope_degrees": SLOPE_DEGREES,
        "planner": "greedy",
        "held_out": held_out,
        "plans": {"all": _calibration(once), "level floors": _calibration(level)},
        "caution": {
            name: {
                kind: _compared(mine, kind)
                for kind in dict.fromkeys(row["caution"] for row in mine)
            }
            for name, mine in of_world.items()
        },
        "floor": {
            name: _floors([row for row in mine if row in once]) for name, mine in of_world.items()
        },
    }
    return {**result, "rows": rows}


def _seed_pile(kind: str, seed: int) -> Pile:
    return wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(SLOPE_DEGREES), seed=seed))


def _on_map(pile: Pile, shape: tuple[int, ...]) -> Pile:
    """A pile in a larger map; around it is level ground, seen where the pile has no mask."""
    widths = [(0, want - have) for want, have in zip(shape, pile.height.shape, strict=True)]
    floor = np.pad(np.asarray(pile.floor), widths, mode="edge")
    seen = np.ones(shape, bool)
    if pile.valid is not None:
        seen = np.pad(np.asarray(pile.valid), widths)
    inside = np.pad(np.ones(pile.height.shape, bool), widths)
    height = np.where(inside, np.pad(np.asarray(pile.height), widths), floor)
    return Pile(
        height=jnp.asarray(height),
        cell_size=pile.cell_size,
        origin=jnp.asarray(pile.origin),
        ground=jnp.asarray(floor),
        valid=jnp.asarray(seen),
    )


def _row(world: Any, planned: wlplan.PlanResult, pile: Pile) -> dict[str, Any]:
    """A plan as it was foreseen and as it was played, and each of its loads."""
    played = planned.refereed
    assert played is not None
    found = jax.tree.map(np.asarray, _digs(world, Simulator(), pile, planned.plan))
    performance, transport = played.rollout.performance, played.transport
    loads = {
        # As the plan had it, and on the pile as the simulator had it by then.
        "planned": np.asarray(planned.stall_probability),
        "before": found["likely"],
        "stalled": (found["stop"] == _TIMEOUT).astype(int),
        "on_level_floor": (found["stop_on_level_floor"] == _TIMEOUT).astype(int),
        "time": np.asarray(performance.time),
        "foreseen_time": np.asarray(planned.rollout.performance.time),
        "mass": np.asarray(performance.mass),
        "foreseen_mass": np.asarray(planned.rollout.performance.mass),
    }
    return {
        # In the simulator the terms of caution count nothing, so costs compare.
        "cost": float(played.cost),
        "foreseen_cost": float(
            sum(
                weight * planned.terms[name].sum()
                for name, weight in wlplan.OBJECTIVES["efficiency"].items()
            )
        ),
        "seconds": float(performance.time.sum() + transport.time.sum()),
        "mass": float(performance.mass.sum()),
        "work": float(performance.work.sum() + transport.work.sum()),
        "stalls": int(loads["stalled"].sum()),
        "loads": {name: np.round(values, 4).tolist() for name, values in loads.items()},
    }


@functools.partial(jax.jit, static_argnames="simulator")
def _digs(world: Any, simulator: Simulator, pile: Pile, plan: LoadingPlan) -> dict[str, Array]:
    """Of each load in the simulator: how likely it was to stall, and what ended its filling.

    And what would have ended it on a level floor, as the floors of the training data are.
    """

    def load(pile: Pile, one: LoadingPlan) -> tuple[Pile, dict[str, Array]]:
        likely = world.stall_probability(pile, one.pose, one.action)
        after, _, cycle = simulator.play(pile, one.pose, one.action)
        height, _ = simulator.view(pile, one.pose)
        level = dig(
            height,
            jnp.minimum(height, 0.0),
            one.action,
            machine=simulator.machine,
            soil=simulator.soil,
            settings=simulator.settings,
        )
        return after, {
            "likely": likely,
            "stop": cycle.stop_reason,
            "stop_on_level_floor": level.stop_reason,
        }

    found: dict[str, Array] = jax.lax.scan(load, pile, plan)[1]
    return found


def _calibration(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Reports of what was foreseen of the loads of plans: by the plan, and just before each."""
    happened = np.concatenate([row["loads"]["stalled"] for row in rows]) > 0
    reports = {}
    for when in ("planned", "before"):
        # Within what four digits tell.
        likely = np.clip(np.concatenate([row["loads"][when] for row in rows]), 5e-5, 1.0 - 5e-5)
        reports[when] = stall_report(np.log(likely / (1.0 - likely)), happened).as_dict()
    return reports


def _compared(rows: list[dict[str, Any]], kind: str) -> dict[str, Any]:
    """Plans with caution beside those without, case by case, with the interval of 95 %."""

    def of(which: str, name: str) -> np.ndarray:
        return np.array([row[name] for row in rows if row["caution"] == which], float)

    found: dict[str, Any] = {}
    for name in ("cost", "seconds", "mass", "work", "stalls", "foreseen_cost"):
        mine, other = of(kind, name), of("none", name)
        found[name] = {"mean": float(mine.mean())}
        if kind != "none":
            # Relative, but for stalls, of which there may be none.
            change = mine - other if name == "stalls" else 100.0 * (mine / other - 1.0)
            half = 0.0
            if len(change) > 1:
                spread = change.std(ddof=1) / math.sqrt(len(change))
                half = float(students_t.ppf(0.975, len(change) - 1) * spread)
            found[name] |= {"change": float(change.mean()), "half_interval": half}
    return found


def _floors(rows: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Stalls on each kind of pile: as played, and with a level floor under the same face."""
    found: dict[str, dict[str, int]] = {}
    for row in rows:
        counts = found.setdefault(row["pile"], {"loads": 0, "stalls": 0, "on_level_floor": 0})
        counts["loads"] += len(row["loads"]["stalled"])
        counts["stalls"] += row["stalls"]
        counts["on_level_floor"] += sum(row["loads"]["on_level_floor"])
    return found


def draw(folder: Path) -> None:
    """Reliability on new cycles and in plans, and what caution changes in the simulator."""
    result = json.loads((folder / "risk.json").read_text())
    figure = new_figure(9.4, 3.4)
    panels = figure.subplots(1, 1 + len(result["caution"]), squeeze=False)[0]
    _draw_reliability(panels[0], result)
    for panel, (world, kinds) in zip(panels[1:], result["caution"].items(), strict=True):
        names = [name for name in kinds if name != "none"]
        places = np.arange(len(names))
        for shift, what, label, colour in (
            (-0.13, "cost", "cost", BLUE),
            (0.13, "seconds", "time", ORANGE),
        ):
            panel.errorbar(
                [kinds[name][what]["change"] for name in names],
                places + shift,
                xerr=[kinds[name][what]["half_interval"] for name in names],
                fmt="o",
                ms=4,
                color=colour,
                lw=1.2,
                label=label,
            )
        panel.axvline(0.0, color=FAINT, lw=1.0)
        panel.set_yticks(places, names, fontsize=8)
        panel.invert_yaxis()
        panel.set_title(f"planned in {world}", fontsize=9)
        panel.set_xlabel("change in the simulator [%]", fontsize=8)
        tidy(panel)
    panels[-1].legend(fontsize=8, frameon=False)
    write_bytes_atomic(folder / "risk.png", png_bytes(figure))


def _draw_reliability(panel: Any, result: dict[str, Any]) -> None:
    """What stalled over what was foreseen, with intervals of 95 %."""
    least = 1e-5
    panel.plot([least, 1.0], [least, 1.0], color=FAINT, lw=1.0)
    sources = {
        "new cycles": (result["held_out"], BLUE),
        "loads of plans": (result["plans"]["all"]["before"], ORANGE),
        "of these, on level floors": (result["plans"]["level floors"]["before"], GREEN),
    }
    for label, (report, colour) in sources.items():
        bins = [one for one in report["bins"] if one is not None]
        foreseen, stalled, counts = (
            np.array([one[name] for one in bins]) for name in ("foreseen", "stalled", "cycles")
        )
        # Wilson's.
        z2 = 1.96**2 / counts
        middle = (stalled + 0.5 * z2) / (1.0 + z2)
        half = np.sqrt(z2 * stalled * (1.0 - stalled) + 0.25 * z2**2) / (1.0 + z2)
        panel.vlines(
            foreseen, np.maximum(middle - half, least), middle + half, color=colour, lw=1.2
        )
        panel.plot(foreseen, np.maximum(stalled, least), "o", ms=4, color=colour, label=label)
    panel.set_xscale("log")
    panel.set_yscale("log")
    # Room for the legend.
    panel.set_ylim(0.5 * least, 200.0)
    panel.set_title("stalls", fontsize=9)
    panel.set_xlabel("probability, foreseen", fontsize=8)
    panel.set_ylabel("part that stalled", fontsize=8)
    panel.legend(fontsize=7, frameon=False)
    tidy(panel)


if __name__ == "__main__":
    main("risk", run, draw)
