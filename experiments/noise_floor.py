"""How well any predictor could do: what loadings differ by that look the same to it.

The simulator is deterministic, so a predictor that sees everything has no floor but rounding. What
ours see is less, and each kind of repeat plays held-out loadings again on surfaces that one of them
cannot, or need not, tell apart:

* "rounding": heights changed by a micrometre, which tells how far the outcome follows from them;
* "1 mm" and "1 cm": unseen roughness, independent from cell to cell; a scan is no better than 1 cm;
* "around the map": the surface outside the 36 x 36 map of ψ_high raised and lowered smoothly by
  0.1 m, the map itself as it is;
* "same characteristics": the same action on surfaces of other rollouts with nearly the same four
  characteristics, which is all that ψ_low sees. What the small differences that remain do, by
  ψ_low, is divided out.

The floor of a kind is the mean relative error of the best constant for each loading: for its
repeats y_r the mean over all loadings of min_c mean_r |y_r - c| / y_r, times sqrt(R / (R - 1)),
since c is chosen from the same R repeats.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from experiments._common.models import (
    PREDICTORS,
    PRETRAINED,
    load_or_train,
    load_pretrained,
    smoke_settings,
)
from experiments._common.resimulation import initial_surfaces, resimulate
from experiments._common.results import dataset_summary, main
from wlplan.constants import CELL_SIZE, J_PER_KJ, KG_PER_TONNE, QUANTITIES
from wlplan.dataset import LOADS, Dataset, split
from wlplan.engines.simulator import dig
from wlplan.io import write_bytes_atomic
from wlplan.models.ensemble import Ensemble
from wlplan.models.performance import PerformanceModel
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, ORANGE, PALE, new_figure, tidy
from wlplan.terrain.heightmap import PERFORMANCE_CELLS, STATE_CELLS, STATE_DISPLACEMENT
from wlplan.training.evaluation import predict
from wlplan.types import Action

SEED = 11
CYCLES, REPEATS = 250, 12
NAMES = tuple(QUANTITIES)
MODELS = ("psi_low, swish", "psi_high, swish")
SHAPE = (STATE_CELLS, STATE_CELLS)
# More neighbours than these are not looked at in vain: some cycles are not valid.
INVALID = 30
# Kinds that are floors of one of the models, by what it does not see.
COMPARED = ("around the map", "same characteristics")
# Below this height over the floor a change fades out: level ground stays level [m].
FADE = 0.1
# Smooth change around the map: its spread and length, and the width of the transition [m].
AROUND, AROUND_LENGTH, TRANSITION = 0.1, 0.5, 0.4


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Simulates the repeats, and sets the errors of the models on the same loadings beside."""
    smoke = preset == "smoke"
    cycles, repeats = (6, 3) if smoke else (CYCLES, REPEATS)
    test = split(data)[2]
    test = test.select(test.valid & (test.mass > 0.0))
    random = np.random.default_rng(SEED)
    chosen = test.select(np.sort(random.permutation(len(test))[:cycles]))
    predictors = {
        title: load_or_train(
            models, data, smoke_settings(PREDICTORS[title]) if smoke else PREDICTORS[title]
        )[0]
        for title in MODELS
    }
    predictors |= {title: load_pretrained(kind)[0] for title, kind in PRETRAINED.items()}
    truth = np.stack([getattr(chosen, name) for name in NAMES], axis=1).astype(np.float64)
    others = _alike(chosen, data, repeats)
    variants = {
        kind: change(initial_surfaces(chosen), repeats, random) for kind, change in CHANGES.items()
    }
    variants["same characteristics"] = initial_surfaces(others).reshape(cycles, repeats, *SHAPE)
    variants["again"] = initial_surfaces(chosen)[:, None]
    simulated = _simulate(variants, chosen.action)
    again = simulated.pop("again")[:, 0]
    simulated["same characteristics"] *= _excess(predictors["psi_low, swish"], chosen, others)
    floors = {kind: floor(values) for kind, values in simulated.items()}
    errors = {}
    for title, model in predictors.items():
        predicted = predict(model, chosen)
        guess = np.stack([np.asarray(getattr(predicted, name)) for name in NAMES], axis=1)
        errors[title] = (np.abs(guess - truth) / truth).mean(axis=0)
    return {
        "data": dataset_summary(data),
        "cycles": cycles,
        "repeats": repeats,
        "largest_change_when_played_again": _named(np.abs(again / truth - 1.0).max(axis=0)),
        "floor": {kind: _named(values) for kind, values in floors.items()},
        "median_deviation": {
            kind: _named(np.median(_deviations(values), axis=0))
            for kind, values in simulated.items()
        },
        "error": {title: _named(values) for title, values in errors.items()},
        "error_over_floor": {
            title: {kind: _named(values / floors[kind]) for kind in COMPARED}
            for title, values in errors.items()
        },
    }


