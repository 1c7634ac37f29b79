"""Resistance of soil to a blade: the Fundamental Equation of Earthmoving on a sloped surface.

A blade of rake rho at depth d under a surface of slope alpha pushes up a wedge that slides on a
plane at the angle beta. Equilibrium of the wedge gives the force a metre of width,

    P = (gamma d^2 N_gamma + c d N_c + c_a d N_a + q d N_q),
    N_gamma = (cot rho + cot beta) sin(alpha + phi + beta) / (2 sin eta),
    N_c = cos phi / (sin beta sin eta),   N_a = -cos(rho + phi + beta) / (sin rho sin eta),
    N_q = (cot rho + cot beta) sin(alpha + phi + beta) / sin eta,   eta = delta + rho + phi + beta,

minimised over beta. Angles and the depth are measured from the surface (Reece 1964; McKyes 1985;
sloped surface after Luengo, Singh and Cannon 1998).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from wlplan.machine import Soil
from wlplan.units import GRAVITY

# Failure angles tried [rad], and the steps of the parabolas that refine the best of them.
_ANGLE_STEP = math.radians(7.0)
_CLOSER_STEPS = (math.radians(1.5), math.radians(0.5))
_FAILURE_ANGLES = tuple(math.radians(4.0) + k * _ANGLE_STEP for k in range(10))
# The wedge locks where sin(eta) goes to zero; the least value it is given, which bounds the force.
_LOCKED = 0.05


def earthmoving_force(
    depth: Float[Array, "*n"],
    rake: Float[Array, "*n"],
    slope: Float[Array, "*n"],
    *,
    soil: Soil,
    external_friction: Float[Array, "*n"] | float | None = None,
    surcharge: Float[Array, "*n"] | float = 0.0,
) -> Float[Array, "*n"]:
    """Force on a blade a metre of width [N/m], at the external friction angle from its normal.

    Args:
        depth: Depth of the cutting edge normal to the surface [m], not negative.
        rake: Angle between blade and surface [rad], 0 < rake < pi.
        slope: Slope of the surface along the direction of motion, rising positive [rad].
        soil: Soil parameters.
        external_friction: Friction between blade and soil [rad]; default: soil on steel.
        surcharge: Load on the surface [Pa].
    """
    delta = soil.steel_friction if external_friction is None else external_friction
    weight = soil.density * GRAVITY
    cos_phi = math.cos(soil.friction)
    # Everything that does not depend on the failure angle; the sines of sums follow from these.
    locking = jnp.sin(delta + rake + soil.friction), jnp.cos(delta + rake + soil.friction)
    lifting = jnp.sin(slope + soil.friction), jnp.cos(slope + soil.friction)
    sticking = jnp.sin(rake + soil.friction), jnp.cos(rake + soil.friction)
    sin_rake = jnp.sin(rake)
    cot_rake = jnp.cos(rake) / sin_rake
    load = weight * depth**2 / 2 + surcharge * depth

    def resistance(sin_beta: Array | float, cos_beta: Array | float) -> Array:
        sin_eta = locking[0] * cos_beta + locking[1] * sin_beta
        lift = lifting[0] * cos_beta + lifting[1] * sin_beta
        cosine = sticking[1] * cos_beta - sticking[0] * sin_beta
        force = load * (cot_rake + cos_beta / sin_beta) * lift
        force = force + soil.cohesion * depth * cos_phi / sin_beta
        force = force - soil.adhesion * depth * cosine / sin_rake
        # Beyond locking the wedge cannot be pushed out at all: no such angle may look cheap.
        beyond = jnp.maximum(_LOCKED - sin_eta, 0.0) / _LOCKED
        return force / jnp.maximum(sin_eta, _LOCKED) * (1.0 + beyond)

    beta = lax.stop_gradient(_failure_angle(resistance))
    return jnp.maximum(resistance(jnp.sin(beta), jnp.cos(beta)), 0.0)


def _failure_angle(resistance: Callable[[Array | float, Array | float], Array]) -> Array:
    """The angle of least resistance; by the envelope theorem a constant for the derivative."""
    values = [resistance(math.sin(b), math.cos(b)) for b in _FAILURE_ANGLES]
    before, here, after = values[0], values[1], values[2]
    angle = jnp.full_like(here, _FAILURE_ANGLES[1])
    for k in range(2, len(values) - 1):
        better = values[k] < here
        before = jnp.where(better, values[k - 1], before)
        after = jnp.where(better, values[k + 1], after)
        angle = jnp.where(better, _FAILURE_ANGLES[k], angle)
        here = jnp.where(better, values[k], here)
    angle = angle + _ANGLE_STEP * _vertex(before, here, after)
    # Once more, closer up: the envelope theorem holds at the minimum and only there.
    for step in _CLOSER_STEPS:
        sine, cosine, s, c = jnp.sin(angle), jnp.cos(angle), math.sin(step), math.cos(step)
        before = resistance(sine * c - cosine * s, cosine * c + sine * s)
        after = resistance(sine * c + cosine * s, cosine * c - sine * s)
        angle = angle + step * _vertex(before, resistance(sine, cosine), after)
    return angle


def _vertex(before: Array, here: Array, after: Array) -> Array:
    """Where a parabola through three values is least, in steps from the middle; at most one."""
    curvature = before - 2.0 * here + after
    curved = curvature > 0.0
    offset = jnp.where(curved, 0.5 * (before - after) / jnp.where(curved, curvature, 1.0), 0.0)
    return jnp.clip(offset, -1.0, 1.0)
