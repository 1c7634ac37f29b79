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
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from wlplan.constants import GRAVITY
from wlplan.site.soil import Soil

# Failure angles tried [rad], and the steps of the parabolas that refine the best of them.
_ANGLE_STEP = math.radians(7.0)
_CLOSER_STEPS = (math.radians(1.5), math.radians(0.5))
_FAILURE_ANGLES = tuple(math.radians(4.0) + k * _ANGLE_STEP for k in range(10))
# The wedge locks where sin(eta) goes to zero; the least value it is given, which bounds the force.
_LOCKED = 0.05


class Wedge(NamedTuple):
    """What the resistance of a wedge depends on, but for its failure angle."""

    load: Float[Array, "*n"]  # gamma d^2 / 2 + q d [N/m]
    depth: Float[Array, "*n"]  # [m]
    cot_rake: Float[Array, "*n"]
    # Sine and cosine: of slope + phi, of delta + rho + phi, and of rho + phi over sin rho.
    lifting: tuple[Float[Array, "*n"], Float[Array, "*n"]]
    locking: tuple[Float[Array, "*n"], Float[Array, "*n"]]
    sticking: tuple[Float[Array, "*n"], Float[Array, "*n"]]


def wedge_of(
    depth: Float[Array, "*n"],
    rake: Float[Array, "*n"],
    slope: Float[Array, "*n"],
    external_friction: Float[Array, "*n"] | float,
    *,
    soil: Soil,
    surcharge: Float[Array, "*n"] | float = 0.0,
) -> Wedge:
    """The wedge that a blade pushes up.

    Args:
        depth: Depth of the cutting edge normal to the surface [m], not negative.
        rake: Angle between blade and surface [rad], 0 < rake < pi.
        slope: Slope of the surface along the direction of motion, rising positive [rad].
        external_friction: Friction between blade and soil [rad].
        soil: Soil parameters.
        surcharge: Load on the surface [Pa].
    """
    sin_rake, beyond = jnp.sin(rake), rake + soil.friction
    return Wedge(
        load=soil.density * GRAVITY * depth**2 / 2 + surcharge * depth,
        depth=depth,
        cot_rake=jnp.cos(rake) / sin_rake,
        lifting=(jnp.sin(slope + soil.friction), jnp.cos(slope + soil.friction)),
        locking=(jnp.sin(external_friction + beyond), jnp.cos(external_friction + beyond)),
        sticking=(jnp.sin(beyond) / sin_rake, jnp.cos(beyond) / sin_rake),
    )


def least_resistance(wedge: Wedge, *, soil: Soil) -> Float[Array, "*n"]:
    """Force on the blade that pushes up a wedge, a metre of width [N/m].

    It acts at the external friction angle from the normal of the blade.
    """

    def resistance(wedge: Wedge, sin_beta: Array, cos_beta: Array) -> Array:
        sin_eta = wedge.locking[0] * cos_beta + wedge.locking[1] * sin_beta
        lift = wedge.lifting[0] * cos_beta + wedge.lifting[1] * sin_beta
        force = wedge.load * (wedge.cot_rake + cos_beta / sin_beta) * lift
        # Left out where it is nothing: XLA may not drop a product with zero.
        if soil.cohesion:
            force = force + soil.cohesion * math.cos(soil.friction) * wedge.depth / sin_beta
        if soil.adhesion:
            cosine = wedge.sticking[1] * cos_beta - wedge.sticking[0] * sin_beta
            force = force - soil.adhesion * wedge.depth * cosine
        # Beyond locking the wedge cannot be pushed out at all: no such angle may look cheap.
        beyond = jnp.maximum(_LOCKED - sin_eta, 0.0) / _LOCKED
        return force / jnp.maximum(sin_eta, _LOCKED) * (1.0 + beyond)

    sin_beta, cos_beta = lax.stop_gradient(_failure_angle(resistance, wedge))
    return jnp.maximum(resistance(wedge, sin_beta, cos_beta), 0.0)


def _failure_angle(
    resistance: Callable[[Wedge, Array, Array], Array], wedge: Wedge
) -> tuple[Array, Array]:
    """Sine and cosine of the angle of least resistance.

    By the envelope theorem the angle is a constant for the derivative.
    """
    like = wedge.load
    # All trials are made at once, along a new leading axis.
    wedge = jax.tree.map(lambda part: part[None], wedge)

    def trials(values: Sequence[float]) -> Array:
        return jnp.asarray(values, like.dtype).reshape(-1, *(1,) * like.ndim)

    sines, cosines = ([f(b) for b in _FAILURE_ANGLES] for f in (math.sin, math.cos))
    values = resistance(wedge, trials(sines), trials(cosines))
    before, here, after = values[0], values[1], values[2]
    sine, cosine = jnp.full_like(like, sines[1]), jnp.full_like(like, cosines[1])
    for k in range(2, len(sines) - 1):
        better = values[k] < here
        before = jnp.where(better, values[k - 1], before)
        after = jnp.where(better, values[k + 1], after)
        sine = jnp.where(better, sines[k], sine)
        cosine = jnp.where(better, cosines[k], cosine)
        here = jnp.where(better, values[k], here)
    sine, cosine = _turned(sine, cosine, _ANGLE_STEP * _vertex(before, here, after))
    # Once more, closer up: the envelope theorem holds at the minimum and only there.
    for step in _CLOSER_STEPS:
        s = trials((-math.sin(step), 0.0, math.sin(step)))
        c = trials((math.cos(step), 1.0, math.cos(step)))
        values = resistance(
            wedge, sine[None] * c + cosine[None] * s, cosine[None] * c - sine[None] * s
        )
        sine, cosine = _turned(sine, cosine, step * _vertex(*values))
    return sine, cosine


def _turned(sine: Array, cosine: Array, turn: Array) -> tuple[Array, Array]:
    """Sine and cosine of an angle after a turn of at most 7 degrees, by series: exact to 1e-10."""
    square = turn * turn
    s = turn * (1.0 - square / 6.0 * (1.0 - square / 20.0))
    c = 1.0 - square / 2.0 * (1.0 - square / 12.0 * (1.0 - square / 30.0))
    return sine * c + cosine * s, cosine * c - sine * s


def _vertex(before: Array, here: Array, after: Array) -> Array:
    """Where a parabola through three values is least, in steps from the middle; at most one."""
    curvature = before - 2.0 * here + after
    curved = curvature > 0.0
    offset = jnp.where(curved, 0.5 * (before - after) / jnp.where(curved, curvature, 1.0), 0.0)
    return jnp.clip(offset, -1.0, 1.0)
