"""Bucket and soil: what the bucket meets, cuts, holds, pushes and spills.

The terrain is the 52 x 52 local heightfield of a dig pose. Columns across the bucket are lanes:
each has its own depth, fill and resistance. The soil in the bucket is kept apart from the
heightfield, one volume a lane; every exchange between the two is antisymmetric, so that their sum
is constant to rounding. During the dig the heightfield slides by the rule of the automaton, once a
time step, so soil runs sideways and down into the cut.

Several cycles are computed side by side, the last axis of every array. So each operation works on
neighbours in memory, and a shift along the heading or across it is one of whole cells: on a CPU
three times as fast as a batch in front. Heightfields carry a rim, one cell all around that repeats
the border, which the automaton needs and which costs more to make anew than to carry along.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from wlplan.constants import CELL_SIZE, GRAVITY
from wlplan.engines.simulator.soil import least_resistance, wedge_of
from wlplan.engines.simulator.walls import in_front
from wlplan.site.machine import WheelLoader
from wlplan.site.soil import Soil
from wlplan.terrain.automaton import FLOW_FRACTION
from wlplan.terrain.automaton.neighbours import NEIGHBOURS
from wlplan.terrain.heightmap import STATE_CELLS, STATE_DISPLACEMENT, local_axes
from wlplan.xla import materialize_if

_ALONG, _LEFT = local_axes(STATE_CELLS, STATE_DISPLACEMENT)
_CELL_AREA = CELL_SIZE**2

# Where the surface ahead of the edge is read, and over which distance its slope is taken [m].
_AHEAD, _SLOPE_LENGTH = 0.2, 0.8
# Depth from which on the whole edge is in the soil [m].
_EDGE_DEPTH = 0.1
# Distance on either side over which the surface is averaged where it is read [m].
_READ_LENGTH = 0.2
# Rake angles and slopes for which the failure wedge makes sense [rad].
_LEAST_RAKE, _GREATEST_RAKE = math.radians(12.0), math.radians(80.0)
_LEAST_SLOPE, _GREATEST_SLOPE = math.radians(-10.0), math.radians(35.0)
# Time that one sweep of the automaton stands for during the dig [s], and so the longest step.
_SLIDE_TIME = 0.02
# Soil pushed out of the bucket is laid down over this distance ahead of the edge [m].
_PUSH_LENGTH = 0.7
# and this far to the left and right of its lane [m].
_PUSH_WIDTH = 2.0


class Bucket(NamedTuple):
    """Cutting edge position [m], tilt [rad], and position of the wall that it cannot pass [m]."""

    x: Float[Array, " b"]
    z: Float[Array, " b"]
    tilt: Float[Array, " b"]
    wall: Float[Array, " b"]


class Reaction(NamedTuple):
    """Forces of the soil on the bucket, the weight of what lies in it included."""

    horizontal: Float[Array, " b"]  # against the direction of travel [N]
    vertical: Float[Array, " b"]  # downward [N]
    moment: Float[Array, " b"]  # about the cutting edge, against tilting back [N m]
    content_mass: Float[Array, " b"]  # soil in the bucket [kg]


def lane_widths(machine: WheelLoader) -> np.ndarray:
    """Width of bucket in each column of the heightfield [m]; the outermost lanes are partial."""
    edge = np.clip((machine.bucket_width / 2 - np.abs(_LEFT)) / CELL_SIZE + 0.5, 0.0, 1.0)
    width: np.ndarray = edge * CELL_SIZE
    return width


class Lanes:
    """The columns of the heightfield that the bucket covers."""

    def __init__(self, machine: WheelLoader):
        widths = lane_widths(machine)
        covered = np.flatnonzero(widths)
        self.first, self.end = int(covered[0]), int(covered[-1]) + 1
        self.width = widths[self.first : self.end, None]  # [lanes, 1] [m]

    @property
    def count(self) -> int:
        """How many there are."""
        return self.end - self.first

    def of(self, field: Float[Array, "n m b"]) -> Float[Array, "i lanes b"]:
        """The lanes of a heightfield with a rim, without the rim."""
        return field[1:-1, 1 + self.first : 1 + self.end]

    def spread(self, values: Float[Array, "lanes b"]) -> Float[Array, "m b"]:
        """One value a lane as one a column of a heightfield with a rim, 0 beside the bucket."""
        return jnp.pad(values, ((1 + self.first, 1 + STATE_CELLS - self.end), (0, 0)))

    def beside(self, values: Float[Array, "2 b"]) -> Float[Array, "1 m b"]:
        """One value a side as one a column of a heightfield with a rim, just beside the bucket."""
        # A bucket as wide as the map has no column beside it: what falls stays in its own.
        right, left = max(self.first - 1, 0), min(self.end, STATE_CELLS - 1)
        columns = jnp.zeros((1, STATE_CELLS, values.shape[1]), values.dtype)
        columns = columns.at[0, right].set(values[0]).at[0, left].set(values[1])
        return jnp.pad(columns, ((0, 0), (1, 1), (0, 0)), mode="edge")


def rimmed(field: Float[Array, "n m b"]) -> Float[Array, "i j b"]:
    """Puts the rim around a field."""
    return jnp.pad(field, ((1, 1), (1, 1), (0, 0)), mode="edge")


def total(values: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """Sum over the leading axis, by halves: XLA's own sum takes ten times as long on a CPU."""
    rest = jnp.zeros_like(values[0])
    while len(values) > 1:
        half = len(values) // 2
        if len(values) % 2:
            rest = rest + values[-1]
        values = values[:half] + values[half : 2 * half]
    return values[0] + rest


