"""Terms of an objective: functions of one loading to one number, the smaller the better.

The three of the follow-up are here, and room to drive; `wlplan.planning.face` has those of a face
that is worked well, `wlplan.planning.risk` those of what may come out worse than foreseen.
References make them comparable: the means of the follow-up's greedy plan, 64.4 t, 694 s and 15.5 MJ
over 15 loads.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.planning.face import oblique, slot, undercut
from wlplan.planning.loading import LEAST_MASS, Loading
from wlplan.planning.risk import Deviation, ExpectedStall, MassDeviation

Term = Callable[[Loading], Float[Array, ""]]
"""`term(loading)`: a scalar; any function of a loading is one."""


@dataclasses.dataclass(frozen=True)
class InverseMass:
    """M0 / M: a typical load over this one [1]."""

    reference: float = 4.29  # [tonne]

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        mass = loading.performance.mass
        return self.reference / jnp.sqrt(mass**2 + LEAST_MASS**2)


@dataclasses.dataclass(frozen=True)
class CycleTime:
    """T / T0: the time of a cycle, transport and waiting included, over a typical one [1]."""

    reference: float = 46.3  # [s]

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        carried = loading.transport
        return (loading.performance.time + carried.time + carried.wait) / self.reference


@dataclasses.dataclass(frozen=True)
class CycleWork:
    """W / W0: the work of a cycle, transport included, over a typical one [1]."""

    reference: float = 1033.0  # [kJ]

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """The term of a loading."""
        return (loading.performance.work + loading.transport.work) / self.reference


def touching(loading: Loading) -> Float[Array, ""]:
    """Metres of the way and of the approach lane that lead through what must not be touched."""
    return jnp.asarray(loading.transport.touching)


TERMS: dict[str, Term] = {
    "mass": InverseMass(),
    "time": CycleTime(),
    "work": CycleWork(),
    "touching": touching,
    "slot": slot,
    "oblique": oblique,
    "undercut": undercut,
    "stall": ExpectedStall(),
    "deviation": Deviation(),
    "mass_deviation": MassDeviation(),
}
"""Terms by name."""
