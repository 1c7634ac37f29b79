"""What a loading may cost beyond what is foreseen, as terms of an objective.

They ask the world that the loading is foreseen by. In a world that has played it, as the simulator
has, nothing is left open: there they count nothing.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.planning.loading import LEAST_MASS, Loading
from wlplan.worlds.capabilities import can


@dataclasses.dataclass(frozen=True)
class ExpectedStall:
    """Time that a stall is expected to take beyond what is foreseen, over a typical cycle [1]."""

    # What the capability of the world is called that it needs.
    needs: ClassVar[str] = "stall_probability"

    # Time of a loading that stalls [s]: median of the cycles that did in the data of the models.
    stalled: float = 21.4
    reference: float = 46.3  # [s]

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        if not can(loading.world, self.needs):
            return jnp.zeros_like(loading.performance.time)
        likely = loading.world.stall_probability(loading.pile, loading.pose, loading.action)
        more: Array = jax.nn.relu(self.stalled - loading.performance.time)
        return jnp.asarray(likely) * more / self.reference


@dataclasses.dataclass(frozen=True)
class Deviation:
    """Standard deviations of time and work, each over that of a typical cycle [1]."""

    needs: ClassVar[str] = "uncertainty"

    time: float = 46.3  # [s]
    work: float = 1033.0  # [kJ]

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        if not can(loading.world, self.needs):
            return jnp.zeros_like(loading.performance.time)
        deviation = loading.world.uncertainty(loading.pile, loading.pose, loading.action)
        return jnp.asarray(deviation.time / self.time + deviation.work / self.work)


@dataclasses.dataclass(frozen=True)
class MassDeviation:
    """By how much M0 / M rises if the load is a standard deviation lighter, to first order [1].

    Where a model has not seen the like, as on faces steeper than those it learned from, its members
    disagree on the load long before their mean tells; what looks best there is what they are most
    wrong about.
    """

    needs: ClassVar[str] = "uncertainty"

    reference: float = 4.29  # [tonne]

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        mass = loading.performance.mass
        if not can(loading.world, self.needs):
            return jnp.zeros_like(mass)
        deviation = loading.world.uncertainty(loading.pile, loading.pose, loading.action)
        return jnp.asarray(self.reference * deviation.mass / (mass**2 + LEAST_MASS**2))