def _named(values: Float[np.ndarray, "3"]) -> dict[str, float]:
    return dict(zip(NAMES, (float(value) for value in values), strict=True))


def _deviations(repeats: Float[np.ndarray, "n r 3"]) -> Float[np.ndarray, "n 3"]:
    """Mean relative error of the best constant for each loading."""
    # The error is linear between the repeats, so one of them is best.
    found, constant = repeats[:, :, None], repeats[:, None]
    relative = np.abs(found - constant) / np.maximum(found, 1e-3)
    count = repeats.shape[1]
    deviations: np.ndarray = relative.mean(axis=1).min(axis=1) * np.sqrt(count / (count - 1.0))
    return deviations


def floor(repeats: Float[np.ndarray, "n r 3"]) -> Float[np.ndarray, "3"]:
    """The floor as defined above, of positive outcomes.

    Args:
        repeats: Mass, time and work of R repeats of each of n loadings.
    """
    mean: np.ndarray = _deviations(repeats).mean(axis=0)
    return mean


def _simulate(
    variants: dict[str, Float[np.ndarray, "n r 52 52"]], action: Float[np.ndarray, "n 4"]
) -> dict[str, Float[np.ndarray, "n r 3"]]:
    """Mass, time and work of loadings on several surfaces each, of several kinds."""

    def outcomes(height: Array, ground: Array, action: Action) -> tuple[Array, ...]:
        cycle = dig(height, ground, action)
        work = cycle.work_drive + cycle.work_boom + cycle.work_bucket + cycle.work_slip
        return cycle.mass / KG_PER_TONNE, cycle.time, work / J_PER_KJ

    # All at once, so that it is compiled once.
    rows = np.concatenate([v.reshape(-1, *SHAPE).astype(np.float32) for v in variants.values()])
    actions = np.concatenate([np.repeat(action, v.shape[1], axis=0) for v in variants.values()])
    values = np.stack(resimulate(outcomes, rows, actions), axis=-1).astype(np.float64)
    ends = np.cumsum([v.shape[0] * v.shape[1] for v in variants.values()])[:-1]
    return {
        kind: part.reshape(*variants[kind].shape[:2], 3)
        for kind, part in zip(variants, np.split(values, ends), strict=True)
    }


def _alike(chosen: Dataset, data: Dataset, repeats: int) -> Dataset:
    """For each loading those nearest to it in characteristics, of other rollouts; n times R."""
    spread = data.characteristics.std(axis=0)
    tree = cKDTree(data.characteristics / spread)
    # Loadings of one rollout dig one pile: enough are asked for to leave all of them out.
    count = min(repeats + LOADS + INVALID, len(data))
    _, near = tree.query(chosen.characteristics / spread, k=count)
    which = [
        [n for n in row if data.valid[n] and data.rollout[n] != own][:repeats]
        for row, own in zip(near, chosen.rollout, strict=True)
    ]
    return data.select(np.array(which).reshape(-1))


