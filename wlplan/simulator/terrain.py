"""Bucket and soil: what the bucket meets, cuts, holds, pushes and spills.

The terrain is the 52 x 52 local heightfield of a dig pose. Columns across the bucket are lanes:
each has its own depth, fill and resistance. The soil in the bucket is kept apart from the
heightfield, one volume a lane; every exchange between the two is antisymmetric, so that their sum
is constant to rounding. During the dig the heightfield slides by the rule of the automaton, once a
time step, so soil runs sideways and down into the cut.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wlplan.automaton import FLOW_FRACTION, sweep
from wlplan.heightmap import STATE_CELLS, STATE_DISPLACEMENT, local_axes
from wlplan.machine import Soil, WheelLoader
from wlplan.simulator.soil import earthmoving_force
from wlplan.units import CELL_SIZE, GRAVITY

_ALONG, _LEFT = local_axes(STATE_CELLS, STATE_DISPLACEMENT)
_CELL_AREA = CELL_SIZE**2

# Where the surface ahead of the edge is read, and over which distance its slope is taken [m].
_AHEAD, _SLOPE_LENGTH = 0.2, 0.8
# Rake angles and slopes for which the failure wedge makes sense [rad].
_LEAST_RAKE, _GREATEST_RAKE = math.radians(12.0), math.radians(80.0)
_LEAST_SLOPE, _GREATEST_SLOPE = math.radians(-10.0), math.radians(35.0)
# Time that one sweep of the automaton stands for during the dig [s], and so the longest step.
_SLIDE_TIME = 0.02
# Soil pushed out of the bucket is laid down over this distance ahead of the edge [m].
_PUSH_LENGTH = 0.7


class Bucket(NamedTuple):
    """Cutting edge position [m], tilt [rad]."""

    x: Float[Array, ""]
    z: Float[Array, ""]
    tilt: Float[Array, ""]


class Reaction(NamedTuple):
    """Forces of the soil on the bucket."""

    horizontal: Float[Array, ""]  # against the direction of travel [N]
    vertical: Float[Array, ""]  # downward at the cutting edge, without the content's weight [N]
    content_mass: Float[Array, ""]  # soil in the bucket [kg]


def lane_widths(machine: WheelLoader) -> np.ndarray:
    """Width of bucket in each column of the heightfield [m]; the outermost lanes are partial."""
    edge = np.clip((machine.bucket_width / 2 - np.abs(_LEFT)) / CELL_SIZE + 0.5, 0.0, 1.0)
    return edge * CELL_SIZE


def _hat(centre: Array, half_width: float, dtype: np.dtype) -> Array:
    """Weights over the rows that average the heightfield around a position along the heading."""
    distance = jnp.abs(jnp.asarray(_ALONG, dtype) - centre) / half_width
    weight = jnp.maximum(1.0 - distance, 0.0)
    return weight / jnp.maximum(weight.sum(), 1e-6)


def fullness(machine: WheelLoader, fill: Float[Array, " n"]) -> Float[Array, " n"]:
    """Fill of each lane over what the heaped bucket holds there [1]."""
    width = jnp.asarray(lane_widths(machine), fill.dtype)
    heaped = machine.bucket_heaped / machine.bucket_width
    # The floor keeps lanes outside the bucket, which stay empty, finite.
    return fill / (jnp.maximum(width, 0.1 * CELL_SIZE) * heaped)


def reaction(
    machine: WheelLoader,
    soil: Soil,
    height: Float[Array, "n n"],
    fill: Float[Array, " n"],
    bucket: Bucket,
) -> Reaction:
    """Resistance that the soil would put up against the bucket moving forward.

    Args:
        machine: Machine parameters.
        soil: Soil parameters.
        height: Local heightfield, ground at the dig location at 0 [m].
        fill: Volume of soil in each lane of the bucket [m^3].
        bucket: Pose of the bucket.
    """
    dtype = height.dtype
    width = jnp.asarray(lane_widths(machine), dtype)
    near = _hat(bucket.x + _AHEAD, 0.2, dtype) @ height
    far = _hat(bucket.x + _AHEAD + _SLOPE_LENGTH, 0.2, dtype) @ height
    depth = jnp.maximum(near - bucket.z, 0.0)
    slope = jnp.clip(jnp.arctan((far - near) / _SLOPE_LENGTH), _LEAST_SLOPE, _GREATEST_SLOPE)
    # An empty bucket cuts with its floor; a full one pushes with the wedge at its back wall.
    full = jnp.clip(fullness(machine, fill) / soil.wall_fullness, 0.0, 1.0)
    full = full**2 * (3.0 - 2.0 * full)
    floor = bucket.tilt
    blade = floor + jnp.maximum(soil.wall_inclination - floor, 0.0) * full
    friction = soil.steel_friction + (soil.friction - soil.steel_friction) * full
    rake = jnp.clip(blade + slope, _LEAST_RAKE, _GREATEST_RAKE)
    force = soil.force_scale * earthmoving_force(
        depth * jnp.cos(slope), rake, slope, soil=soil, external_friction=friction
    )
    weight = soil.density * GRAVITY
    edge = soil.edge_resistance * jnp.clip(depth / 0.1, 0.0, 1.0)
    edge = edge + soil.edge_bearing * weight * depth
    content = fill.sum() * soil.density
    # Both side plates: earth pressure at rest, and friction.
    middle = (width * depth).sum() / machine.bucket_width
    sides = (1.0 - math.sin(soil.friction)) * weight * middle**2 * machine.bucket_depth
    horizontal = (width * (force * jnp.sin(blade + friction) + edge)).sum() + math.tan(
        soil.steel_friction
    ) * (content * GRAVITY + sides)
    vertical = (width * force * jnp.cos(blade + friction)).sum()
    return Reaction(horizontal, vertical, content)


def move(
    machine: WheelLoader,
    soil: Soil,
    height: Float[Array, "n n"],
    fill: Float[Array, " n"],
    ground: Float[Array, "n n"],
    bucket: Bucket,
    reach: tuple[Float[Array, ""], Float[Array, ""]],
    step: float,
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Heightfield and fill after one time step of bucket motion.

    Args:
        machine: Machine parameters.
        soil: Soil parameters.
        height: Local heightfield before the step [m].
        fill: Volume in each lane before the step [m^3].
        ground: Floor under the pile [m]; nothing is cut below it.
        bucket: Pose of the bucket after the step.
        reach: Furthest position of the cutting edge before and after the step [m].
        step: Time step, at most 0.02 [s].
    """
    dtype = height.dtype
    along = jnp.asarray(_ALONG, dtype)
    width = jnp.asarray(lane_widths(machine), dtype)
    lane = (width / CELL_SIZE)[None, :]

    # A lane takes in what the soil already there leaves open of its mouth; the rest is pushed.
    # d fill = (1 - fullness^2) d cut gives fill = heaped * tanh(cut / heaped).
    open_part = jnp.maximum(1.0 - fullness(machine, fill) ** 2, 0.0)

    # The edge cuts each cell down to its path. While it crosses a cell, the part passed in this
    # step is taken out of what is left of the cell, so the volume does not depend on the grid.
    before, after = (jnp.clip((r - along) / CELL_SIZE + 0.5, 0.0, 1.0) for r in reach)
    passed = (after - before) / jnp.maximum(1.0 - before, 1e-3)
    cut = jnp.clip(passed, 0.0, 1.0)[:, None] * lane
    cut = cut * jnp.maximum(height - jnp.maximum(bucket.z, ground), 0.0)
    height = height - cut
    swept = cut.sum(0) * _CELL_AREA
    pushed = (1.0 - open_part) * swept
    laid = _hat(bucket.x + _PUSH_LENGTH / 2, _PUSH_LENGTH / 2, dtype)
    height = height + laid[:, None] * (pushed / _CELL_AREA)[None, :]
    fill = fill + swept - pushed

    # Soil slides. Cells inside the bucket stand at the level of its mouth: empty, that is the
    # cutting edge, and what lies higher ahead runs in; full, nothing does. They give nothing.
    mouth = _hat(bucket.x + _AHEAD, 0.2, dtype) @ height
    level = jnp.minimum(mouth, bucket.z + (1.0 - open_part) * jnp.maximum(mouth - bucket.z, 0.0))
    inside = jnp.clip((bucket.x - along) / CELL_SIZE + 0.5, 0.0, 1.0) * jnp.clip(
        (along - bucket.x + machine.bucket_depth) / CELL_SIZE + 0.5, 0.0, 1.0
    )
    occupied = inside[:, None] * lane
    surface = height + occupied * (jnp.maximum(level[None, :], height) - height)
    # A whole sweep stands for _SLIDE_TIME, a shorter step for its share of one.
    share = step / _SLIDE_TIME
    largest = soil.slide_rate * _SLIDE_TIME / (FLOW_FRACTION * CELL_SIZE)
    drop = CELL_SIZE * math.tan(soil.friction)
    # A layer thinner than a cell gives in proportion, so none gives what it does not have.
    giving = (1.0 - occupied) * jnp.clip((height - ground) / CELL_SIZE, 0.0, 1.0)
    slid = sweep(surface, drop, largest=largest, giving=giving)
    change = share * (slid - surface)
    into_bucket = occupied * open_part[None, :] * jnp.maximum(change, 0.0)
    height = height + change - into_bucket
    fill = fill + into_bucket.sum(0) * _CELL_AREA

    # Inside the bucket the lanes level out at the angle of repose, like the terrain.
    return height, fill - share * _lane_outflow(fill, width, machine, soil)


def _lane_outflow(fill: Array, width: Array, machine: WheelLoader, soil: Soil) -> Array:
    thickness = fill / (jnp.maximum(width, 0.1 * CELL_SIZE) * machine.bucket_depth)
    difference = thickness[1:] - thickness[:-1]
    limit = CELL_SIZE * math.tan(soil.friction)
    excess = difference - jnp.clip(difference, -limit, limit)
    shared = jnp.minimum(width[1:], width[:-1]) * machine.bucket_depth
    flow = 2.0 * FLOW_FRACTION * excess * shared
    return jnp.pad(flow, (1, 0)) - jnp.pad(flow, (0, 1))
