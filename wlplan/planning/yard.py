"""Room to drive: what a loader must not touch, and how deep it would be in it.

What stands still (structures, areas that nothing may drive on) is found once for a job; the soil is
looked at anew before every loading. Both are kept on coarse cells, as the depth to which a disc of
the width of the loader is in them, so that a look at one place costs one memory access.
"""

from __future__ import annotations

import functools
import math
from typing import Any, no_type_check

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, UInt8

from wlplan.checks import is_traced
from wlplan.site.machine import WheelLoader
from wlplan.terrain.standing import CLEARED, pooled, standing
from wlplan.types import Pile
from wlplan.xla import on_device

# Cells of the yard come in multiples of so many along each side: what is compiled for one pile
# serves the next.
_BLOCK = 32
# Cells of the pile that make one of the yard, along each side: 0.3 m.
_COARSE = 3


@no_type_check
class Yard(struct.PyTreeNode):
    """What stands still around a pile, on coarse cells with a border that is free."""

    standing: Bool[Array, "n m"]
    unseen: Bool[Array, "n m"]  # by the scan
    origin: Float[Array, "2"]  # centre of cell [0, 0] [m]
    cell: float = struct.field(pytree_node=False)  # [m]
    reach: float = struct.field(pytree_node=False)  # radius of the disc [m]


DISCS = 4
"""Discs in a row that cover the outline of a loader: with fewer they are wider than it."""

# By how much they are larger: a loader is looked at in places, and what stands on coarse cells [m].
_MARGIN = 0.1


def disc_radius(machine: WheelLoader) -> float:
    """Radius of the discs [m]."""
    return math.hypot(0.5 * machine.bucket_width, 0.5 * machine.length / DISCS) + _MARGIN


def yard_of(
    pile: Pile, machine: WheelLoader, closed: Bool[ArrayLike, "nx ny"] | None = None
) -> Yard:
    """The yard around a pile.

    Args:
        pile: The pile; what its ground is of does not change. Any leaf may be traced.
        machine: What drives there.
        closed: Cells of the pile's grid that nothing may drive on; None: there are none.
    """
    reach = disc_radius(machine)
    cell = pile.cell_size * _COARSE
    border = _border(reach, cell)
    # By numpy where it can be: it compiles nothing.
    traced = is_traced(pile.ground, pile.valid, closed)
    xp: Any = jnp if traced else np
    stands = xp.zeros(pile.height.shape, bool)
    if pile.ground is not None:
        stands = standing(xp.asarray(pile.ground), pile.cell_size)
    if closed is not None:
        stands = stands | xp.asarray(closed)
    unseen = xp.zeros_like(stands)
    if pile.valid is not None:
        unseen = ~xp.asarray(pile.valid)
    middle = 0.5 * (_COARSE - 1) * pile.cell_size

    def flags(cells: Any) -> Any:
        return pooled(cells.astype(np.int8), _COARSE) > 0

    width = [(border, border + (-n - 2 * border) % _BLOCK) for n in flags(stands).shape]
    return Yard(
        standing=on_device(xp.pad(flags(stands), width)),
        unseen=on_device(xp.pad(flags(unseen), width, constant_values=True)),
        origin=jnp.asarray(pile.origin, pile.height.dtype) + (middle - border * cell),
        cell=cell,
        reach=reach,
    )


def _border(reach: float, cell: float) -> int:
    """Cells around the map in which a disc may still touch what is in it."""
    return math.ceil(reach / cell) + 1


@no_type_check
class Depths(struct.PyTreeNode):
    """How deep a disc at each place would be in what it must not touch."""

    depth: Float[Array, "n m"]  # in parts of its radius: 0 is free, 1 is the middle in it
    origin: Float[Array, "2"]  # [m]
    cell: float = struct.field(pytree_node=False)  # [m]


