"""What planners are compared on: piles, jobs, and what stands around."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

import wlplan
from wlplan.io import bundled_pile_path
from wlplan.planning.amounts import Amount
from wlplan.planning.placement import beside
from wlplan.site.receiver import Receiver
from wlplan.site.site import Site
from wlplan.types import Pile

PRISMS = 10
PILES = (*(f"prism {n}" for n in range(PRISMS)), "cone", "ridge", "wedge", "bundled")
"""The follow-up's ten prisms; three seed piles; the pile that comes with the package."""

JOBS: dict[str, Amount] = {
    "15 loads": wlplan.Loads(15),
    "50 loads": wlplan.Loads(50),
    "trucks": wlplan.Trucks(2, 24.0),
    "tonnes": wlplan.Tonnes(55.0),
    "empty": wlplan.Empty(),
}
SMOKE_JOB = "2 loads"
EACH = "a place for each"
SITES = ("fixed truck", "free truck", EACH, "walls", "walls, free truck")
"""The truck at a place that is given, or where the planner wants it, or each truck of `Trucks`
where it wants that one; with walls around or none."""

_SMOKE: dict[str, Amount] = {SMOKE_JOB: wlplan.Loads(2)}

# Where the follow-up has the receiver of its prisms [m, m, rad].
_RECEIVER = (-12.0, -3.0, math.radians(-30.0))
_KINDS = {"prism": "prism", "cone": "conical", "ridge": "triangular", "wedge": "wedge"}
# How far walls are off the soil, how thick they are [m], and from what height on it is soil [m].
_OFF, _THICK, _SOIL = 1.0, 0.4, 0.25


@dataclasses.dataclass(frozen=True)
class Instance:
    """One pile, job and site."""

    pile: str
    job: str
    site: str

    @property
    def name(self) -> str:
        """As file names have it."""
        return ".".join(
            part.replace(",", "").replace(" ", "-") for part in dataclasses.astuple(self)
        )

    @property
    def amount(self) -> Amount:
        """How much is to be loaded."""
        return (JOBS | _SMOKE)[self.job]

    @property
    def is_free(self) -> bool:
        """Whether the truck stands where the planner wants it."""
        return self.site.endswith("free truck")

    def site_of(self, pile: Pile) -> Site:
        """The site, the truck at the place that is given."""
        receiver = None
        if self.pile.startswith("prism"):
            receiver = Receiver(*(jnp.asarray(v, pile.height.dtype) for v in _RECEIVER))
        walls = _walls(pile) if self.site.startswith("walls") else None
        return beside(Site(receiver=receiver, keep_out=walls), pile)

    def load_pile(self) -> Pile:
        """The pile, at rest."""
        if self.pile == "bundled":
            return wlplan.read_pile(bundled_pile_path())
        kind, *number = self.pile.split()
        seed = int(number[0]) if number else 1
        slope = math.radians(30.0)
        return wlplan.relax(wlplan.seed_pile(_KINDS[kind], slope=slope, seed=seed))


def _walls(pile: Pile) -> Bool[Array, "nx ny"]:
    """Cells of three walls, a metre off the soil on all sides but that of -x."""
    soil = np.asarray(pile.height - pile.floor) > _SOIL
    rows, columns = np.flatnonzero(soil.any(axis=1)), np.flatnonzero(soil.any(axis=0))
    off, thick = (round(length / pile.cell_size) for length in (_OFF, _THICK))
    # At the edge of the map they are nearer, where it has no room for them.
    back = min(rows[-1] + off, soil.shape[0] - thick)
    sides = max(columns[0] - off, thick), min(columns[-1] + off, soil.shape[1] - thick)
    walls = np.zeros(soil.shape, bool)
    walls[rows[0] : back + thick, sides[0] - thick : sides[1] + thick] = True
    walls[rows[0] : back, sides[0] : sides[1]] = False
    return jnp.asarray(walls)
