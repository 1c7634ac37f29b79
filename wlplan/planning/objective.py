"""What a plan is worth: performance and transport to one number."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.types import Performance

# Load below which M0 / M is held finite [tonne]: a bucket that comes back empty costs as much as
# about forty good ones.
_LEAST_MASS = 0.1


@dataclasses.dataclass(frozen=True)
class Objective:
    """Cost of a loading: w . [M0/M, T/T0, W/W0], to be minimised. Follow-up, its objective.

    T and W include the transport. The cost of a plan is the sum over its loadings.
    """

    weights: tuple[float, float, float]
    # Mass [tonne], time [s] and work [kJ] of a typical loading, which make the terms comparable:
    # means of the follow-up's greedy plan, 64.4 t, 694 s and 15.5 MJ over 15 loads.
    mass: float = 4.29
    time: float = 46.3
    work: float = 1033.0


OBJECTIVES = {
    "efficiency": Objective((2.0, 1.0, 1.0)),
    "productivity": Objective((2.0, 2.0, 0.0)),
    "energy": Objective((2.0, 0.0, 2.0)),
}
"""Named objectives; "efficiency" has the follow-up's weights."""


def objective_named(name: str | Objective) -> Objective:
    """The objective of that name.

    Raises:
        InputError: If there is none.
    """
    if isinstance(name, Objective):
        return name
    if name not in OBJECTIVES:
        raise InputError(f"unknown objective {name!r}; choose one of {', '.join(OBJECTIVES)}")
    return OBJECTIVES[name]


def loading_cost(
    objective: Objective,
    performance: Performance,
    transport_time: Float[Array, "*n"],
    transport_work: Float[Array, "*n"],
) -> Float[Array, "*n"]:
    """Cost of loadings [1].

    Args:
        objective: Weights and references.
        performance: Of the loadings.
        transport_time: Time of their transport [s].
        transport_work: Work of their transport [kJ].
    """
    w_mass, w_time, w_work = objective.weights
    mass = jnp.sqrt(performance.mass**2 + _LEAST_MASS**2)
    return (
        w_mass * objective.mass / mass
        + w_time * (performance.time + transport_time) / objective.time
        + w_work * (performance.work + transport_work) / objective.work
    )
