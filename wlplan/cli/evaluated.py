"""What `wlplan evaluate` reports: errors and times of a predictor, and the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from wlplan.cli.outputs import print_table, titled_table
from wlplan.published import PERFORMANCE, PILE_STATE


def evaluated(model: Any, part: Any, description: Mapping[str, Any]) -> dict[str, Any]:
    """Errors, inference times and the paper's figures of a model, as JSON has them.

    Args:
        model: Predictor of any kind.
        part: Data set of the cycles that it is compared with.
        description: Description of the model, see `wlplan.training.read_description`.
    """
    from wlplan.bench.inference import inference_times
    from wlplan.training import evaluate_performance, evaluate_pile_state

    kind = description["kind"]
    times = [time.as_dict() for time in inference_times(model, part)]
    if kind in ("phi", "phi_vae"):
        errors = evaluate_pile_state(model, part).as_dict()
        # Ours has no post-processing to leave out.
        if kind == "phi_vae":
            errors["without_blending"] = evaluate_pile_state(model, part, blend=False).as_dict()
        blended, plain = PILE_STATE[True], PILE_STATE[False]
        paper: dict[str, Any] = {
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
        errors = evaluate_performance(model, part).as_dict()
        result = PERFORMANCE[kind, description["architecture"]["activation"]]
        paper = {
            "mean_relative": {name: getattr(result, name) for name in ("mass", "time", "work")},
            "inference_s": result.inference,
        }
    return {"errors": errors, "inference": times, "paper": paper}


def print_times(times: Sequence[Mapping[str, Any]], paper: float) -> None:
    """Times of one inference and of a batch beside the paper's time of one [s]."""
    table = titled_table("inference, wall-clock time; compiling apart")
    for column in ("", "median", "10 to 90 %", "each input", "compiling"):
        table.add_column(column, justify="left" if not column else "right")
    for record in times:
        call, inputs = record["call_s"], record["inputs"]
        table.add_row(
            "one input" if inputs == 1 else f"{inputs} inputs in one call",
            f"{1e3 * call['median']:.3f} ms",
            f"{1e3 * call['low']:.3f} to {1e3 * call['high']:.3f} ms",
            f"{1e3 * record['each_s']:.4f} ms",
            f"{record['compile_s']:.1f} s",
        )
    table.add_row("paper, one input", f"{1e3 * paper:.2f} ms", "", "", "")
    print_table(table)
