"""The table of a plan, and remarks on its ledger."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from wlplan.cli.outputs import print_bold, print_table, remark, titled_table
from wlplan.cli.said import say
from wlplan.constants import QUANTITIES
from wlplan.report.headline import headline, trucks_said
from wlplan.report.ledger import LEDGER_TOLERANCE, ledger_error
from wlplan.report.stands import stands_of
from wlplan.site.frame import frame_recorded


def remark_on_ledger(ledger: Mapping[str, Any]) -> None:
    """Remarks if volume and mass of a ledger disagree, or a solver did not come to rest."""
    error = ledger_error(ledger)
    if error > LEDGER_TOLERANCE:
        remark(f"the ledger of the simulated pile is off by {100.0 * error:.2g} %")
    unsettled = ledger.get("solves", {}).get("unsettled_loads")
    if unsettled:
        remark(
            f"the avalanche after load {', '.join(map(str, unsettled))} did not come to rest: the "
            f"pile is left steeper than the soil stands"
        )


def print_plan(document: Mapping[str, Any]) -> None:
    """The loads of a plan as a table on stdout, with sums, cost and ledger.

    Places are in the coordinates of the scan.
    """
    total, ledger = document["total"], document["ledger"]
    predicted = total.get("predicted", {})
    frame = frame_recorded(document)
    count = len(document["loads"])
    table = titled_table(f"{count} load{'s'[: count != 1]} from {document['pile']['file']}")
    table.add_column("load")
    # Short titles: all of it fits a terminal of 80 columns.
    for title in ("x\n[m]", "y\n[m]", "head.\n[°]"):
        table.add_column(title, justify="right")
    for title, unit, _ in QUANTITIES.values():
        if predicted:
            table.add_column(f"{title}\npred.\n[{unit}]", justify="right", style="cyan")
        table.add_column(f"{title}\nsim.\n[{unit}]", justify="right", style="yellow")
    foreseen = all("stall_probability" in load for load in document["loads"])
    if foreseen:
        table.add_column("stall\npred.\n[%]", justify="right", style="cyan")
    table.add_column("trans-\nport\n[s]", justify="right")

    def cells(record: Mapping[str, Any], transport: Mapping[str, float]) -> list[str]:
        row = []
        for q, (_, _, digits) in QUANTITIES.items():
            for part in ("predicted", "simulated") if predicted else ("simulated",):
                row.append(f"{record[part][q]:.{digits}f}")
        if foreseen:
            likely = record.get("stall_probability")
            row.append("" if likely is None else f"{100.0 * likely:.0f}")
        return [*row, f"{transport['time']:.1f}"]

    for n, load in enumerate(document["loads"], start=1):
        heading = round(math.degrees(load["heading"]))
        place = (*(f"{v:.2f}" for v in frame.scan(load["x"], load["y"])), f"{heading}")
        last = n == len(document["loads"])
        table.add_row(str(n), *place, *cells(load, load["transport"]), end_section=last)
    table.add_row("sum", "", "", "", *cells(total, total["transport"]), style="bold")
    print_table(table)

    print_bold(_job(headline(document)))
    for line in trucks_said(document):
        say(line)
    for q, (title, unit, _) in QUANTITIES.items():
        simulated = total["simulated"][q]
        if predicted and simulated:
            off = 100.0 * (predicted[q] / simulated - 1.0)
            say(
                f"{title}: predicted {predicted[q]:.1f} {unit}, simulated {simulated:.1f} {unit}, "
                f"difference {off:+.1f} %"
            )
    for who, stand in stands_of(document):
        where, into = frame.place(stand["x"], stand["y"]), math.degrees(stand["heading"])
        say(f"{who}: the loader dumps at {where}, heading {into:.0f}°")
    costs = [f"{part} {total[part]['cost']:.3f}" for part in total if "cost" in total[part]]
    say(f"cost for {document['objective']}: {', '.join(costs)}")
    lost = ledger["volume_before"] - ledger["volume_after"]
    say(
        f"ledger: {ledger['volume_before']:.2f} m³ before, {ledger['volume_after']:.2f} m³ after; "
        f"{lost:.3f} m³ at {ledger['density']:.3f} t/m³ for {ledger['mass_removed']:.3f} t loaded"
    )
    solves = ledger.get("solves")
    if solves:
        say(
            f"avalanches: at most {solves['most_rounds']} rounds, steepest slope left "
            f"{solves['steepest_slope_deg']:.1f}°"
        )


def _job(job: Mapping[str, float]) -> str:
    """All that is loaded, how long that takes, and what of that is what."""
    minutes, seconds = divmod(round(job["time"]), 60)
    waiting = f", waiting {job['waiting']:.0f} s" if job["waiting"] else ""
    return (
        f"{job['mass']:.1f} t in {minutes} min {seconds:02d} s, {job['rate']:.0f} t/h: digging "
        f"{job['digging']:.0f} s, driving {job['driving']:.0f} s, dumping {job['dumping']:.0f} s"
        f"{waiting}; {job['energy']:.1f} MJ, about {job['fuel']:.1f} l of diesel"
    )
