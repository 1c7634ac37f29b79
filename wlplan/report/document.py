"""A played plan as the content of plan.json, and the folder that shows it to a person."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from wlplan.constants import KG_PER_TONNE, QUANTITIES
from wlplan.io.plans import plan_to_dict
from wlplan.planning.amounts import Amount, Trucks, amount_fields
from wlplan.planning.clearance import clearance
from wlplan.planning.placement import place_of
from wlplan.planning.playing import PlanResult
from wlplan.planning.way import points_of
from wlplan.planning.yard import unpacked_soil
from wlplan.report.legs import way
from wlplan.report.plausibility import remarks_on
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.site.soil import Soil
from wlplan.terrain.standing import standing
from wlplan.types import Characteristics, Performance, Pile, SolveReport

RECEIVER_FIELDS = tuple(field.name for field in dataclasses.fields(Receiver))
"""Fields of a receiver in plan.json: x [m], y [m] and heading [rad]."""


def receiver_fields(receiver: Receiver) -> dict[str, float]:
    """What plan.json says about a receiver."""
    return {name: float(getattr(receiver, name)) for name in RECEIVER_FIELDS}


def plan_document(
    before: Pile,
    simulated: PlanResult,
    *,
    site: Site,
    predicted: Performance | None = None,
    predicted_cost: float | None = None,
    deviation: Performance | None = None,
    stall_probability: Sequence[float] | Array | None = None,
    amount: Amount | None = None,
    stopped: str = "",
    seen: tuple[Characteristics, Characteristics] | None = None,
    **origin: Any,
) -> dict[str, Any]:
    """Lays a played plan out as the content of a plan.json, with its sums and its ledger.

    Args:
        before: The pile before the first loading.
        simulated: The plan as it was played.
        site: Where: its receiver, its frame, and its soil, whose density closes the ledger.
        predicted: What the world that planned foresaw, leaves [N]; None: nothing is known of it.
        predicted_cost: Cost of the plan in that world.
        deviation: Standard deviation of the error of what it foresaw, leaves [N]; None: not known.
        stall_probability: How likely each load stalls by that world [1]; None: it does not know.
        amount: How much was to be loaded.
        stopped: What ended the search for the plan early, see `PlanResult`.
        seen: The least and the largest characteristics of faces that it was trained on.
        **origin: Further top-level fields: pile, soil, machine, world, planner, objective, seed.
    """
    total = {
        "simulated": totals(simulated.rollout.performance, float(simulated.cost)),
        "transport": {
            "time": _sum(simulated.transport.time),
            "work": _sum(simulated.transport.work),
        },
    }
    wait = np.asarray(simulated.transport.wait, np.float64)
    if wait.any():
        total["transport"]["wait"] = float(wait.sum())
    if predicted is not None:
        total = {"predicted": totals(predicted, predicted_cost), **total}
    if deviation is not None:
        # Models err in the same way in many loads: so what the sum may be off by at most.
        total["deviation"] = {name: _sum(getattr(deviation, name)) for name in QUANTITIES}
    ways: dict[str, Any] = (
        {} if simulated.ways is None else {"paths": paths_of(before, simulated, site)}
    )
    job: dict[str, Any] = {} if amount is None else {"job": amount_fields(amount)}
    if stopped:
        job["stopped"] = stopped
    if simulated.plan.truck is not None:
        job["trucks"] = trucks_of(simulated, site, amount)
    document = plan_to_dict(
        simulated.plan,
        **ways,
        predicted=predicted,
        deviation=deviation,
        simulated=simulated.rollout.performance,
        stall_probability=None
        if stall_probability is None
        else np.asarray(stall_probability, np.float64).tolist(),
        transport={"time": simulated.transport.time, "work": simulated.transport.work},
        **origin,
        **job,
        frame=site.frame.fields(),
        receiver=receiver_fields(site.of_truck(0).placed_receiver),
        total=total,
        ledger=ledger_of(before, simulated, site.soil),
    )
    notes = remarks_on(
        document,
        before,
        site,
        faces=simulated.faces,
        seen=seen,
        soil=_soil_at_trucks(before, simulated),
    )
    return {**document, "notes": notes}


def _soil_at_trucks(before: Pile, played: PlanResult) -> dict[int, np.ndarray]:
    """Cells with soil that cannot be driven over when each truck comes, where that is known."""
    if played.plan.truck is None or played.ways is None:
        return {}
    numbers, first = np.unique(np.asarray(played.plan.truck), return_index=True)
    packed = np.asarray(played.ways.soil)
    return {
        int(number): unpacked_soil(packed[n], before.height.shape)
        for number, n in zip(numbers, first, strict=True)
    }


def trucks_of(played: PlanResult, site: Site, amount: Amount | None) -> list[dict[str, Any]]:
    """What plan.json says about trucks: payload and mass [tonne], loads counted from 0, place.

    Args:
        played: The plan as it was played; it says which truck each load goes to.
        site: With its receivers, which is where the places are said.
        amount: What was to be loaded, with the payload.
    """
    truck = np.asarray(played.plan.truck)
    mass = np.asarray(played.rollout.performance.mass, np.float64)
    payload = {"payload": float(amount.payload)} if isinstance(amount, Trucks) else {}
    return [
        {
            **payload,
            "mass": float(mass[truck == number].sum()),
            "loads": np.flatnonzero(truck == number).tolist(),
            **receiver_fields(site.of_truck(number).placed_receiver),
        }
        for number in range(int(truck.max(initial=-1)) + 1)
    ]


def paths_of(before: Pile, played: PlanResult, site: Site) -> list[dict[str, Any]]:
    """What plan.json says about the way of each load: its points, length and clearance.

    Args:
        before: The pile before the first loading.
        played: The plan as it was played, with its ways.
        site: Machine and receivers.
    """
    assert played.ways is not None
    machine, truck = site.machine, played.plan.truck
    closed = False if site.keep_out is None else np.asarray(site.keep_out)
    stands, found = closed | standing(np.asarray(before.floor), before.cell_size), []
    ways = jax.tree.map(lambda leaf: np.asarray(leaf), played.ways)
    pose = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(played.plan.pose)]
    for n in range(len(pose[0])):
        way, soil = jax.tree.map(lambda leaf, n=n: leaf[n], (ways.way, ways.soil))
        points = points_of(way, machine.turning_radius)
        blocked = stands | unpacked_soil(soil, before.height.shape)
        dig = np.array([axis[n] for axis in pose])
        to = place_of(site.of_truck(None if truck is None else truck[n]).placed_receiver)
        found.append(
            {
                "path": {
                    "points": [
                        [round(x, 3), round(y, 3), round(heading, 5), int(gear)]
                        for x, y, heading, gear in points.tolist()
                    ],
                    "length": float(way.length),
                    "unseen": float(ways.unseen[n]),
                },
                "clearance": clearance(points, dig, blocked, before, to, machine),
            }
        )
    return found


def deviation_of(document: Mapping[str, Any]) -> Performance | None:
    """The standard deviations that a plan.json has for all of its loads; None if it lacks one."""
    records = [load.get("deviation") for load in document["loads"]]
    rows = [
        [record.get(name) if isinstance(record, dict) else None for name in QUANTITIES]
        for record in records
    ]
    known = all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) and v >= 0.0
        for row in rows
        for v in row
    )
    return Performance(*np.array(rows, dtype=float).T) if rows and known else None


def totals(performance: Performance, cost: float | None = None) -> dict[str, float]:
    """Sums of mass [tonne], time [s] and work [kJ] over the loads, and the cost if there is one."""
    sums = {quantity: _sum(getattr(performance, quantity)) for quantity in QUANTITIES}
    return sums if cost is None else {**sums, "cost": cost}


def ledger_of(pile: Pile, simulated: PlanResult, soil: Soil) -> dict[str, Any]:
    """What left the pile [m^3], what was loaded [tonne], and how the solvers ended."""

    def volume(after: Pile) -> float:
        # In float64: a bucket is a small difference of large volumes.
        above = np.asarray(after.height, np.float64) - np.asarray(after.floor, np.float64)
        return float(above.sum()) * after.cell_size**2

    ledger = {
        "volume_before": volume(pile),
        "volume_after": volume(simulated.rollout.pile),
        "mass_removed": _sum(simulated.rollout.performance.mass),
        "density": soil.density / KG_PER_TONNE,
    }
    return ledger if simulated.solves is None else {**ledger, "solves": solved(simulated.solves)}


def solved(solves: SolveReport) -> dict[str, Any]:
    """How the solvers of all loadings ended, the worst of each.

    Args:
        solves: Leaves [N].
    """
    unsettled = np.flatnonzero(~np.asarray(solves.settled)) + 1
    return {
        "most_rounds": int(np.asarray(solves.rounds).max()),
        "steepest_slope_deg": math.degrees(float(np.asarray(solves.steepest_slope).max())),
        "missing_volume": float(np.abs(np.asarray(solves.missing, np.float64)).max()),
        "unsettled_loads": unsettled.tolist(),
    }


def violations_of(result: PlanResult, constraints: tuple[str, ...]) -> dict[str, list[int]]:
    """The loads, counted from 1, that violate each constraint that is violated at all."""
    found = {
        name: (np.flatnonzero(np.asarray(result.terms[name]) > 0.0) + 1).tolist()
        for name in constraints
    }
    return {name: loads for name, loads in found.items() if loads}


def write_plan_folder(
    folder: Path,
    document: Mapping[str, Any],
    pile: Pile,
    simulated: PlanResult,
    *,
    site: Site,
    predicted: Performance | None = None,
    heights: Float[np.ndarray, "n nx ny"] | None = None,
    settings: Mapping[str, str] | None = None,
    also: Sequence[str] = (),
) -> list[str]:
    """Writes plan.json, plan.png, totals.png, report.html and what is exported into a folder.

    Args:
        folder: Existing folder.
        document: Content of the plan.json, see `plan_document`.
        pile: The pile before the first loading.
        simulated: The plan as it was played.
        site: With its receiver and its frame.
        predicted: What the world that planned foresaw, leaves [N], if it is known.
        heights: As each load leaves them [m], for the page; None: it shows pictures alone.
        settings: Further lines for the page's table of settings, by name.
        also: What is exported, see `wlplan.report.exports`.

    Returns:
        Names of the files, the page first.

    Raises:
        InputError: If a file cannot be written.
    """
    from wlplan.io import write_bytes_atomic, write_plan
    from wlplan.report import figures
    from wlplan.report.exports import Played, exported
    from wlplan.report.headline import key_figures
    from wlplan.report.page import REPORT_NAME, write_report
    from wlplan.report.pictures import galleries_of
    from wlplan.report.scene import scene_of
    from wlplan.worlds.names import engine_of

    count, after = len(document["loads"]), simulated.rollout.pile
    performance, deviation = simulated.rollout.performance, deviation_of(document)
    played_in = engine_of(document).title
    shown = figures.PlanOnPile(
        pile,
        simulated.plan,
        receiver=site.placed_receiver,
        ways=[way(load) for load in document["loads"]],
        area=site.truck_area,
        frame=site.frame,
        machine=site.machine,
    )
    title = f"After {count} load{'s'[: count != 1]} in {played_in}"
    map_png = figures.png_bytes(
        figures.plan_figure(shown, after, after_title=title, figures=key_figures(document))
    )
    both = (performance, None) if predicted is None else (predicted, performance, deviation)
    totals_png = figures.png_bytes(figures.totals_figure(*both))
    write_plan(folder / "plan.json", document)
    write_bytes_atomic(folder / "plan.png", map_png)
    write_bytes_atomic(folder / "totals.png", totals_png)
    write_report(
        folder,
        document,
        galleries=galleries_of(
            shown,
            after,
            after_title=title,
            heights=heights,
            predicted=predicted,
            simulated=performance,
            deviation=deviation,
        ),
        scene=None if heights is None else scene_of(pile, heights, document),
        settings=settings,
    )
    if heights is None:
        # Of the last load alone.
        heights = np.asarray(simulated.rollout.pile.height)[None]
    more = exported(also, Played(document, pile, heights))
    for name, content in more.items():
        write_bytes_atomic(folder / name, content)
    return [REPORT_NAME, "plan.json", "plan.png", "totals.png", *more]


def _sum(values: Any) -> float:
    return float(np.asarray(values, np.float64).sum())
