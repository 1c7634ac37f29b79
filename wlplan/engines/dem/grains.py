"""The spheres that stand for gravel, and the numerical settings of the engine."""

from __future__ import annotations

import dataclasses
import math

from wlplan.site.soil import GRAVEL


@dataclasses.dataclass(frozen=True)
class Grains:
    """Properties of the spheres and of their contacts.

    Chosen so that a pile of them has the density of the paper's gravel and, in a slice 1 m wide, an
    angle of repose of 33 degrees, give or take 3. No triaxial test was simulated.
    """

    # Mean radius [m], and the ends of the uniform distribution as parts of it. Estimate: as large
    # as lets a cycle be played in a minute or two.
    radius: float = 0.095
    smallest: float = 0.80
    largest: float = 1.15
    # Normal and tangential stiffness [N/m] (linear springs) and restitution [1]. Estimate: soft
    # enough for the time step; under 3 m of soil a sphere gives way by about 4 % of its radius.
    stiffness: float = 5e5
    tangential_stiffness: float = 2.0 / 7.0 * 5e5
    restitution: float = 0.3
    # Sliding friction between spheres and on the floor, and rolling friction [1]. Fitted to the
    # angle of repose.
    friction: float = 0.60
    rolling: float = 0.18
    # Rolling spring [N/m] and damper [N s/m] of the spring-dashpot-slider model. Estimate.
    rolling_stiffness: float = 1e5
    rolling_damping: float = 400.0
    # Friction on the walls of the domain [1]: the far one, and the sides (little).
    far_wall_friction: float = 0.5
    side_wall_friction: float = 0.05
    # Sliding friction while the bed is made [1]: low, for a dense packing.
    settling_friction: float = 0.15

    def contact(self, friction: float, rolling: float) -> str:
        """The contact model in the words of LAMMPS' `pair_style granular`."""
        return (
            f"hooke {self.stiffness} {self.restitution} "
            f"tangential linear_history {self.tangential_stiffness} 1.0 {friction} "
            f"rolling sds {self.rolling_stiffness} {self.rolling_damping} {rolling} "
            "damping coeff_restitution limit_damping"
        )


@dataclasses.dataclass(frozen=True)
class DemSettings:
    """How the engine is run; a change of any field asks for cycles of its own."""

    grains: Grains = Grains()
    # Which part of the bed the spheres are taken from, and whether it is mirrored: the scatter
    # from one packing to the next is found by playing the same loading with several of these.
    packing: int = 0
    # Longest wall-clock time of one job [s]. A cycle takes one to four minutes of an idle core.
    timeout: float = 1800.0

    def time_step(self, density: float) -> float:
        """Time step [s] for a bulk density [kg/m^3].

        4e-4 s suits spheres of 0.095 m at the density of gravel; a contact lasts for a time that
        grows with the root of the mass.
        """
        size: float = (self.grains.radius / 0.095) ** 1.5
        return 4e-4 * size * math.sqrt(min(density / GRAVEL.density, 1.0))