def _hat(distance: Array, half_width: float) -> Array:
    """Weights of rows by their distance from a position; their sum over the leading axis is 1."""
    weight = jnp.maximum(1.0 - jnp.abs(distance) / half_width, 0.0)
    return weight / jnp.maximum(total(weight), 1e-6)[None]


def _read(
    field: Float[Array, "n lanes b"], bucket: Bucket, ahead: float
) -> Float[Array, "lanes b"]:
    """The heightfield around a position ahead of the edge, averaged.

    A wall is no soil: up to it, and beyond, the surface goes on as high as it is before it.
    """
    centre = bucket.x + ahead
    count = math.ceil(2.0 * _READ_LENGTH / CELL_SIZE)
    first = jnp.ceil((centre - _READ_LENGTH - _ALONG[0]) / CELL_SIZE)
    first = jnp.clip(first, 0, STATE_CELLS - count).astype(jnp.int32)
    rows = first[None] + jnp.arange(count, dtype=jnp.int32)[:, None]
    weight = _hat(jnp.asarray(_ALONG, field.dtype)[rows] - centre[None], _READ_LENGTH)
    last = jnp.floor((in_front(_ALONG[-1], bucket.wall) - _ALONG[0]) / CELL_SIZE)
    rows = jnp.minimum(rows, jnp.maximum(last, 0.0).astype(jnp.int32)[None])
    return total(weight[:, None] * jnp.take_along_axis(field, rows[:, None], axis=0))


def fullness(
    machine: WheelLoader, soil: Soil, fill: Float[Array, "lanes b"]
) -> Float[Array, "lanes b"]:
    """Fill of each lane over the most of this soil that the bucket takes there [1]."""
    most = soil.fill_factor * machine.bucket_heaped / machine.bucket_width
    return fill / jnp.asarray(_least(Lanes(machine).width) * most, fill.dtype)


def _least(width: np.ndarray) -> np.ndarray:
    """The floor keeps lanes that the bucket hardly covers finite."""
    least: np.ndarray = np.maximum(width, 0.1 * CELL_SIZE)
    return least


