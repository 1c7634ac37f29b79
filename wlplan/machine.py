"""Parameters of the machine and of the soil, as frozen presets.

Every number carries its source on the line above; "estimate" means that no source was found and
the value was chosen by us. The calibrated group of `Soil` is fitted, see docs/simulator.md.
"""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class WheelLoader:
    """A wheel loader of the Komatsu WA320-7 class with its bucket, linkage and drive line."""

    # Operating mass [kg]. Manufacturer's brochure: 15.2 t.
    mass: float = 15_200.0
    # Approach and reverse speed [m/s]. Paper, section 5.2: 8 km/h.
    travel_speed: float = 8.0 / 3.6
    # Distance from the dig location at which a cycle starts and ends [m]. Paper, section 5.2.
    approach_distance: float = 5.0
    # Tyre friction on firm gravel [1]. Estimate, 0.6 to 0.75 in the literature.
    traction: float = 0.6
    # Rolling resistance coefficient on a firm gravel floor [1]. Estimate.
    rolling_resistance: float = 0.03
    # Power at the wheels while digging [W]; the net engine power is 124 kW (brochure) and is
    # shared with the hydraulics. Estimate.
    wheel_power: float = 80_000.0
    # Gain of the travel speed controller [N s/m]. Estimate: stiff, force-limited.
    speed_gain: float = 1.0e5
    # Upper bound on the slip speed that is counted as work [m/s]. Estimate: the operator's
    # traction control lets the wheels slip by about a third of the travel speed.
    slip_speed: float = 0.75
    # Mass of the bucket, and of the boom (half of which acts at the pin) [kg]. Estimate.
    bucket_mass: float = 1300.0
    boom_mass: float = 1100.0

    # Bucket width [m]. Brochure: 2.6 to 2.74 m over the range of buckets.
    bucket_width: float = 2.70
    # Length of the bucket floor from the cutting edge to the back wall [m]. Estimate from the
    # brochure's side view.
    bucket_depth: float = 1.10
    # Thickness of the floor plate and the edge [m]. Estimate: plate, wear plates and edge.
    plate_thickness: float = 0.03
    # Height of the side plates over the floor, mean over their length [m]. Estimate from the
    # brochure's side view.
    side_height: float = 0.85
    # Heaped volume [m^3]. Brochure: about 3 over the range of buckets.
    bucket_heaped: float = 3.0
    # Height of the boom pivot above the ground [m], and boom length to the bucket pin [m].
    # Brochure drawing: 1.9 to 1.95 and 2.6 to 2.7.
    pivot_height: float = 1.90
    boom_length: float = 2.70
    # Distance from the bucket pin to the cutting edge [m]. Brochure drawing.
    tip_radius: float = 1.25
    # Boom angle with the bucket on the ground, and at the end of the cycle [rad]. Paper: -20.
    boom_low: float = math.radians(-37.0)
    boom_carry: float = math.radians(-20.0)
    # Highest boom angle [rad]. Estimate from the brochure's dumping height.
    boom_high: float = math.radians(45.0)
    # Bucket angle at the tilt end [rad]. Brochure: 48 at the carry position.
    tilt_end: float = math.radians(48.0)
    # Full boom speed [rad/s]: the stroke of 82 degrees in 5.9 s (brochure).
    boom_speed: float = math.radians(82.0) / 5.9
    # Full tilt speed [rad/s]. Estimate: 36 degrees a second.
    tilt_speed: float = math.radians(36.0)
    # Lever arm of the boom cylinders about the pivot [m] and their stall force [N]. Estimate.
    boom_lever: float = 0.5
    boom_force: float = 600_000.0
    # Boom force that normalises the controller's thresholds, f_b0 [N]. Estimate.
    boom_force_nominal: float = 500_000.0
    # Largest tilting moment of the bucket cylinder about the pin [N m]. Breakout force 130 to
    # 145 kN (brochure) at the tip radius is 163 to 181 kN m at the cutting edge.
    tilt_moment: float = 175_000.0

    @property
    def tip_arm(self) -> tuple[float, float]:
        """How far the cutting edge of a level, lowered bucket is ahead of and below its pin [m]."""
        down = self.pivot_height + self.boom_length * math.sin(self.boom_low)
        return math.sqrt(self.tip_radius**2 - down**2), down


@dataclasses.dataclass(frozen=True)
class Soil:
    """A homogeneous soil."""

    # Bulk density [kg/m^3], internal friction [rad], cohesion [Pa]. Dry gravel: paper, section 5.1.
    # Its dilatancy of 8 degrees plays no role here: volumes are bulk volumes throughout.
    density: float = 1727.0
    friction: float = math.radians(32.0)
    cohesion: float = 0.0
    # Soil-steel friction [rad] and adhesion [Pa]. Estimate: two thirds of the internal friction.
    steel_friction: float = math.radians(20.0)
    adhesion: float = 0.0

    # Fitted to the forces and loads of discrete-element cycles, see docs/simulator.md.
    # Most that the bucket takes over its heaped volume [1]: the bucket fill factor.
    fill_factor: float = 0.92
    # Resistance to the cutting edge a metre of width [N/m].
    edge_resistance: float = 4_500.0
    # Push of a level bucket's content against the pile ahead, and weight of the soil that is
    # carried with the content, both over the content's weight [1].
    content_push: float = 2.35
    content_carry: float = 0.5
    # Resistance of the soil under the bucket's floor to being pressed down, a square metre and a
    # metre of depth [N/m^3].
    intrusion_stiffness: float = 1.2e6
    # Fastest flow of sliding soil a metre of width while the bucket digs [m^2/s].
    slide_rate: float = 0.03

    @property
    def repose_angle(self) -> float:
        """Angle of repose [rad]: the internal friction angle.

        Of a loose soil without cohesion that is what it is. A cohesive soil stands steeper than
        this, up to a vertical face of some height, and breaks off in lumps: for such a soil the
        angle is unsound and makes piles flatter than they are. The automaton knows nothing else.
        """
        return self.friction


WA320 = WheelLoader()
GRAVEL = Soil()

# The further soils are loose, as they lie in a heap after digging. Their fitted group is that of
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
