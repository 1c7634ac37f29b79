"""What `wlplan evaluate` reports: errors and times of a predictor, and the paper's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from wlplan.cli.outputs import print_table, titled_table
from wlplan.constants import QUANTITIES
from wlplan.studies.paper import PERFORMANCE, PILE_STATE


def evaluated(model: Any, part: Any, description: Mapping[str, Any]) -> dict[str, Any]:
    """Errors, inference times and the paper's figures of a model, as JSON has them.

    Args:
        model: Predictor of any kind.
        part: Data set of the cycles that it is compared with.
        description: Description of the model, see `wlplan.models.storage.read_description`.
    """
    from wlplan.studies.bench.inference import performance_times, pile_state_times
    from wlplan.training import evaluate_performance, evaluate_pile_state, evaluate_stalls

    kind = description["kind"]
    paper: dict[str, Any]
    if kind == "stall":
        times = performance_times(model, part)
        # The paper has no such predictor.
        errors, paper = evaluate_stalls(model, part).as_dict(), {}
    elif kind in ("phi", "phi_vae"):
        times = pile_state_times(model, part)
        errors = evaluate_pile_state(model, part).as_dict()
        # Ours has no post-processing to leave out.
        if kind == "phi_vae":
            plainly = model.replace(blend=False)
            errors["without_blending"] = evaluate_pile_state(plainly, part).as_dict()
        blended, plain = PILE_STATE[True], PILE_STATE[False]
        paper = {
            "mean_absolute": blended.mean_absolute,
            "mean_relative": blended.mean_relative,
            "inference_s": blended.inference,
            "without_blending": {
                "mean_absolute": plain.mean_absolute,
                "mean_relative": plain.mean_relative,
                "inference_s": plain.inference,
            },
        }
    else:
        times = performance_times(model, part)
        errors = evaluate_performance(model, part).as_dict()
        result = PERFORMANCE[kind, description["architecture"]["activation"]]
        paper = {
            "mean_relative": {name: getattr(result, name) for name in ("mass", "time", "work")},
            "inference_s": result.inference,
        }
    return {"errors": errors, "inference": [time.as_dict() for time in times], "paper": paper}


def print_times(times: Sequence[Mapping[str, Any]], paper: float | None) -> None:
    """Times of one inference and of a batch beside the paper's time of one [s], if it has one."""
    table = titled_table("inference, wall-clock time; compiling apart")
    for column in ("", "median", "10 to 90 %", "each input", "compiling"):
        table.add_column(column, justify="left" if not column else "right")
    for record in times:
        call, inputs = record["call_s"], record["inputs"]
        what = "one input" if inputs == 1 else f"{inputs} inputs in one call"
        table.add_row(
            f"{what}, with the deviation" if record["deviation"] else what,
            f"{1e3 * call['median']:.3f} ms",
            f"{1e3 * call['low']:.3f} to {1e3 * call['high']:.3f} ms",
            f"{1e3 * record['each_s']:.4f} ms",
            f"{record['compile_s']:.1f} s",
        )
    if paper is not None:
        table.add_row("paper, one input", f"{1e3 * paper:.2f} ms", "", "", "")
    print_table(table)


def print_pile_state(title: str, rows: Sequence[tuple[str, Mapping[str, Any]]]) -> None:
    """Errors of a pile state predictor, beside the paper's on the paper's data."""
    table = titled_table(title)
    for column in ("", "cycles", "misplaced volume", "relative to the pile", "volume removed"):
        table.add_column(column, justify="left" if not column else "right")
    for name, errors in rows:
        table.add_row(
            name,
            str(errors["cycles"]),
            f"{errors['mean_absolute']:.3f} m³",
            f"{100.0 * errors['mean_relative']:.2f} %",
            f"{100.0 * errors['total_volume']:+.2f} %",
        )
    for blend, name in ((True, "paper, edges blended"), (False, "paper, as predicted")):
        result = PILE_STATE[blend]
        relative = f"{100.0 * result.mean_relative:.2f} %"
        table.add_row(name, "", f"{result.mean_absolute:.2f} m³", relative, "")
    print_table(table)


def print_stalls(title: str, report: Mapping[str, Any]) -> None:
    """How good the probabilities of stalls are, and what of them happened."""
    table = titled_table(f"{title}: {report['cycles']} cycles, {report['stalled']} stalled")
    for column in ("", "foreseen", "a constant"):
        table.add_column(column, justify="left" if not column else "right")
    scores = {"negative_log_likelihood": "negative log likelihood", "brier": "Brier score"}
    for name, label in scores.items():
        table.add_row(label, *(f"{report[of][name]:.4f}" for of in ("score", "constant")))
    area = report["area_under_curve"]
    table.add_row("area under the curve", "–" if area is None else f"{area:.4f}", "0.5")
    error = 100.0 * report["calibration_error"]
    table.add_row("calibration error", f"{error:.2f} %", "0 %")
    print_table(table)
    table = titled_table("probabilities, and what part of the cycles stalled")
    for column in ("from", "to", "cycles", "foreseen", "stalled"):
        table.add_column(column, justify="right")
    for low, high, found in zip(report["edges"], report["edges"][1:], report["bins"], strict=False):
        if found is not None:
            parts = (low, high, found["foreseen"], found["stalled"])
            first, last, *means = (f"{100.0 * part:.2f} %" for part in parts)
            table.add_row(first, last, str(found["cycles"]), *means)
    print_table(table)


def print_errors(
    title: str, report: Mapping[str, Any], paper: Mapping[str, float] | None = None
) -> None:
    """Errors of a performance predictor, and the paper's on the paper's data."""
    table = titled_table(title)
    for column in ("", "cycles", "mass", "time", "work"):
        table.add_column(column, justify="left" if not column else "right")
    kinds: tuple[tuple[str, str, Callable[[float, str], str]], ...] = (
        ("mean_relative", "mean relative error", lambda v, unit: f"{100.0 * v:.2f} %"),
        ("mean_absolute", "mean absolute error", lambda v, unit: f"{v:.3g} {unit}"),
        ("total_relative", "error of the sum", lambda v, unit: f"{100.0 * v:+.2f} %"),
    )
    loaded = f"loads over {report['loaded_mass']:g} t"
    for name, which in (("loaded", loaded), ("every", "all valid cycles")):
        part = report[name]
        for key, label, write in kinds:
            cells = (write(part[key][q], unit) for q, (_, unit, _) in QUANTITIES.items())
            table.add_row(f"{label}, {which}", str(part["cycles"]), *cells)
    if "intervals" in report:
        inside = (report["intervals"][q]["coverage"] for q in QUANTITIES)
        table.add_row(
            "inside the interval of 90 %, all valid cycles",
            str(report["every"]["cycles"]),
            *(f"{100.0 * part:.1f} %" for part in inside),
        )
    if paper is not None:
        cells = (f"{100.0 * paper[q]:.2f} %" for q in QUANTITIES)
        table.add_row("paper: mean relative error, all cycles", "1072", *cells)
    print_table(table)