def reaction(
    machine: WheelLoader,
    soil: Soil,
    height: Float[Array, "n n b"],
    ground: Float[Array, "n n b"],
    fill: Float[Array, "lanes b"],
    bucket: Bucket,
    wanted: Bool[Array, ""],
    taken: Float[Array, " b"] | float = 0.0,
    backed: Float[Array, " b"] | float = 1.0,
) -> Reaction:
    """Resistance that the soil would put up against the bucket moving forward.

    The edge and the bare part of the floor cut, lane by lane. The content is pushed against the
    pile ahead, rubs on the floor, and carries soil on top and at its back with it. And what lies
    under the floor bears it.

    Args:
        machine: Machine parameters.
        soil: Soil parameters.
        height: Local heightfield with its rim, ground at the dig location at 0 [m].
        ground: Floor under the pile, with its rim [m].
        fill: Volume of soil in each lane of the bucket [m^3].
        bucket: Pose of the bucket.
        wanted: False where no result is wanted.
        taken: Of the fill, what was taken up on the approach, at most [m^3].
        backed: 1; 0 in the approach lane, where no pile stands behind the soil that is met, so
            that it gives way.
    """
    lanes = Lanes(machine)
    width = jnp.asarray(lanes.width, height.dtype)
    met = lanes.of(height)
    near = _read(met, bucket, _AHEAD)
    far = _read(met, bucket, _AHEAD + _SLOPE_LENGTH)
    near, far = materialize_if((near, far), wanted)
    depth = jnp.maximum(near - bucket.z[None], 0.0)
    slope = jnp.clip(jnp.arctan((far - near) / _SLOPE_LENGTH), _LEAST_SLOPE, _GREATEST_SLOPE)
    # Soil in a lane covers the floor that would cut.
    bare = jnp.maximum(1.0 - fullness(machine, soil, fill), 0.0)
    rake = jnp.clip(bucket.tilt[None] + slope, _LEAST_RAKE, _GREATEST_RAKE)
    pressed = bucket.tilt + soil.steel_friction
    wedge = wedge_of(depth * jnp.cos(slope), rake, slope, soil.steel_friction, soil=soil)
    wedge, bare, depth = materialize_if((wedge, bare, depth), wanted)
    cutting = backed * total(width * bare * least_resistance(wedge, soil=soil))
    edge = backed * total(width * jnp.clip(depth / _EDGE_DEPTH, 0.0, 1.0))

    volume = total(fill)
    content = volume * soil.density
    load = content * GRAVITY
    thickness = volume / (machine.bucket_depth * machine.bucket_width)
    # What was taken up in the lane is pushed only as far as the pile stands before it.
    against = backed * jnp.clip(
        total(width * depth) / machine.bucket_width / jnp.maximum(thickness, 1e-3), 0.0, 1.0
    )
    loose = (1.0 - against) * jnp.minimum(taken, volume) * soil.density * GRAVITY
    # As the bucket tilts back its mouth turns upward, and the content is pushed less.
    push = soil.content_push * (load - loose) * (1.0 - jnp.sin(bucket.tilt))
    carried = soil.content_carry * (load - loose)
    bearing, bearing_moment = _bearing(machine, soil, lanes, met, lanes.of(ground), bucket)

    sine, cosine = jnp.sin(bucket.tilt), jnp.cos(bucket.tilt)
    rubbing = math.tan(soil.steel_friction)
    middle = machine.bucket_depth / 2
    return Reaction(
        horizontal=cutting * jnp.sin(pressed)
        + soil.edge_resistance * edge
        + push
        + rubbing * load
        + (sine / cosine + rubbing) * bearing,
        vertical=cutting * jnp.cos(pressed) + load + carried - bearing,
        # The push acts at the middle of the content, its weight there too, what it carries at the
        # back wall.
        moment=bearing_moment
        - (load + 2.0 * carried) * middle * cosine
        - push * (thickness / 2 * cosine - middle * sine),
        content_mass=content,
    )


def _bearing(
    machine: WheelLoader,
    soil: Soil,
    lanes: Lanes,
    height: Float[Array, "n lanes b"],
    ground: Float[Array, "n lanes b"],
    bucket: Bucket,
) -> tuple[Float[Array, " b"], Float[Array, " b"]]:
    """Thrust of the soil under the bucket's floor [N] and its moment about the edge [N m].

    The edge cuts along its path. Where the floor behind it comes lower than this path, because the
    bucket is tilted more than the path is steep, it sinks into what was left standing, and the soil
    resists in proportion to the depth (resistive force theory, Li et al. 2013). The plate's
    thickness counts: a level floor that moves level rests on the soil it has cut.
    """
    count = math.ceil(machine.bucket_depth / CELL_SIZE)
    last = jnp.floor((bucket.x - _ALONG[0]) / CELL_SIZE - 0.5).astype(jnp.int32)
    rows = last[None] - jnp.arange(count, dtype=jnp.int32)[:, None]
    on_map = rows >= 0
    rows = jnp.clip(rows, 0, STATE_CELLS - 1)
    behind = bucket.x[None] - jnp.asarray(_ALONG, height.dtype)[rows]
    length = machine.bucket_depth * jnp.cos(bucket.tilt)[None]
    # Cells that the edge has passed whole, up to the back wall.
    under = jnp.clip(behind / CELL_SIZE - 0.5, 0.0, 1.0) * jnp.clip(
        (length - behind) / CELL_SIZE + 0.5, 0.0, 1.0
    )
    under = jnp.where(on_map, under, 0.0)
    floor = bucket.z[None] - behind * jnp.tan(bucket.tilt)[None] - machine.plate_thickness
    surface = jnp.take_along_axis(height, rows[:, None], axis=0)
    lowest = jnp.take_along_axis(ground, rows[:, None], axis=0)
    sunk = jnp.clip(surface - floor[:, None], 0.0, jnp.maximum(surface - lowest, 0.0))
    width = jnp.asarray(lanes.width, height.dtype)
    thrust = total(jnp.moveaxis(sunk * width[None], 1, 0)) * under
    stiffness = soil.intrusion_stiffness * (1.0 - jnp.sin(bucket.tilt))
    thrust = stiffness[None] * CELL_SIZE * thrust
    return total(thrust), total(thrust * behind)


