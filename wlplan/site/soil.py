"""Soils and their presets.

Every number carries its source on the line above; "estimate" means that no source was found and
the value was chosen by us. The calibrated group is fitted, see docs/simulator.md.
"""

from __future__ import annotations

import dataclasses
import math

from wlplan.site.parameters import parameter


@dataclasses.dataclass(frozen=True)
class Soil:
    """A homogeneous soil."""

    # Bulk density [kg/m^3], internal friction [rad], cohesion [Pa]. Dry gravel: paper, section 5.1.
    # Its dilatancy of 8 degrees plays no role here: volumes are bulk volumes throughout.
    # Range: from dry wood chips to heavy ore.
    density: float = parameter(1727.0, 200.0, 5000.0, "kg/m³")
    # Range: a soil without friction would never come to rest on a slope.
    friction: float = parameter(math.radians(32.0), 5.0, 60.0, "°")
    cohesion: float = parameter(0.0, 0.0, 100e3, "Pa")
    # Soil-steel friction [rad] and adhesion [Pa]. Estimate: two thirds of the internal friction.
    steel_friction: float = parameter(math.radians(20.0), 0.0, 60.0, "°")
    adhesion: float = parameter(0.0, 0.0, 100e3, "Pa")

    # Fitted to the forces and loads of discrete-element cycles, see docs/simulator.md.
    # Most that the bucket takes over its heaped volume [1]: the bucket fill factor.
    fill_factor: float = parameter(0.92, 0.1, 2.0, "")
    # Resistance to the cutting edge a metre of width [N/m].
    edge_resistance: float = parameter(4_500.0, 0.0, 1e6, "N/m")
    # Push of a level bucket's content against the pile ahead, and weight of the soil that is
    # carried with the content, both over the content's weight [1].
    content_push: float = parameter(2.35, 0.0, 20.0, "")
    content_carry: float = parameter(0.5, 0.0, 20.0, "")
    # Resistance of the soil under the bucket's floor to being pressed down, a square metre and a
    # metre of depth [N/m^3].
    intrusion_stiffness: float = parameter(1.2e6, 0.0, 1e8, "N/m³")
    # Fastest flow of sliding soil a metre of width while the bucket digs [m^2/s].
    slide_rate: float = parameter(0.03, 0.0, 1.0, "m²/s")

    @property
    def repose_angle(self) -> float:
        """Angle of repose [rad]: the internal friction angle.

        Of a loose soil without cohesion that is what it is. A cohesive soil stands steeper than
        this, up to a vertical face of some height, and breaks off in lumps: for such a soil the
        angle is unsound and makes piles flatter than they are. The automaton knows nothing else.
        """
        return self.friction


GRAVEL = Soil()

# The further soils are loose, as they lie in a pile after digging. Their fitted group is that of
# gravel: nothing was fitted for them. Densities: the middle of what published tables of loose
# materials for choosing buckets and trucks give. Internal friction: typical textbook range.

# Dry sand. Density 1.4 to 1.6 t/m^3, friction 28 to 34 degrees, no cohesion. On steel: estimate,
# two thirds of the internal friction.
SAND = Soil(
    density=1500.0,
    friction=math.radians(31.0),
    cohesion=0.0,
    steel_friction=math.radians(20.0),
    adhesion=0.0,
)
# Wet sand. Density 1.8 to 1.95 t/m^3; friction as when dry. Cohesion from the water between the
# grains, which goes when the sand dries or floods: estimate, 1 to 4 kPa. On steel: as for dry sand.
WET_SAND = Soil(
    density=1850.0,
    friction=math.radians(31.0),
    cohesion=2_000.0,
    steel_friction=math.radians(20.0),
    adhesion=0.0,
)
# Moist earth, sandy loam. Density 1.25 to 1.6 t/m^3, friction 25 to 35 degrees, on steel 20 to 22.
# Cohesion: 5 to 15 kPa in place (typical textbook range), less once dug: estimate. Adhesion: taken
# as none, as textbooks do for soil that is not sticky.
DIRT = Soil(
    density=1450.0,
    friction=math.radians(30.0),
    cohesion=4_000.0,
    steel_friction=math.radians(21.0),
    adhesion=0.0,
)
# Moist clay in lumps. Density 1.5 to 1.7 t/m^3, friction 10 to 25 degrees, on steel 0.5 to 0.7 of
# it. Cohesion: 10 to 40 kPa in place (typical textbook range), less once dug: estimate. Adhesion:
# estimate, a quarter of the cohesion.
CLAY = Soil(
    density=1600.0,
    friction=math.radians(20.0),
    cohesion=8_000.0,
    steel_friction=math.radians(13.0),
    adhesion=2_000.0,
)

SOILS = {
    "gravel": GRAVEL,
    "sand": SAND,
    "wet-sand": WET_SAND,
    "dirt": DIRT,
    "clay": CLAY,
}
"""Soils by name."""
