"""The automatic bucket-filling controller: an admittance from boom force to actuator speed."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.types import Action

# Forces and commands are smoothed by a first-order lag whose mean delay is that of the paper's
# moving average over 0.1 s (section 5.2) [s].
SMOOTHING_TIME = 0.05


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
    """First-order lag over one time step [s]."""
    return value + (target - value) * (step / (SMOOTHING_TIME + step))