def move(
    machine: WheelLoader,
    soil: Soil,
    height: Float[Array, "n n b"],
    fill: Float[Array, "lanes b"],
    ground: Float[Array, "n n b"],
    bucket: Bucket,
    reach: tuple[Float[Array, " b"], Float[Array, " b"]],
    step: float,
    wanted: Bool[Array, ""],
) -> tuple[Float[Array, "n n b"], Float[Array, "lanes b"]]:
    """Heightfield and fill after one time step of bucket motion.

    Args:
        machine: Machine parameters.
        soil: Soil parameters.
        height: Local heightfield before the step, with its rim [m].
        fill: Volume in each lane before the step [m^3].
        ground: Floor under the pile, with its rim [m]; nothing is cut below it.
        bucket: Pose of the bucket after the step.
        reach: Furthest position of the cutting edge before and after the step [m].
        step: Time step, at most 0.02 [s].
        wanted: False where no result is wanted.
    """
    dtype = height.dtype
    lanes = Lanes(machine)
    along = jnp.asarray(np.pad(_ALONG, 1, mode="edge"), dtype)[:, None]
    width = jnp.asarray(lanes.width, dtype)
    lane = lanes.spread(width / CELL_SIZE)[None]

    # A lane takes in what the soil already there leaves open of its mouth; the rest is pushed.
    # d fill = (1 - fullness^2) d cut gives fill = most * tanh(cut / most).
    open_part = jnp.maximum(1.0 - fullness(machine, soil, fill) ** 2, 0.0)

    # The edge cuts each cell down to its path. While it crosses a cell, the part passed in this
    # step is taken out of what is left of the cell, so the volume does not depend on the grid.
    x = bucket.x[None]
    before, after = (jnp.clip((r[None] - along) / CELL_SIZE + 0.5, 0.0, 1.0) for r in reach)
    passed = jnp.clip((after - before) / jnp.maximum(1.0 - before, 1e-3), 0.0, 1.0)
    inside = jnp.clip((x - along) / CELL_SIZE + 0.5, 0.0, 1.0) * jnp.clip(
        (along - x + machine.bucket_depth) / CELL_SIZE + 0.5, 0.0, 1.0
    )
    # A machine that brakes badly comes to the end of the map: what it pushes stays on its last row.
    ahead = jnp.minimum(x + _PUSH_LENGTH / 2, float(_ALONG[-1]))
    laid = _hat(along[1:-1] - ahead, _PUSH_LENGTH / 2)
    laid = jnp.pad(laid, ((1, 1), (0, 0)), mode="edge")
    # What stands higher than the side plates falls off to the ground beside them. A whole sweep
    # of the automaton stands for _SLIDE_TIME, a shorter step for its share of one.
    share = step / _SLIDE_TIME
    over = share * _over_the_sides(fill, lanes.width, machine)
    on_map = total(inside[1:-1])
    over = over * (on_map > 1e-6)[None]
    along_sides = inside / jnp.maximum(on_map, 1e-6)[None]
    bucket, open_part, passed, inside, laid, along_sides, over = materialize_if(
        (bucket, open_part, passed, inside, laid, along_sides, over), wanted
    )
    cut = (
        passed[:, None]
        * lane
        * jnp.maximum(height - jnp.maximum(bucket.z[None, None], ground), 0.0)
    )
    swept = total(lanes.of(cut)) * _CELL_AREA
    pushed = (1.0 - open_part) * swept
    swept, pushed = materialize_if((swept, pushed), wanted)
    aside = jnp.asarray(_aside(lanes), dtype) @ (pushed / _CELL_AREA)
    height = (
        height
        - cut
        + laid[:, None] * aside[None]
        + along_sides[:, None] * lanes.beside(over / _CELL_AREA)
    )
    fill = fill + swept - pushed

    # Soil slides. Cells inside the bucket stand at the level of its mouth: empty, that is the
    # cutting edge, and what lies higher ahead runs in; full, nothing does. They give nothing.
    mouth = _read(lanes.of(height), bucket, _AHEAD)
    z = bucket.z[None]
    level = jnp.minimum(mouth, z + (1.0 - open_part) * jnp.maximum(mouth - z, 0.0))
    level = materialize_if(level, wanted)
    occupied = inside[:, None] * lane
    surface = height + occupied * (jnp.maximum(lanes.spread(level)[None], height) - height)
    # A layer thinner than a cell gives in proportion, so none gives what it does not have.
    giving = (1.0 - occupied) * jnp.clip((height - ground) / CELL_SIZE, 0.0, 1.0)
    drop = CELL_SIZE * math.tan(soil.friction)
    largest = soil.slide_rate * _SLIDE_TIME / (FLOW_FRACTION * CELL_SIZE)
    # A branch makes XLA store its inputs and its result. Else it computes them anew wherever they
    # are used, the surface nine times in a cell.
    outflow = lax.cond(
        wanted,
        lambda surface, giving: _outflow(surface, giving, drop, largest),
        lambda surface, _: jnp.zeros_like(_shifted(surface, 0, 0)),
        surface,
        giving,
    )
    change = -share * FLOW_FRACTION * outflow
    gain = jnp.maximum(change, 0.0)
    into_bucket = total(inside[1:-1, None] * gain[:, lanes.first : lanes.end])
    fill = fill + open_part * into_bucket * (width * CELL_SIZE)
    taken = _shifted(occupied, 0, 0) * lanes.spread(open_part)[None, 1:-1] * gain
    slid = _with_rim(_shifted(height, 0, 0) + change - taken)

    # Inside the bucket the lanes level out at the angle of repose, like the terrain.
    fill = fill - share * _lane_outflow(fill, lanes.width, machine, soil)
    return slid, fill.at[0].add(-over[0]).at[-1].add(-over[1])


