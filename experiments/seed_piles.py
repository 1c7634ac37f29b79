"""The seed piles that data sets and tests begin with, seen from aside.

Paper, figure 8: triangular, conical and wedge at 20 and 30 degrees, with noise; beside them the
prism of the follow-up's benchmark. They are relaxed, as they are before the first loading.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import Normalize

import wlplan
from experiments._common.grids import around_pile, packed, unpacked
from experiments._common.places import say
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.relief import PILE
from wlplan.report.figures.style import FAINT, INK, new_figure
from wlplan.report.figures.surface import draw_surface

KINDS = ("triangular", "conical", "wedge", "prism")
SLOPES = (20.0, 30.0)
SEED = 0
# Every so manieth grid point is kept along either axis: 0.2 m. And ground around the pile [cells].
_EVERY, _MARGIN = 2, 5


def run(preset: str) -> dict[str, Any]:
    """Builds the piles and relaxes them."""
    kinds = KINDS[:1] if preset == "smoke" else KINDS
    piles = []
    for kind in kinds:
        for slope in SLOPES:
            say(f"{kind}, {slope:.0f}°")
            pile = wlplan.relax(wlplan.seed_pile(kind, slope=math.radians(slope), seed=SEED))
            height = np.asarray(pile.height, np.float64)
            piles.append(
                {
                    "kind": kind,
                    "slope_degrees": slope,
                    "highest_m": round(float(height.max()), 2),
                    "volume_m3": round(float(height.sum()) * pile.cell_size**2, 1),
                    "cell_size_m": round(_EVERY * pile.cell_size, 3),
                    "heights": packed(around_pile(height[None, ::_EVERY, ::_EVERY], _MARGIN)[0]),
                }
            )
    return {"seed": SEED, "piles": piles}


def draw(folder: Path) -> None:
    """The piles side by side, the steeper ones below, all in one scale."""
    result = json.loads((folder / "seed_piles.json").read_text())
    piles = result["piles"]
    columns = len(piles) // len(SLOPES)
    figure = new_figure(3.3 * columns, 5.0)
    panels = figure.subplots(
        len(SLOPES), columns, squeeze=False, sharex=True, sharey=True, gridspec_kw={"wspace": 0.0}
    )
    norm = Normalize(0.0, max(pile["highest_m"] for pile in piles))
    for panel, pile in zip(panels.T.ravel(), piles, strict=True):
        height = unpacked(pile["heights"])[0]
        # The footprints lie around the same point.
        corner = tuple(-0.5 * pile["cell_size_m"] * (n - 1) for n in height.shape)
        draw_surface(
            panel, height, pile["cell_size_m"], PILE, norm, corner=(corner[0], corner[1]), base=-0.3
        )
        panel.set_title(
            f"{pile['kind']}, {pile['slope_degrees']:.0f}°\n"
            f"{pile['highest_m']:.1f} m high, {pile['volume_m3']:.0f} m³",
            fontsize=9,
            color=INK,
        )
    figure.suptitle("All in one scale; +x is to the right and back", fontsize=8, color=FAINT)
    write_bytes_atomic(folder / "seed_piles.png", png_bytes(figure, dpi=120))


if __name__ == "__main__":
    main("seed_piles", run, draw)
