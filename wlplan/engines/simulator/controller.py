"""The automatic bucket-filling controller: an admittance from boom force to actuator speed."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.engines.limits import SMOOTHING_TIME
from wlplan.types import Action


def command(
    action: Action, boom_force: Float[Array, "*b"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Target speeds of boom and bucket as parts of their maxima. Paper, section 5.2.

    Args:
        action: Thresholds and gains.
        boom_force: Boom cylinder force over the nominal force f_b0 [1].
    """
    return (
        jnp.clip(action.k_bm * (boom_force - action.delta_bm), 0.0, 1.0),
        jnp.clip(action.k_bk * (boom_force - action.delta_bk), 0.0, 1.0),
    )


def smooth(
    value: Float[Array, "*b"], target: Float[Array, "*b"], step: float
) -> Float[Array, "*b"]:
    """First-order lag of forces and commands over one time step [s].

    Stands for the paper's moving average of the force (section 5.2), with the same mean delay.
    """
    return value + (target - value) * (step / (SMOOTHING_TIME + step))