def _aside(lanes: Lanes) -> np.ndarray:
    """What of the soil pushed out of a lane is laid down in each column, with the rim."""
    column = np.arange(STATE_CELLS)[:, None]
    lane = np.arange(lanes.first, lanes.end)[None]
    reach = np.maximum(1.0 - np.abs(column - lane) * CELL_SIZE / _PUSH_WIDTH, 0.0)
    # Were the rim not raised with the border, soil would slide off the map.
    return np.pad(reach / reach.sum(axis=0), ((1, 1), (0, 0)), mode="edge")


def _shifted(field: Array, i: int, j: int) -> Array:
    """The value of the neighbour at offset (i, j) of every cell inside the rim."""
    n, m, _ = field.shape
    return field[1 + i : n - 1 + i, 1 + j : m - 1 + j]


def _with_rim(field: Array) -> Array:
    """`rimmed`, in the way that is quickest for a field that was just computed."""
    field = jnp.pad(field, ((1, 1), (1, 1), (0, 0)))
    field = field.at[0].set(field[1]).at[-1].set(field[-2])
    return field.at[:, 0].set(field[:, 1]).at[:, -1].set(field[:, -2])


def _outflow(surface: Array, giving: Array, drop: float, largest: float) -> Array:
    """What leaves each cell to its neighbours before `FLOW_FRACTION`, as in the automaton's sweep.

    Args:
        surface: Heightfield with its rim [m].
        giving: Part of its outflow that each cell lets go, with its rim.
        drop: Largest stable height difference between two cells that share a side [m].
        largest: Largest excess height that counts [m]; bounds the flow.
    """
    here, gives = _shifted(surface, 0, 0), _shifted(giving, 0, 0)
    outflow = jnp.zeros_like(here)
    for i, j in NEIGHBOURS:
        difference, stable = here - _shifted(surface, i, j), drop * math.hypot(i, j)
        flow = difference - jnp.clip(difference, -stable, stable)
        flow = jnp.clip(flow, -largest, largest)
        outflow = outflow + flow * jnp.where(flow > 0.0, gives, _shifted(giving, i, j))
    return outflow


def _over_the_sides(fill: Array, width: np.ndarray, machine: WheelLoader) -> Array:
    """What falls from the first and the last lane over the side plates in a sweep [m^3]."""
    ends = np.array([0, -1])
    area = jnp.asarray(_least(width)[ends] * machine.bucket_depth, fill.dtype)
    above = jnp.maximum(fill[ends] / area - machine.side_height, 0.0)
    return FLOW_FRACTION * area * above


def _lane_outflow(fill: Array, width: np.ndarray, machine: WheelLoader, soil: Soil) -> Array:
    thickness = fill / jnp.asarray(_least(width) * machine.bucket_depth, fill.dtype)
    difference = thickness[1:] - thickness[:-1]
    limit = CELL_SIZE * math.tan(soil.friction)
    excess = difference - jnp.clip(difference, -limit, limit)
    shared = np.minimum(width[1:], width[:-1]) * machine.bucket_depth
    flow = jnp.asarray(2.0 * FLOW_FRACTION * shared, fill.dtype) * excess
    return jnp.pad(flow, ((1, 0), (0, 0))) - jnp.pad(flow, ((0, 1), (0, 0)))
