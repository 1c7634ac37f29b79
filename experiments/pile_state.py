"""Pile state predictors on held-out cycles: the paper's, as described, and ours, on one split.

Paper, table 2 and figures 11 and 12: the volume between predicted and simulated surface, with and
without the paper's post-processing, how it is spread, and five samples. Ours is given the simulated
load, as `wlplan evaluate` does; the paper's predicts the map alone.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments._common.models import load_or_train, smoke_settings
from experiments._common.results import dataset_summary, main
from wlplan.constants import CELL_SIZE
from wlplan.dataset import Dataset, split
from wlplan.io import write_bytes_atomic
from wlplan.models.phi_vae import VaePileStateModel
from wlplan.models.storage import load_model
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, GREEN, INK, ORANGE, PALE, new_figure, tidy
from wlplan.studies.paper import PILE_STATE
from wlplan.terrain.heightmap import STATE_DISPLACEMENT
from wlplan.training import PhiSettings, PhiVaeSettings, Settings
from wlplan.training.pile_state import misplaced_volume, pile_state_errors, predict_pile_state
from wlplan.types import LocalHeightmap
from wlplan.worlds.shipped import pretrained_path

# Trainings of our φ; of the paper's, which takes a quarter of an hour, one.
SEEDS = 5
PLAIN, BLENDED = "paper's φ, as predicted", "paper's φ, edges blended"
OURS, SHIPS = "ours", "ours, as it ships"
COLOURS = {PLAIN: PALE, BLENDED: ORANGE, OURS: BLUE, SHIPS: GREEN}
# Samples of small, middling and large errors of the blended prediction: their places in the order.
PLACES = {"small": 0.02, "median": 0.5, "large": 0.98}
# Error of the surface from which on a sample has its full colour [m].
WRONG = 0.3


def run(preset: str, data: Dataset, models: Path) -> dict[str, Any]:
    """Trains both kinds on the same cycles and compares them on the same held-out ones."""
    smoke = preset == "smoke"
    test = split(data)[2]
    test = test.select(test.valid)

    def of(settings: Settings) -> Any:
        return load_or_train(models, data, smoke_settings(settings) if smoke else settings)[0]

    papers = of(PhiVaeSettings())
    ours = [of(PhiSettings(seed=seed)) for seed in range(1 if smoke else SEEDS)]
    ships: Any = load_model(pretrained_path("phi"), "phi")
    # By every training of each; what is drawn is of the first.
    all_predicted = {
        PLAIN: [predict_pile_state(papers.replace(blend=False), test)],
        BLENDED: [predict_pile_state(papers, test)],
        OURS: [predict_pile_state(model, test) for model in ours],
        SHIPS: [predict_pile_state(ships, test)],
    }
    errors = {
        title: [pile_state_errors(maps, test) for maps in trainings]
        for title, trainings in all_predicted.items()
    }
    predicted = {title: trainings[0] for title, trainings in all_predicted.items()}
    misplaced = {title: misplaced_volume(maps, test) for title, maps in predicted.items()}
    coded = _reconstructed(papers, test.h52)
    return {
        "data": dataset_summary(data),
        "cycles": len(test),
        "models": {
            title: {
                name: {"mean": float(np.mean(each)), "spread": float(np.std(each)), "each": each}
                for name in ("mean_absolute", "mean_relative", "total_volume")
                for each in [[getattr(training, name) for training in trainings]]
            }
            for title, trainings in errors.items()
        },
        "paper": {
            PLAIN: PILE_STATE[False]._asdict(),
            BLENDED: PILE_STATE[True]._asdict(),
        },
        # What every prediction that leaves the surface as it was misplaces; and what the code of
        # the surface before does not hold.
        "no_change_m3": float(misplaced_volume(test.h52, test).mean()),
        "not_in_the_code_m3": float(np.abs(coded - test.h52).sum(axis=(1, 2)).mean())
        * CELL_SIZE**2,
        "better_blended": float((misplaced[BLENDED] < misplaced[PLAIN]).mean()),
        "ours_better": float((misplaced[OURS] < misplaced[BLENDED]).mean()),
        "misplaced_m3": {
            title: values.astype(float).round(3).tolist() for title, values in misplaced.items()
        },
        "samples": [
            _sample(name, n, test, coded, predicted, misplaced)
            for name, n in _chosen(misplaced).items()
        ],
    }


def _reconstructed(
    model: VaePileStateModel, maps: Float[np.ndarray, "n 52 52"]
) -> Float[np.ndarray, "n 52 52"]:
    def one(height: jax.Array) -> jax.Array:
        return model.reconstruction(LocalHeightmap(height, CELL_SIZE, STATE_DISPLACEMENT))

    rows = jax.jit(lambda maps: jax.lax.map(one, maps, batch_size=64))(jnp.asarray(maps))
    return np.asarray(rows)


def _chosen(misplaced: dict[str, np.ndarray]) -> dict[str, int]:
    """The cycles that are drawn, by what they are samples of."""
    order = np.argsort(misplaced[BLENDED])
    chosen = {name: int(order[int(place * (len(order) - 1))]) for name, place in PLACES.items()}
    gain = misplaced[PLAIN] - misplaced[BLENDED]
    return chosen | {
        "blending adds most": int(np.argmin(gain)),
        "blending takes most off": int(np.argmax(gain)),
    }


def _sample(
    name: str,
    n: int,
    test: Dataset,
    coded: np.ndarray,
    predicted: dict[str, np.ndarray],
    misplaced: dict[str, np.ndarray],
) -> dict[str, Any]:
    """Maps of one cycle [cm], every other cell, and what each prediction misplaces."""

    def short(height: np.ndarray) -> list[list[int]]:
        centimetres: list[list[int]] = np.rint(100.0 * height[::2, ::2]).astype(int).tolist()
        return centimetres

    return {
        "of": name,
        "cycle": n,
        "misplaced_m3": {title: float(f"{values[n]:.3g}") for title, values in misplaced.items()},
        "before_cm": short(test.h52[n]),
        "reconstructed_cm": short(coded[n]),
        "after_cm": short(test.h52_after[n]),
        "predicted_cm": {title: short(maps[n]) for title, maps in predicted.items()},
    }


def draw(folder: Path) -> None:
    """Figure 11 as pile_state.png, figure 12 as pile_state_samples.png."""
    result = json.loads((folder / "pile_state.json").read_text())
    misplaced = {title: np.array(v) for title, v in result["misplaced_m3"].items()}
    figure = new_figure(10.5, 3.4)
    spread, pairs, both = figure.subplots(1, 3)
    most = float(np.percentile(misplaced[PLAIN], 99.0))
    for title, values in misplaced.items():
        spread.hist(
            np.clip(values, 0.0, most),
            bins=np.linspace(0.0, most, 50),
            histtype="stepfilled" if title == PLAIN else "step",
            color=COLOURS[title],
            lw=1.4,
            label=f"{title}, mean {values.mean():.2f} m³",
        )
    spread.set_xlabel("misplaced volume [m³]; last bin: all above", fontsize=8)
    spread.set_ylabel("held-out cycles", fontsize=8)
    spread.set_ylim(top=1.45 * spread.get_ylim()[1])
    spread.legend(fontsize=7, frameon=False, loc="upper right")
    for panel, across, up in ((pairs, PLAIN, BLENDED), (both, BLENDED, OURS)):
        # What lies beyond lies on the edge.
        points = [np.minimum(misplaced[title], most) for title in (across, up)]
        panel.plot(*points, ".", ms=2.5, alpha=0.5, color=COLOURS[up], clip_on=False)
        panel.plot([0.0, most], [0.0, most], color=FAINT, lw=0.8)
        panel.set_xlim(0.0, most)
        panel.set_ylim(0.0, most)
        panel.set_aspect("equal")
        panel.set_xlabel(f"{across} [m³]", fontsize=8)
        panel.set_ylabel(f"{up} [m³]", fontsize=8)
    for number, sample in enumerate(result["samples"]):
        at = [np.clip(sample["misplaced_m3"][title], 0.0, most) for title in (PLAIN, BLENDED)]
        pairs.plot(*at, "D", ms=5, mfc="white", color=INK, clip_on=False)
        pairs.annotate(
            "abcde"[number], at, (6, -9 + 3 * number), textcoords="offset points", size=8
        )
    for panel in (spread, pairs, both):
        tidy(panel)
    write_bytes_atomic(folder / "pile_state.png", png_bytes(figure))
    _draw_samples(result, folder)


def _draw_samples(result: dict[str, Any], folder: Path) -> None:
    """The samples: contours of each map, and how far it is from what it ought to be."""
    columns = ("before", "before, from its code", "after", PLAIN, BLENDED, OURS)
    samples = result["samples"]
    figure = new_figure(1.75 * len(columns), 1.95 * len(samples))
    panels = figure.subplots(len(samples), len(columns), sharex=True, sharey=True, squeeze=False)
    for number, (row, sample) in enumerate(zip(panels, samples, strict=True)):
        before, after = np.array(sample["before_cm"]), np.array(sample["after_cm"])
        maps = {
            "before": (before, before),
            "before, from its code": (np.array(sample["reconstructed_cm"]), before),
            "after": (after, after),
        }
        for title in (PLAIN, BLENDED, OURS):
            maps[title] = (np.array(sample["predicted_cm"][title]), after)
        for panel, title in zip(row, columns, strict=True):
            height, wanted = (0.01 * values for values in maps[title])
            along = 2.0 * CELL_SIZE * np.arange(len(height))
            # Left of the loader is left in the picture.
            right = along.mean() - along
            image = panel.pcolormesh(
                right, along, height - wanted, cmap="RdBu_r", vmin=-WRONG, vmax=WRONG
            )
            levels = np.arange(-1.0, 4.0, 0.25)
            panel.contour(right, along, height, levels, colors=INK, linewidths=0.5)
            panel.set_aspect("equal")
            if title in sample["misplaced_m3"]:
                said = f"{sample['misplaced_m3'][title]:.2f} m³"
                panel.set_title(said if number else f"{title}\n{said}", fontsize=7)
            elif not number:
                panel.set_title(f"{title}\n", fontsize=7)
            tidy(panel, grid=False)
            panel.tick_params(labelsize=6)
        row[0].set_ylabel(f"({'abcde'[number]}) {sample['of']}\nahead [m]", fontsize=7)
    for panel in panels[-1]:
        panel.set_xlabel("to the right [m]", fontsize=7)
    bar = figure.colorbar(image, ax=panels.ravel().tolist(), shrink=0.4, pad=0.01)
    bar.set_label("surface over what it ought to be [m]", fontsize=7)
    bar.ax.tick_params(labelsize=6)
    figure.suptitle(
        "Contours every 0.25 m, over the height 1 m before the dig location; written: misplaced "
        "volume; errors of the blended prediction of φ are (a) small, (b) median, (c) large",
        fontsize=8,
        color=FAINT,
    )
    write_bytes_atomic(folder / "pile_state_samples.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("pile_state", run, draw)