def depths(yard: Yard, pile: Pile) -> Depths:
    """The depths around a pile as it is; without derivatives with respect to its heights."""
    border = _border(yard.reach, yard.cell)
    soil = _most(lax.stop_gradient(pile.height - pile.floor))
    sizes = zip(yard.standing.shape, soil.shape, strict=True)

    def flags(cells: Bool[np.ndarray, "nx ny"]) -> Any:
        return pooled(cells.astype(np.int8), _COARSE) > 0

    width = [(border, whole - part - border) for whole, part in sizes]
    blocked = jnp.pad(soil > CLEARED, width) | yard.standing
    steps = math.ceil(yard.reach / yard.cell)
    far = yard.reach**2
    # The exact squared distance to the nearest blocked cell, along one axis after the other.
    squared = jnp.where(blocked, 0.0, far).astype(soil.dtype)
    for axis in (0, 1):
        width = [(steps, steps) if k == axis else (0, 0) for k in (0, 1)]
        padded = jnp.pad(squared, width, constant_values=far)
        count = squared.shape[axis]
        shifted = (
            lax.slice_in_dim(padded, steps + k, steps + k + count, axis=axis) + (k * yard.cell) ** 2
            for k in range(-steps, steps + 1)
        )
        squared = functools.reduce(jnp.minimum, shifted)
    depth = jnp.maximum(1.0 - jnp.sqrt(squared) / yard.reach, 0.0)
    return Depths(depth, yard.origin, yard.cell)


def _most(values: Float[Array, "nx ny"]) -> Float[Array, "n m"]:
    """Largest value of each coarse cell."""
    nx, ny = values.shape
    grown = jnp.pad(values, ((0, -nx % _COARSE), (0, -ny % _COARSE)), mode="edge")
    parts = [grown[i::_COARSE, j::_COARSE] for i in range(_COARSE) for j in range(_COARSE)]
    return functools.reduce(jnp.maximum, parts)


def depth_at(field: Depths, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The depth between the cells, bilinear; free outside the map."""
    n, m = field.depth.shape
    u = jnp.clip((x - field.origin[0]) / field.cell, 0.0, n - 1.0)
    v = jnp.clip((y - field.origin[1]) / field.cell, 0.0, m - 1.0)
    i = jnp.clip(lax.stop_gradient(u).astype(jnp.int32), 0, n - 2)
    j = jnp.clip(lax.stop_gradient(v).astype(jnp.int32), 0, m - 2)
    a, b = u - i, v - j
    flat, corner = field.depth.reshape(-1), i * m + j
    low = (1.0 - b) * flat[corner] + b * flat[corner + 1]
    high = (1.0 - b) * flat[corner + m] + b * flat[corner + m + 1]
    return (1.0 - a) * low + a * high


def depth_near(field: Depths, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The depth of the cell that places are in: a fifth of the time of `depth_at`, but it jumps."""
    n, m = field.depth.shape
    i = jnp.clip(((x - field.origin[0]) / field.cell + 0.5).astype(jnp.int32), 0, n - 1)
    j = jnp.clip(((y - field.origin[1]) / field.cell + 0.5).astype(jnp.int32), 0, m - 1)
    return field.depth.reshape(-1)[i * m + j]


def is_unseen(yard: Yard, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    """Whether places lie where the scan saw nothing, or outside it."""
    return _flag_near(yard.unseen, yard, x, y)


def is_standing(yard: Yard, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    """Whether something stands still at places."""
    return _flag_near(yard.standing, yard, x, y)


def _flag_near(flags: Bool[Array, "n m"], yard: Yard, x: Array, y: Array) -> Bool[Array, "*n"]:
    n, m = flags.shape
    i = jnp.clip(((x - yard.origin[0]) / yard.cell + 0.5).astype(jnp.int32), 0, n - 1)
    j = jnp.clip(((y - yard.origin[1]) / yard.cell + 0.5).astype(jnp.int32), 0, m - 1)
    return flags.reshape(-1)[i * m + j]


def packed_soil(pile: Pile) -> UInt8[Array, " bytes"]:
    """Cells with more soil than can be driven over, eight to a byte."""
    return jnp.packbits((pile.height - pile.floor > CLEARED).reshape(-1))


def unpacked_soil(packed: UInt8[np.ndarray, " bytes"], shape: tuple[int, ...]) -> np.ndarray:
    """The inverse of `packed_soil`: bool, as the grid of the pile."""
    cells: np.ndarray = np.unpackbits(np.asarray(packed), count=math.prod(shape)).astype(bool)
    return cells.reshape(shape)
