"""The wheel loader and its presets.

Every number carries its source on the line above; "estimate" means that no source was found and
the value was chosen by us.
"""

from __future__ import annotations

import dataclasses
import math

from wlplan.site.parameters import MAP_BEHIND, MAP_WIDTH, parameter


@dataclasses.dataclass(frozen=True)
class WheelLoader:
    """A wheel loader of the Komatsu WA320-7 class with its bucket, linkage and drive line."""

    # Operating mass [kg]. Manufacturer's brochure: 15.2 t.
    mass: float = parameter(15_200.0, 1e3, 500e3, "kg")
    # Approach and reverse speed [m/s]. Paper, section 5.2: 8 km/h.
    # Range: slower, a cycle may not end in the number of time steps that is set aside for it;
    # faster, the edge crosses more than a cell in one of them.
    travel_speed: float = parameter(8.0 / 3.6, 1.0, 5.0, "m/s")
    # Distance from the dig location at which a cycle starts and ends [m]. Paper, section 5.2.
    approach_distance: float = parameter(5.0, MAP_BEHIND, 50.0, "m")
    # Length of the outline with the bucket on the ground [m]; its width is that of the bucket.
    # Brochures of the class: 7.3 to 7.6.
    length: float = parameter(7.5, 2.0, 20.0, "m")
    # How far the raised bucket reaches over the side of a truck, from the front of that outline
    # [m]: the tyres stop short of the truck. Estimate from the brochure's side view.
    overhang: float = parameter(1.3, 0.0, 6.0, "m")
    # Turning radius at the outside of the tyres [m]. Brochure of the class: 5.2 to 5.5.
    turning_radius: float = parameter(5.4, 1.0, 30.0, "m")
    # Tyre friction on firm gravel [1]. Estimate, 0.6 to 0.75 in the literature.
    # Range: apart from the rolling resistance, which the thrust has to overcome.
    traction: float = parameter(0.6, 0.3, 1.5, "")
    # Rolling resistance coefficient on a firm gravel floor [1]. Estimate.
    rolling_resistance: float = parameter(0.03, 0.0, 0.25, "")
    # Power at the wheels while digging [W]; the net engine power is 124 kW (brochure) and is
    # shared with the hydraulics. Estimate.
    wheel_power: float = parameter(80_000.0, 5e3, 2e6, "W")
    # Gain of the travel speed controller [N s/m]. Estimate: stiff, force-limited.
    speed_gain: float = parameter(1.0e5, 1e3, 1e7, "N s/m")
    # Upper bound on the slip speed that is counted as work [m/s]. Estimate: the operator's
    # traction control lets the wheels slip by about a third of the travel speed.
    slip_speed: float = parameter(0.75, 0.0, 5.0, "m/s")
    # Mass of the bucket, and of the boom (half of which acts at the pin) [kg]. Estimate.
    bucket_mass: float = parameter(1300.0, 10.0, 50e3, "kg")
    boom_mass: float = parameter(1100.0, 10.0, 50e3, "kg")

    # Bucket width [m]. Brochure: 2.6 to 2.74 m over the range of buckets.
    # Range: half a metre is five lanes; the widest leaves room beside it in the local map, without
    # which soil that it pushes aside is lost.
    bucket_width: float = parameter(2.70, 0.5, round(MAP_WIDTH - 0.6, 1), "m")
    # Length of the bucket floor from the cutting edge to the back wall [m]. Estimate from the
    # brochure's side view.
    bucket_depth: float = parameter(1.10, 0.2, 4.0, "m")
    # Thickness of the floor plate and the edge [m]. Estimate: plate, wear plates and edge.
    plate_thickness: float = parameter(0.03, 0.0, 0.5, "m")
    # Height of the side plates over the floor, mean over their length [m]. Estimate from the
    # brochure's side view.
    side_height: float = parameter(0.85, 0.05, 5.0, "m")
    # Heaped volume [m^3]. Brochure: about 3 over the range of buckets.
    bucket_heaped: float = parameter(3.0, 0.05, 30.0, "m³")
    # Height of the boom pivot above the ground [m], and boom length to the bucket pin [m].
    # Brochure drawing: 1.9 to 1.95 and 2.6 to 2.7.
    pivot_height: float = parameter(1.90, 0.3, 6.0, "m")
    boom_length: float = parameter(2.70, 0.5, 10.0, "m")
    # Distance from the bucket pin to the cutting edge [m]. Brochure drawing.
    tip_radius: float = parameter(1.25, 0.2, 5.0, "m")
    # Boom angle with the bucket on the ground, and at the end of the cycle [rad]. Paper: -20.
    boom_low: float = parameter(math.radians(-37.0), -80.0, 0.0, "°")
    boom_carry: float = parameter(math.radians(-20.0), -80.0, 80.0, "°")
    # Highest boom angle [rad]. Estimate from the brochure's dumping height.
    boom_high: float = parameter(math.radians(45.0), 0.0, 80.0, "°")
    # Bucket angle at the tilt end [rad]. Brochure: 48 at the carry position.
    tilt_end: float = parameter(math.radians(48.0), 5.0, 90.0, "°")
    # Full boom speed [rad/s]: the stroke of 82 degrees in 5.9 s (brochure).
    boom_speed: float = parameter(math.radians(82.0) / 5.9, 1.0, 180.0, "°/s")
    # Full tilt speed [rad/s]. Estimate: 36 degrees a second.
    tilt_speed: float = parameter(math.radians(36.0), 1.0, 360.0, "°/s")
    # Lever arm of the boom cylinders about the pivot [m] and their stall force [N]. Estimate.
    boom_lever: float = parameter(0.5, 0.05, 5.0, "m")
    boom_force: float = parameter(600_000.0, 1e4, 1e7, "N")
    # Boom force that normalises the controller's thresholds, f_b0 [N]. Estimate.
    boom_force_nominal: float = parameter(500_000.0, 1e4, 1e7, "N")
    # Largest tilting moment of the bucket cylinder about the pin [N m]. Breakout force 130 to
    # 145 kN (brochure) at the tip radius is 163 to 181 kN m at the cutting edge.
    tilt_moment: float = parameter(175_000.0, 1e3, 1e7, "N m")

    @property
    def tip_arm(self) -> tuple[float, float]:
        """How far the cutting edge of a level, lowered bucket is ahead of and below its pin [m]."""
        down = self.pivot_height + self.boom_length * math.sin(self.boom_low)
        return math.sqrt(self.tip_radius**2 - down**2), down


WA320 = WheelLoader()

MACHINES = {"wa320": WA320}
"""Machines by name."""
