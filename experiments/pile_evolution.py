"""The pile after every five of forty loads, in the simulator and in the worlds, from aside.

Paper, figure 13: the same poses and actions in the simulator, in the high world and in the low one,
each on its own pile. The sequence is one of those of `experiments.sequential_loading`, which has
the errors of ten; the colours of the worlds say how far their surface is from the simulator's.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from experiments._common.grids import around_pile, packed, unpacked
from experiments._common.places import say
from experiments._common.results import main
from experiments.sequential_loading import SEED, load, pose_of, simulated
from wlplan.constants import CELL_SIZE
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.relief import PILE
from wlplan.report.figures.style import FAINT, INK, new_figure
from wlplan.report.figures.surface import DIFFERENCE, View, draw_surface
from wlplan.types import Pile, action_from
from wlplan.worlds.shipped import load_world

# A triangular pile of 30 degrees, the second of the sequences.
NUMBER = 1
LOADS, EVERY = 40, 5
WORLDS = ("high", "low")
TITLES = {
    "simulator": "simulator",
    "high": "high world: ψ_high, φ",
    "low": "low world: ψ_low, automaton",
}
# Every so manieth grid point is kept: 0.2 m. Ground around the pile [cells].
_THIN, _MARGIN = 2, 4
# Difference of the surfaces that has its full colour, and length of an arrow [m].
_WRONG, _ARROW = 0.25, 2.0
_VIEW = View(azimuth=math.radians(65.0), elevation=math.radians(30.0))


def run(preset: str) -> dict[str, Any]:
    """Plays the sequence in the simulator and then, open loop, in the worlds."""
    loads, every = (2, 1) if preset == "smoke" else (LOADS, EVERY)
    say(f"{loads} loads in the simulator")
    sequence = simulated(NUMBER, loads)
    heights = {"simulator": np.asarray(sequence.heights, np.float64)}
    for name in WORLDS:
        say(f"{loads} loads in the {name} world")
        world = load_world(name)
        pile = Pile(jnp.asarray(sequence.heights[0]), CELL_SIZE, jnp.asarray(sequence.origin))
        found = [np.asarray(pile.height, np.float64)]
        for pose, action in zip(sequence.poses, sequence.actions, strict=True):
            pile, _ = load(world, pile, pose_of(pose), action_from(jnp.asarray(action)))
            found.append(np.asarray(pile.height, np.float64))
        heights[name] = np.stack(found)
    after = list(range(0, loads + 1, every))
    shown = np.concatenate([heights[name][after, ::_THIN, ::_THIN] for name in heights])
    part, first = around_pile(shown, _MARGIN)
    corner = np.asarray(sequence.origin) + _THIN * CELL_SIZE * np.array(first)
    area = CELL_SIZE**2
    return {
        "seed": SEED,
        "number": NUMBER,
        "after_loads": after,
        "poses": np.round(sequence.poses.astype(float), 3).tolist(),
        "volume_m3": {
            name: np.round(grids[after].sum(axis=(1, 2)) * area, 2).tolist()
            for name, grids in heights.items()
        },
        "misplaced_m3": {
            name: np.round(
                np.abs(heights[name] - heights["simulator"])[after].sum(axis=(1, 2)) * area, 2
            ).tolist()
            for name in WORLDS
        },
        "cell_size_m": _THIN * CELL_SIZE,
        "corner_m": np.round(corner.astype(float), 3).tolist(),
        "heights": {
            name: packed(grids)
            for name, grids in zip(heights, np.split(part, len(heights)), strict=True)
        },
    }


def draw(folder: Path) -> None:
    """A row for every few loads; in the columns of the worlds the colour is the difference."""
    result = json.loads((folder / "pile_evolution.json").read_text())
    heights = {name: unpacked(value) for name, value in result["heights"].items()}
    after = result["after_loads"]
    figure = new_figure(10.5, 1.6 * (len(after) - 1) + 1.0)
    panels = figure.subplots(
        len(after) - 1, len(heights), squeeze=False, gridspec_kw={"wspace": 0.0, "hspace": 0.0}
    )
    poses = np.array(result["poses"])
    height_norm = Normalize(0.0, float(heights["simulator"].max()))
    wrong_norm, wrong = Normalize(-_WRONG, _WRONG), DIFFERENCE
    for row, (panel_row, count) in enumerate(zip(panels, after[1:], strict=True), 1):
        for panel, (name, grids) in zip(panel_row, heights.items(), strict=True):
            of_simulator = name == "simulator"
            difference = None if of_simulator else grids[row] - heights["simulator"][row]
            draw_surface(
                panel,
                grids[row],
                result["cell_size_m"],
                PILE if of_simulator else wrong,
                height_norm if of_simulator else wrong_norm,
                values=difference,
                corner=tuple(result["corner_m"]),
                base=-0.3,
                view=_VIEW,
            )
            _draw_arrows(panel, poses[after[row - 1] : count], grids[row - 1], result)
            said = f"{result['volume_m3'][name][row]:.0f} m³"
            if of_simulator:
                said = f"after {count} loads\n{said}"
            else:
                said += f",\n{result['misplaced_m3'][name][row]:.1f} m³ misplaced"
            panel.text(0.02, 0.98, said, transform=panel.transAxes, size=7, color=FAINT, va="top")
            if row == 1:
                panel.set_title(TITLES[name], fontsize=9, color=INK)
    for norm, colours, label, columns in (
        (height_norm, PILE, "height above the ground [m]", panels[:, 0]),
        (wrong_norm, wrong, "surface over the simulator's [m]", panels[:, 1:].ravel()),
    ):
        bar = figure.colorbar(
            ScalarMappable(norm, colours),
            ax=columns.tolist(),
            location="bottom",
            shrink=0.7 if len(columns) == len(panels) else 0.35,
            aspect=30,
            pad=0.01,
        )
        bar.set_label(label, fontsize=7.5)
        bar.ax.tick_params(labelsize=7)
    write_bytes_atomic(folder / "pile_evolution.png", png_bytes(figure, dpi=110, rare_colours=True))


def _draw_arrows(
    panel: Axes, poses: Float[np.ndarray, "n 3"], height: np.ndarray, result: dict[str, Any]
) -> None:
    """The approaches of the loads, on the ground before the pile."""
    for x, y, heading in poses:
        tip = np.array([x, y])
        start = tip - _ARROW * np.array([math.cos(heading), math.sin(heading)])
        ends = [np.append(point, 0.05) for point in (start, tip)]
        a, b = _VIEW.project(np.stack(ends))
        panel.annotate(
            "",
            xy=(b[0], b[1]),
            xytext=(a[0], a[1]),
            arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 0.8, "mutation_scale": 6},
        )


if __name__ == "__main__":
    main("pile_evolution", run, draw)
