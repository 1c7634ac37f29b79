"""The diggability map of the paper: one fixed action at 150 places around the bundled pile.

Paper, figure 15: mass, time and work that ψ_high predicts of the action of the paper's map along
the inward normals. Each place is also played in the simulator, which tells how good the map is.
`experiments.diggability` has what the best heading and action of each place would add.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from wlplan.constants import QUANTITIES
from wlplan.io import bundled_pile_path, write_bytes_atomic
from wlplan.report.figures import diggability_figure, png_bytes
from wlplan.studies.diggability import PAPER_ACTION, DiggabilityMap, diggability_map
from wlplan.types import Performance, Pose
from wlplan.worlds.shipped import load_world

LOCATIONS, FEW = 150, 6
# A loading that takes longer counts as stalled [s].
STALL = 15.0


def run(preset: str) -> dict[str, Any]:
    """The map in the high world, and the same loads in the simulator."""
    pile = wlplan.read_pile(bundled_pile_path())
    locations = FEW if preset == "smoke" else LOCATIONS
    say(f"{locations} locations in the high world")
    found = diggability_map(load_world("high"), pile, locations=locations)
    say(f"{locations} locations in the simulator")
    played = diggability_map(load_world("simulator"), pile, locations=locations).performance
    foreseen = found.performance
    return {
        "action": {name: float(value) for name, value in dataclasses.asdict(PAPER_ACTION).items()},
        "locations": locations,
        "pose": _columns(found.pose, 4),
        "foreseen": _columns(foreseen, 3),
        "played": _columns(played, 3),
        "summary": {name: _summary(foreseen, played, name) for name in QUANTITIES},
        "stalls_played": int((np.asarray(played.time) > STALL).sum()),
        "stalls_foreseen": int((np.asarray(foreseen.time) > STALL).sum()),
    }


def _columns(part: Any, digits: int) -> dict[str, list[float]]:
    return {
        field.name: np.round(np.asarray(getattr(part, field.name), float), digits).tolist()
        for field in dataclasses.fields(part)
    }


def _summary(foreseen: Performance, played: Performance, name: str) -> dict[str, float]:
    """One quantity over the places, and how well it is foreseen."""
    guessed, true = (np.asarray(getattr(part, name), float) for part in (foreseen, played))
    error = np.abs(guessed / true - 1.0)
    ranks = np.stack([np.argsort(np.argsort(values)) for values in (guessed, true)]).astype(float)
    numbers = {
        "least": guessed.min(),
        "median": np.median(guessed),
        "largest": guessed.max(),
        "median_played": np.median(true),
        "mean_relative_error": error.mean(),
        "median_relative_error": np.median(error),
        "rank_correlation": np.corrcoef(ranks)[0, 1],
    }
    return {key: float(f"{value:.4g}") for key, value in numbers.items()}


def draw(folder: Path) -> None:
    """Maps of the three quantities with their histograms."""
    result = json.loads((folder / "diggability_map.json").read_text())
    columns = {
        part: {name: jnp.asarray(values, jnp.float32) for name, values in result[part].items()}
        for part in ("pose", "foreseen")
    }
    pose, performance = Pose(**columns["pose"]), Performance(**columns["foreseen"])
    pile = wlplan.read_pile(bundled_pile_path())
    figure = diggability_figure(pile, DiggabilityMap(pose, performance))
    write_bytes_atomic(folder / "diggability_map.png", png_bytes(figure, dpi=100))


if __name__ == "__main__":
    main("diggability_map", run, draw)
