"""Pile state predictors on held-out cycles: the paper's, as described, and ours, on one split.

Paper, table 2 and figures 5, 11 and 12: the volume between predicted and simulated surface, with
and without the paper's post-processing, how it is spread, and five samples. Ours is given the
simulated load, as `wlplan evaluate` does; the paper's predicts the map alone.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from experiments._common.models import load_or_train, smoke_settings
from experiments._common.results import dataset_summary, main
from wlplan.constants import CELL_SIZE
from wlplan.dataset import Dataset, split
from wlplan.io import write_bytes_atomic
from wlplan.models.phi_vae import VaePileStateModel, blended
from wlplan.models.storage import load_model
from wlplan.report.figures import png_bytes
from wlplan.report.figures.relief import PILE
from wlplan.report.figures.style import BLUE, FAINT, GREEN, INK, ORANGE, PALE, new_figure, tidy
from wlplan.report.figures.surface import DIFFERENCE, FROM_BEHIND, draw_surface
from wlplan.studies.paper import PILE_STATE
from wlplan.terrain.heightmap import STATE_CELLS, STATE_DISPLACEMENT
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
    """Figures 11 and 5 as pile_state.png and post_processing.png, 12 as pile_state_samples*.png."""
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
    _draw_samples_aside(result, folder)
    _draw_post_processing(result["samples"], folder)


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


def _draw_samples_aside(result: dict[str, Any], folder: Path) -> None:
    """The samples as surfaces; those that are predicted in the colours of their errors."""
    columns = ("before", "before, from its code", "after", PLAIN, BLENDED, OURS)
    samples = result["samples"]
    figure = new_figure(1.9 * len(columns), 1.5 * len(samples) + 0.6)
    panels = figure.subplots(
        len(samples), len(columns), squeeze=False, gridspec_kw={"wspace": 0.0, "hspace": 0.02}
    )
    wrong = Normalize(-WRONG, WRONG)
    for number, (row, sample) in enumerate(zip(panels, samples, strict=True)):
        before, after, coded = (
            0.01 * np.array(sample[name]) for name in ("before_cm", "after_cm", "reconstructed_cm")
        )
        heights = Normalize(float(before.min()), float(before.max()))
        shown: dict[str, tuple[np.ndarray, np.ndarray | None]] = {
            "before": (before, None),
            "before, from its code": (coded, coded - before),
            "after": (after, None),
        }
        for title in (PLAIN, BLENDED, OURS):
            predicted = 0.01 * np.array(sample["predicted_cm"][title])
            shown[title] = (predicted, predicted - after)
        for panel, title in zip(row, columns, strict=True):
            height, error = shown[title]
            draw_surface(
                panel,
                height,
                2.0 * CELL_SIZE,
                PILE if error is None else DIFFERENCE,
                heights if error is None else wrong,
                values=error,
                base=float(before.min()) - 0.2,
                view=FROM_BEHIND,
            )
            said = "" if number else title
            if title in sample["misplaced_m3"]:
                said += f"\n{sample['misplaced_m3'][title]:.2f} m³"
            panel.set_title(said, fontsize=7, color=INK, y=0.92)
        row[0].text(
            *(0.0, 0.95, f"({'abcde'[number]}) {sample['of']}"),
            transform=row[0].transAxes,
            fontsize=7,
            color=INK,
        )
    bar = figure.colorbar(
        ScalarMappable(wrong, DIFFERENCE), ax=panels.ravel().tolist(), shrink=0.4, pad=0.01
    )
    bar.set_label("surface over what it ought to be [m]", fontsize=7)
    bar.ax.tick_params(labelsize=6)
    content = png_bytes(figure, dpi=110, rare_colours=True)
    write_bytes_atomic(folder / "pile_state_samples_aside.png", content)


def _draw_post_processing(samples: list[dict[str, Any]], folder: Path) -> None:
    """The paper's post-processing on the sample that it helps most: what is mixed, and how.

    Each map is coloured by height; it was dug from the left.
    """
    gains = [one["misplaced_m3"][PLAIN] - one["misplaced_m3"][BLENDED] for one in samples]
    sample = samples[int(np.argmax(gains))]
    heights = {
        "before, h": sample["before_cm"],
        "φ, as predicted": sample["predicted_cm"][PLAIN],
        "weight × predicted + rest × h": sample["predicted_cm"][BLENDED],
        "simulated": sample["after_cm"],
    }
    heights = {title: 0.01 * np.array(values) for title, values in heights.items()}
    everything = np.concatenate([values.ravel() for values in heights.values()])
    limits = {"vmin": float(everything.min()), "vmax": float(everything.max())}
    weight = np.asarray(blended(jnp.ones((STATE_CELLS, STATE_CELLS))))
    figure = new_figure(11.0, 2.6)
    panels = figure.subplots(1, 5, sharex=True, sharey=True)
    half = 0.5 * CELL_SIZE * STATE_CELLS

    def show(panel: Axes, title: str, values: np.ndarray, **colours: Any) -> Any:
        # Rows run ahead, which is to the right; columns to the left of the loader, which is up.
        where = (-STATE_DISPLACEMENT, 2.0 * half - STATE_DISPLACEMENT, -half, half)
        image = panel.imshow(values.T, origin="lower", extent=where, **colours)
        panel.set_title(title, fontsize=8, color=INK)
        panel.set_xlabel("ahead [m]", fontsize=7)
        tidy(panel, grid=False)
        panel.tick_params(labelsize=6)
        return image

    places = (panels[0], panels[1], panels[3], panels[4])
    images = [
        show(panel, title, values, cmap=PILE, **limits)
        for panel, (title, values) in zip(places, heights.items(), strict=True)
    ]
    mask = show(panels[2], "weight of the prediction", weight, cmap="gray", vmin=0.0, vmax=1.0)
    for panel, title in ((panels[1], PLAIN), (panels[3], BLENDED)):
        panel.set_xlabel(
            f"ahead [m]\nmisplaced: {sample['misplaced_m3'][title]:.2f} m³", fontsize=7
        )
    panels[0].set_ylabel("to the left [m]", fontsize=7)
    for image, label, panel in (
        (mask, "weight [1]", panels[2]),
        (images[-1], "height [m]", panels[4]),
    ):
        bar = figure.colorbar(image, ax=panel, shrink=0.8, pad=0.02)
        bar.set_label(label, fontsize=6)
        bar.ax.tick_params(labelsize=6)
    write_bytes_atomic(folder / "post_processing.png", png_bytes(figure, dpi=110))


if __name__ == "__main__":
    main("pile_state", run, draw)
