"""Gradients of the performance predictors: along a line of actions, and against the simulator's.

Paper, figure 19, is the line. The other comparison tells whether a gradient planner goes the right
way: on random cycles of the data set's protocol, the angle between the gradient of a model in pose
and action and central differences of the simulator.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float

from experiments._common.cycles import Cycles
from experiments._common.gradients import cosines
from experiments._common.models import (
    PREDICTORS,
    PRETRAINED,
    load_or_train,
    load_pretrained,
    smoke_settings,
)
from experiments._common.places import say
from experiments._common.results import dataset_summary, main
from experiments.simulator_gradients import (
    LINE,
    LINE_KIND,
    LINE_POINTS,
    LINE_SLOPE_DEGREES,
    LOADS,
    OUTCOMES,
    ROLLOUTS,
    SCALE,
    SEED,
    UNITS,
    in_float64,
    replayed,
    site_of_the_line,
)
from wlplan import studies
from wlplan.constants import CELL_SIZE
from wlplan.dataset import Dataset
from wlplan.io import write_bytes_atomic
from wlplan.models.ensemble import Ensemble
from wlplan.models.performance import PerformanceModel
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, INK, ORANGE, new_figure, tidy
from wlplan.terrain.heightmap import sample_local
from wlplan.types import Pile, Pose

# Parts of a gradient: the poses of the data set lie on the toe, so what the way ahead does has
# never been seen; a planner moves along the toe and turns.
PARTS = {
    "action": slice(3, 7),
    "pose": slice(0, 3),
    "ahead": slice(0, 1),
    "aside and turned": slice(1, 3),
    "all": slice(0, 7),
}
# Half the width of the simulator's central differences, in the units of a component (1 m, 0.1 rad
# and a tenth of an action's range): the derivative; 1 cm and 0.1 % of the range; 10 cm and 1 %;
# 0.5 m, 3 degrees and 5 %, about as far as a planner moves.
STEPS = {"1e-6": 1e-6, "0.01": 1e-2, "0.1": 1e-1, "0.5": 0.5}
MODELS = tuple(title for title in PREDICTORS if "of the paper" not in title)
COLOURS = {"swish": BLUE, "leaky relu": ORANGE, "as it ships": GREEN}


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Cosines between the models' gradients and the simulator's differences, and the line."""
    smoke = preset == "smoke"
    chosen = {
        title: load_or_train(
            models, data, smoke_settings(PREDICTORS[title]) if smoke else PREDICTORS[title]
        )[0]
        for title in MODELS
    }
    chosen |= {title: load_pretrained(kind)[0] for title, kind in PRETRAINED.items()}
    with jax.enable_x64(True):
        cases = in_float64(1 if smoke else ROLLOUTS, 2 if smoke else LOADS)
        differences = _differences(cases)
        rows = {
            title: _agreement(_jacobians(model, cases), differences)
            for title, model in chosen.items()
        }
        # What the best of all models would reach: the simulator's own wide differences.
        itself = {
            step: _agreement(differences[step], {"1e-6": differences["1e-6"]})["1e-6"]
            for step in STEPS
            if step != "1e-6"
        }
        return {
            "data": dataset_summary(data),
            "cycles": len(cases.height),
            "step_units": UNITS.tolist(),
            "steps": STEPS,
            "models": rows,
            "simulator_itself": itself,
            "line": _line(chosen, 5 if smoke else LINE_POINTS),
        }


def _outcome(
    model: PerformanceModel | Ensemble,
    height: Array,
    origin: Array,
    vector: Float[Array, "7"],
) -> Float[Array, "3"]:
    """Mass, time and work that a model predicts for a pose and an action."""
    local = sample_local(Pile(height, CELL_SIZE, origin), Pose(*vector[:3]))
    predicted = model(local, vector[3:])
    return jnp.stack([predicted.mass, predicted.time, predicted.work])


@jax.jit
def _jacobian(model: Any, height: Array, origin: Array, vector: Array) -> Array:
    """Derivatives [3, 7] of the outcomes by reverse mode."""
    jacobian: Array = jax.jacrev(Partial(_outcome, model, height, origin))(vector)
    return jacobian


def _jacobians(model: Any, cases: Cycles) -> Float[np.ndarray, "n 3 7"]:
    """Derivatives of a model in the units, on every case."""
    rows = [
        np.asarray(_jacobian(model, *map(jnp.asarray, case))) for case in zip(*cases, strict=True)
    ]
    return _in_its_frame(np.array(rows) * UNITS, cases.vector)


def _in_its_frame(
    tables: Float[np.ndarray, "n 3 7"], vectors: Float[np.ndarray, "n 7"]
) -> Float[np.ndarray, "n 3 7"]:
    """Derivatives by x and y turned into those by the way ahead and to the left of the pose."""
    cos, sin = np.cos(vectors[:, 2]), np.sin(vectors[:, 2])
    turn = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)
    return np.concatenate([tables[:, :, :2] @ turn, tables[:, :, 2:]], axis=2)


