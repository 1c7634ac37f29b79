"""The gradient of a plan's cost against central differences, component by component, in float64."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import wlplan
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.planning.job import make_job
from wlplan.report.figures import png_bytes
from wlplan.studies.gradcheck import COMPONENTS, TOLERANCE, check_gradient, random_plan

KIND, SLOPE_DEGREES, SEED, LOADS = "conical", 30.0, 1, 5


def run(preset: str) -> dict[str, Any]:
    """Reverse mode and central differences over every pose and action component."""
    loads = 1 if preset == "smoke" else LOADS
    pile = wlplan.relax(wlplan.seed_pile(KIND, slope=math.radians(SLOPE_DEGREES), seed=SEED))
    job = make_job(wlplan.load_world("low"), pile)
    check = check_gradient(job, random_plan(pile, loads, seed=SEED))
    return {"loads": loads, **check.as_dict()}


def draw(folder: Path) -> None:
    """Relative error of every component, load by load."""
    from matplotlib.figure import Figure

    result = json.loads((folder / "gradient_check.json").read_text())
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    axis = figure.subplots()
    for name in COMPONENTS:
        rows = [row for row in result["rows"] if row["component"] == name]
        rows = [row for row in rows if row["verdict"] != "kink"]
        errors = [max(row["relative_error"], 1e-14) for row in rows]
        axis.semilogy([row["load"] for row in rows], errors, "o", ms=4, label=name)
    axis.axhline(TOLERANCE, color="#999999", lw=1, label="tolerance")
    axis.set_xticks(range(1, result["loads"] + 1))
    axis.set_xlabel("load")
    axis.set_ylabel("relative error of the gradient")
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    write_bytes_atomic(folder / "gradient_check.png", png_bytes(figure))


if __name__ == "__main__":
    main("gradient_check", run, draw)
