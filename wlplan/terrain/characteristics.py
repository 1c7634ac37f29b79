"""The four local pile characteristics: slope, incidence and two curvatures. Paper, section 4.3."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.types import Characteristics, LocalHeightmap

# Horizontal part of the mean normal below which the incidence angle fades to zero: on flat ground
# it has no meaning, and its derivative would grow without bound. Shortens the incidence on a
# 10 degree slope by a thousandth of its value.
_FLAT = 0.005


@functools.cache
def _quadratic_fit(cells: int, cell_size: float) -> np.ndarray:
    """Rows of the least-squares operator that give the second derivatives along x and y [1/m]."""
    position = (np.arange(cells) - (cells - 1) / 2) * cell_size
    x, y = (a.ravel() for a in np.meshgrid(position, position, indexing="ij"))
    columns = np.stack([np.ones_like(x), x, y, x**2 / 2, y**2 / 2], axis=1)
    return np.linalg.pinv(columns)[3:]


def _gradient(height: Array, cell_size: float, axis: int) -> Array:
    """Central differences, one-sided at the border."""
    h = jnp.moveaxis(height, axis, 0)
    inner = (h[2:] - h[:-2]) / 2
    return jnp.moveaxis(jnp.concatenate([h[1:2] - h[:1], inner, h[-1:] - h[-2:-1]]), 0, axis) / (
        cell_size
    )


def characteristics(local: LocalHeightmap) -> Characteristics:
    """Slope, incidence and curvatures of a local heightmap.

    The slope is the angle between the mean unit normal and the vertical. The incidence is the
    angle between the heading and the horizontal direction into the pile: 0 head-on, never
    negative, by symmetry. The curvatures come from a quadratic fit without cross term and are
    positive on convex ground. All four are smooth on flat ground and head-on.

    Args:
        local: A square local heightmap.
    """
    height, cell_size = local.height, local.cell_size
    slope_x = _gradient(height, cell_size, 0)
    slope_y = _gradient(height, cell_size, 1)
    vertical = 1.0 / jnp.sqrt(1.0 + slope_x**2 + slope_y**2)
    # Components of the mean normal, pointing out of the pile: into the pile is -(nx, ny).
    nx, ny, nz = (-slope_x * vertical).mean(), (-slope_y * vertical).mean(), vertical.mean()
    into_x, aside = -nx, jnp.sqrt(ny**2 + _TINY**2) - _TINY
    horizontal_squared = nx**2 + ny**2
    # arccos and sqrt have no derivative on flat ground; the offset inside the root bounds it.
    horizontal = jnp.sqrt(horizontal_squared + _TINY**2) - _TINY
    fade = horizontal_squared / (horizontal_squared + _FLAT**2)
    on_flat = horizontal_squared == 0.0
    incidence = fade * jnp.arctan2(aside, jnp.where(on_flat, 1.0, into_x))
    fit = jnp.asarray(_quadratic_fit(height.shape[0], cell_size), height.dtype)
    second = fit @ height.reshape(-1)
    return Characteristics(
        slope=jnp.arctan2(horizontal, nz),
        incidence=incidence,
        curvature_x=-second[0],
        curvature_y=-second[1],
    )


# Offset that rounds |a| at zero; 0.006 degrees.
_TINY = 1e-4


def as_vector(c: Characteristics) -> Float[Array, "4"]:
    """[slope, incidence, curvature_x, curvature_y]."""
    return jnp.stack([c.slope, c.incidence, c.curvature_x, c.curvature_y])