def _differences(
    cases: Cycles,
) -> dict[str, Float[np.ndarray, "n 3 7"]]:
    """Central differences of the simulator in the units, by name of the step."""
    widths = np.array(list(STEPS.values()))
    shifts = np.concatenate([sign * w * np.diag(UNITS) for w in widths for sign in (1, -1)])
    tables = []
    for n, (height, origin, vector) in enumerate(zip(*cases, strict=True), 1):
        values = replayed(height, origin, vector + shifts)[0].T
        ahead, behind = np.moveaxis(values.reshape(3, len(widths), 2, 7), 2, 0)
        tables.append((ahead - behind) / (2.0 * widths[:, None]))
        if n % 20 == 0:
            say(f"{n} of {len(cases.height)} cycles")
    by_step = np.moveaxis(np.array(tables), 2, 0)
    return {
        name: _in_its_frame(table, cases.vector) for name, table in zip(STEPS, by_step, strict=True)
    }


def _agreement(
    gradients: Float[np.ndarray, "n 3 7"], differences: dict[str, Float[np.ndarray, "n 3 7"]]
) -> dict[str, Any]:
    """Cosines between a model's gradients and the differences, by step, outcome and part."""
    return {
        step: {
            outcome: {
                part: summary(gradients[:, k, which], table[:, k, which])
                for part, which in PARTS.items()
            }
            for k, outcome in enumerate(OUTCOMES)
        }
        for step, table in differences.items()
    }


def summary(
    gradients: Float[np.ndarray, "n k"], differences: Float[np.ndarray, "n k"]
) -> dict[str, Any]:
    """Median and 10th percentile of the cosines, and the share of those above 0, see `cosines`."""
    found, lengths = cosines(gradients, differences)
    low, middle = np.percentile(found, [10.0, 50.0])
    return {
        "cycles": len(found),
        "median": float(middle),
        "p10": float(low),
        "positive": float((found > 0.0).mean()),
        "median_length_ratio": float(np.median(lengths)),
    }


def _line(models: dict[str, Any], points: int) -> dict[str, Any]:
    """Values and derivatives along the line of actions at one pose: models and simulator."""
    pile, pose = site_of_the_line()
    place = np.linspace(0.0, 1.0, points)
    actions = LINE[0] + place[:, None] * (LINE[1] - LINE[0])
    vectors = np.concatenate([np.tile(pose, (points, 1)), actions], axis=1)
    height, origin = (np.asarray(part, np.float64) for part in (pile.height, pile.origin))
    ranges = np.array(list(SCALE.values()))
    low, span = ranges[:, 0], ranges[:, 1] - ranges[:, 0]

    def scaled(values: np.ndarray, slopes: np.ndarray) -> dict[str, Any]:
        return {
            outcome: {
                "value": [float(f"{v:.5g}") for v in ((values - low) / span)[:, k]],
                "derivative": [float(f"{v:.5g}") for v in (slopes / span)[:, k]],
            }
            for k, outcome in enumerate(OUTCOMES)
        }

    curves = {}
    for title, model in models.items():
        function = Partial(_outcome, model, height, origin)
        found = studies.line(function, vectors[0], vectors[-1] - vectors[0], place)
        curves[title] = scaled(np.asarray(found.value), np.asarray(found.derivative))
    values, _ = replayed(height, origin, vectors)
    curves["simulator"] = scaled(values, np.gradient(values, place, axis=0))
    return {
        "pile": {"kind": LINE_KIND, "slope_degrees": LINE_SLOPE_DEGREES, "seed": SEED},
        "pose": pose.tolist(),
        "from": LINE[0].tolist(),
        "to": LINE[1].tolist(),
        "scaled_to": SCALE,
        "place": place.round(6).tolist(),
        "curves": curves,
    }


def draw(folder: Path) -> None:
    """Values and derivatives along the line, of ψ_low and ψ_high in either activation."""
    result = json.loads((folder / "model_gradients.json").read_text())
    line = result["line"]
    kinds = ("psi_low", "psi_high")
    figure = new_figure(11.0, 2.6 * 2 * len(kinds))
    rows = figure.subplots(2 * len(kinds), len(OUTCOMES), sharex=True)
    for k, kind in enumerate(kinds):
        for what, row in zip(("value", "derivative"), rows[2 * k : 2 * k + 2], strict=True):
            for panel, outcome in zip(row, OUTCOMES, strict=True):
                truth = line["curves"]["simulator"][outcome][what]
                panel.plot(line["place"], truth, color=FAINT, lw=0.9, label="simulator")
                shown = []
                for activation, colour in COLOURS.items():
                    curve = line["curves"][f"{kind}, {activation}"][outcome][what]
                    shown.append(curve)
                    panel.plot(line["place"], curve, lw=1.3, color=colour, label=activation)
                if what == "derivative":
                    # The simulator's jumps would make all else flat.
                    low, high = np.min(shown), np.max(shown)
                    panel.set_ylim(low - 0.4 * (high - low), high + 0.4 * (high - low))
                    panel.axhline(0.0, color=INK, lw=0.5)
                tidy(panel)
            row[0].set_ylabel(f"{kind.replace('psi', 'ψ')}: {what}", fontsize=8)
    for panel, outcome in zip(rows[0], OUTCOMES, strict=True):
        panel.set_title(f"{outcome}, scaled to the paper's range", fontsize=9)
    for panel in rows[-1]:
        panel.set_xlabel("s, from a$_0$ to a$_1$", fontsize=8)
    rows[0, 0].legend(fontsize=7, frameon=False)
    write_bytes_atomic(folder / "model_gradients.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("model_gradients", run, draw)