def _excess(model: PerformanceModel | Ensemble, chosen: Dataset, others: Dataset) -> np.ndarray:
    """What the characteristics of others make of the outcome by ψ_low, inverted; [n, R, 3]."""
    repeats = len(others) // len(chosen)
    action = np.repeat(chosen.action, repeats, axis=0)

    def expected(characteristics: np.ndarray) -> np.ndarray:
        table = dataclasses.replace(others, characteristics=characteristics, action=action)
        predicted = predict(model, table)
        return np.stack([np.asarray(getattr(predicted, name), np.float64) for name in NAMES], -1)

    own = expected(np.repeat(chosen.characteristics, repeats, axis=0))
    ratio: np.ndarray = own / expected(others.characteristics)
    return ratio.reshape(len(chosen), repeats, 3)


def _faded(surface: np.ndarray, repeats: int, change: np.ndarray) -> np.ndarray:
    """Several surfaces for each one: changes that fade out towards the floor."""
    many = np.broadcast_to(surface[:, None], (len(surface), repeats, *surface.shape[1:]))
    faded: np.ndarray = many + np.clip(many / FADE, 0.0, 1.0) * change
    return faded


def _rough(size: float) -> Callable[[np.ndarray, int, np.random.Generator], np.ndarray]:
    def change(surface: np.ndarray, repeats: int, random: np.random.Generator) -> np.ndarray:
        shape = (len(surface), repeats, *SHAPE)
        return _faded(surface, repeats, random.normal(0.0, size, shape))

    return change


def around(surface: np.ndarray, repeats: int, random: np.random.Generator) -> np.ndarray:
    """Surfaces that differ outside the map of ψ_high only; [n, 52, 52] to [n, repeats, 52, 52]."""
    noise = random.normal(size=(len(surface), repeats, *SHAPE))
    sigma = AROUND_LENGTH / CELL_SIZE
    noise = ndimage.gaussian_filter(noise, (0.0, 0.0, sigma, sigma))
    inside = np.zeros(SHAPE, bool)
    ahead = round(STATE_DISPLACEMENT / CELL_SIZE)
    aside = (STATE_CELLS - PERFORMANCE_CELLS) // 2
    inside[ahead : ahead + PERFORMANCE_CELLS, aside : aside + PERFORMANCE_CELLS] = True
    distance = ndimage.distance_transform_edt(~inside) * CELL_SIZE
    weight = np.clip(distance / TRANSITION, 0.0, 1.0)
    return _faded(surface, repeats, AROUND * weight * noise / noise.std())


CHANGES = {
    "rounding": _rough(1e-6),
    "1 mm": _rough(1e-3),
    "1 cm": _rough(1e-2),
    "around the map": around,
}


def draw(folder: Path) -> None:
    """Floors as bars, errors of the models as lines."""
    result = json.loads((folder / "noise_floor.json").read_text())
    figure = new_figure(9.0, 2.7)
    panels = figure.subplots(1, 3, sharey=True)
    kinds = list(result["floor"])
    for panel, quantity in zip(panels, NAMES, strict=True):
        values = [100.0 * result["floor"][kind][quantity] for kind in kinds]
        bars = panel.barh(range(len(kinds)), values, color=PALE, height=0.6)
        panel.bar_label(bars, fmt="%.2g", padding=2, fontsize=7, color=FAINT)
        for title, errors in result["error"].items():
            colour = BLUE if "low" in title else ORANGE
            style = "-" if "ships" in title else ":"
            label = f"error of {title.replace('psi', 'ψ')}"
            panel.axvline(100.0 * errors[quantity], color=colour, ls=style, lw=1.4, label=label)
        panel.set_yticks(range(len(kinds)), kinds, fontsize=8)
        panel.set_title(f"{quantity}: mean relative deviation [%]", fontsize=8)
        panel.set_xlim(left=0.0)
        tidy(panel)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    write_bytes_atomic(folder / "noise_floor.png", png_bytes(figure))


if __name__ == "__main__":
    main("noise_floor", run, draw)
