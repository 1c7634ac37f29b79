"""Where the loader dumps: where a person says, or where the ways are short."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from wlplan.errors import InputError
from wlplan.planning.good_ways import good_ways
from wlplan.planning.truck_area import nearest_of, places_inside, stands_inside
from wlplan.planning.way import open_length
from wlplan.planning.yard import yard_of
from wlplan.site.frame import LOCAL, Frame
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.polygon import Polygon
from wlplan.site.presets import check_machine, check_soil
from wlplan.site.receiver import Receiver, receiver_for, stands_of, truck_outline
from wlplan.site.site import Site
from wlplan.terrain.heightmap import sample
from wlplan.terrain.standing import CLEARED, standing
from wlplan.terrain.toe import ToeContour, edge_poses, toe_contour
from wlplan.types import Pile, Pose

# Farthest that a receiver may be from the middle of the map [m].
_FARTHEST = 500.0
# Height above the floor that counts as on the pile [m].
_ON_PILE = 0.5
# Dig locations around the pile; a place is judged by the best three of so many that are nearest:
# some of them the truck is in the way of.
_LOCATIONS, _NEAREST, _BEST = 24, 6, 3
# How far ahead of a dig there has to be soil [m], and which part of what most digs have.
_AHEAD, _WORTH = 3.0, 0.8
_HEADING_STEP = 15.0
# Places for the receiver, in the frame of a dig pose: metres behind it and beside it, and degrees
# between the headings, either side. They have the shortest ways from a straight face, in the mean
# over three digs 3 m apart, of all places 1 m and 15 degrees apart; then two further back.
_STANDS = ((8.0, 4.0, 75.0), (9.0, 3.0, 90.0), (7.0, 6.0, 90.0), (12.0, 0.0, 120.0))
_FURTHER = ((13.0, 6.0, 90.0), (16.0, 4.0, 105.0))
# What a metre of way through an obstacle, and the part of the truck that stands on something or
# where the scan saw nothing, are worth in metres of way.
_TOUCHING, _TRUCK_ON, _TRUCK_UNSEEN = 20.0, 40.0, 2.0
# Places that are judged at once, and by how much the ways in the open may be longer than they have
# to be [m].
_BATCH, _SLACK = 32, 0.5


Closed: TypeAlias = Bool[ArrayLike, "nx ny"] | None
"""Cells of a grid that nothing may drive on; None if there are none."""

TruckArea: TypeAlias = tuple[Polygon, ...] | None
"""Polygons that trucks may stand in; None: they may anywhere."""


def beside(site: Site, pile: Pile, contour: ToeContour | None = None) -> Site:
    """The site with a receiver: its own, or one beside a pile.

    Args:
        site: Any site.
        pile: The pile.
        contour: Its toe where it is known already.

    Raises:
        InputError: If soil or machine make no sense, the truck is not in its area, there is no room
            in that, or there is no place beside the pile since a bucket can start nowhere.
    """
    check_soil(site.soil)
    check_machine(site.machine)
    if site.receiver is not None:
        # Without an area its place may be a value under a trace.
        if site.truck_area is not None:
            for _, truck in stands_of(site.receiver):
                place = place_of(receiver_for(site.receiver, truck))
                _check_inside(place, site.truck_area, site.machine, site.frame)
        return site
    receiver = best_receiver(
        pile,
        machine=site.machine,
        contour=contour,
        closed=site.keep_out,
        area=site.truck_area,
    )
    return site.replace(receiver=receiver)


def place_receiver(
    pile: Pile,
    place: Sequence[float],
    heading: float | None = None,
    *,
    machine: WheelLoader = WA320,
    contour: ToeContour | None = None,
    closed: Closed = None,
    area: TruckArea = None,
    frame: Frame = LOCAL,
) -> Receiver:
    """A receiver at a place.

    Args:
        pile: The pile.
        place: x and y [m], in the frame of the pile.
        heading: Of the loader as it dumps [rad]; None: the one with the shortest ways.
        machine: What drives there.
        contour: Toe of the pile where it is known already.
        closed: Cells of its grid that nothing may drive on.
        area: Polygons that trucks may stand in, in the frame of the pile.
        frame: What complaints give places in.

    Raises:
        InputError: If the place lies on the pile, far away from it or outside the area.
    """
    x, y = (float(value) for value in place)
    size = pile.cell_size * np.array(pile.height.shape)
    low = np.asarray(pile.origin, float)
    away = math.hypot(*(np.array([x, y]) - low - 0.5 * size))
    if not away <= _FARTHEST:
        first, last = frame.scan(*low), frame.scan(*(low + size))
        raise InputError(
            f"the truck at {frame.place(x, y)} is {away:.0f} m from the middle of the scan, which "
            f"spans x {first[0]:.1f} to {last[0]:.1f} and y {first[1]:.1f} to {last[1]:.1f} m: "
            f"give it in the coordinates of the scan."
        )
    dtype = pile.height.dtype
    point = jnp.asarray(x, dtype), jnp.asarray(y, dtype)
    inside = bool(np.all((np.array([x, y]) >= low) & (np.array([x, y]) <= low + size)))
    if inside and float(sample(pile.height - pile.floor, pile, *point)) > _ON_PILE:
        raise InputError(
            f"the truck at {frame.place(x, y)} is on the pile: give a place beside it."
        )
    if heading is None:
        degrees = np.arange(-180.0, 180.0, _HEADING_STEP)
        places = np.array([[x, y, math.radians(d)] for d in degrees])
        inside = places[stands_inside(places, area, machine)]
        if len(inside):
            # Always as many: what looks at them is compiled for their number.
            places = inside[np.arange(len(places)) % len(inside)]
        heading = float(_best(places, pile, machine, contour, closed)[2])
    receiver = Receiver(*point, jnp.asarray(math.remainder(heading, 2.0 * math.pi), dtype))
    _check_inside(place_of(receiver), area, machine, frame)
    return receiver


def _check_inside(
    place: Float[np.ndarray, "3"], area: TruckArea, machine: WheelLoader, frame: Frame
) -> None:
    """Refuses a receiver whose truck is not in its area."""
    if not stands_inside(place[None], area, machine)[0]:
        x, y, heading = (float(value) for value in place)
        raise InputError(
            f"the truck that is loaded from {frame.place(x, y)}, heading "
            f"{math.degrees(heading):.0f}°, does not stand inside the area for trucks: give "
            f"another place, or a larger area."
        )


def best_receiver(
    pile: Pile,
    *,
    machine: WheelLoader = WA320,
    contour: ToeContour | None = None,
    closed: Closed = None,
    area: TruckArea = None,
) -> Receiver:
    """The receiver beside a pile from where the ways to the toe nearby are shortest.

    The truck keeps off the pile and what stands around it, and rather off unseen ground.

    Args:
        pile: The pile.
        machine: What drives there.
        contour: Toe of the pile where it is known already.
        closed: Cells of its grid that nothing may drive on.
        area: Polygons that trucks may stand in, in the frame of the pile.

    Raises:
        InputError: If a bucket can start nowhere on the toe, or there is no room in the area.
    """
    contour = toe_contour(pile, machine=machine) if contour is None else contour
    places = places_around(edge_poses(contour, _LOCATIONS))
    places = where_allowed(places, pile, machine, closed, area)
    return receiver_at(_best(places, pile, machine, contour, closed), pile)


def places_around(digs: Pose) -> Float[np.ndarray, "n 3"]:
    """Places x [m], y [m], heading [rad] from where a V-turn to some dig is short.

    Args:
        digs: Dig poses, leaves [m].
    """
    x, y, into = (np.asarray(v, float)[:, None] for v in (digs.x, digs.y, digs.heading))
    back, side, turn = np.array(
        [(b, sign * s, sign * t) for b, s, t in (*_STANDS, *_FURTHER) for sign in (1.0, -1.0)]
    ).T
    places: np.ndarray = np.stack(
        [
            x - back * np.cos(into) - side * np.sin(into),
            y - back * np.sin(into) + side * np.cos(into),
            into + np.radians(turn),
        ],
        axis=-1,
    ).reshape(-1, 3)
    return places


def where_allowed(
    places: Float[np.ndarray, "n 3"],
    pile: Pile,
    machine: WheelLoader,
    closed: Closed,
    area: TruckArea,
) -> Float[np.ndarray, "n 3"]:
    """Places like those that are given whose trucks are in their area, and stand on nothing there.

    Args:
        places: x [m], y [m] and heading [rad] of receivers.
        pile: The pile.
        machine: What drives there.
        closed: Cells of its grid that nothing may drive on.
        area: The polygons; None: the places stay as they are.

    Raises:
        InputError: If there is no room in the area.
    """
    if area is None:
        return places
    allowed = places_inside(area, machine)
    allowed = np.concatenate([allowed, places[stands_inside(places, area, machine)]])
    on, _ = truck_stands_on(allowed, pile, not_for_trucks(pile, closed), machine)
    if not (on == 0.0).any():
        raise InputError(
            "there is no room in the area for trucks: wherever one fits, it would stand on soil, "
            "on what stands there or on closed ground; draw the area elsewhere."
        )
    return nearest_of(allowed[on == 0.0], places, machine)


def place_of(receiver: Receiver) -> Float[np.ndarray, "3"]:
    """X [m], y [m] and heading [rad] of a receiver, on the host."""
    return np.array([float(value) for value in (receiver.x, receiver.y, receiver.heading)])


def receiver_at(place: Float[np.ndarray, "3"], pile: Pile) -> Receiver:
    """The receiver at a place x [m], y [m], heading [rad], in the precision of a pile."""
    x, y, heading = (float(value) for value in place)
    heading = math.remainder(heading, 2.0 * math.pi)
    return Receiver(*(jnp.asarray(v, pile.height.dtype) for v in (x, y, heading)))


def _best(
    places: Float[np.ndarray, "n 3"],
    pile: Pile,
    machine: WheelLoader,
    contour: ToeContour | None,
    closed: Closed,
) -> Float[np.ndarray, "3"]:
    """The place x [m], y [m], heading [rad] with the shortest ways and room for the truck."""
    contour = toe_contour(pile, machine=machine) if contour is None else contour
    digs = edge_poses(contour, _LOCATIONS)
    poses = np.stack([np.asarray(v, float) for v in (digs.x, digs.y, digs.heading)], axis=-1)
    poses = poses[_yields(poses, pile, machine)]
    apart = np.hypot(*(places[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
    nearest = poses[np.argsort(apart, axis=1)[:, :_NEAREST]]
    yard, dtype = yard_of(pile, machine, closed), pile.height.dtype
    truck = cost_of_truck(places, pile, machine, closed)
    # The shortest ways come first: once one is found, most of the others need no look.
    lengths = way_lengths(places.astype(dtype), nearest.astype(dtype), machine)
    lengths = np.asarray(lengths)
    bound = np.sort(lengths, axis=1)[:, :_BEST].mean(axis=1) + truck
    order = np.argsort(bound)
    order = np.concatenate([order, np.repeat(order[-1:], -len(order) % _BATCH)])
    best, least = 0, np.inf
    for part in order.reshape(-1, _BATCH):
        if bound[part[0]] - _SLACK > least:
            break
        receivers = Receiver(*places[part].repeat(nearest.shape[1], axis=0).T.astype(dtype))
        ends = Pose(*nearest[part].reshape(-1, 3).T.astype(dtype)), receivers
        found = good_ways(pile, yard, machine, *ends)
        ways = found.length + _TOUCHING * found.touching
        ways = np.sort(ways.reshape(len(part), -1), axis=1)[:, :_BEST]
        cost = ways.mean(axis=1) + truck[part]
        if cost.min() < least:
            best, least = int(part[cost.argmin()]), float(cost.min())
    chosen: np.ndarray = places[best]
    return chosen


def _yields(
    poses: Float[np.ndarray, "n 3"], pile: Pile, machine: WheelLoader
) -> Bool[np.ndarray, " n"]:
    """Whether a dig has about as much soil ahead of it as most have: a spur has not."""
    ahead, left = np.meshgrid(
        np.linspace(0.0, _AHEAD, 13), machine.bucket_width * np.linspace(-0.5, 0.5, 7)
    )
    c, s = np.cos(poses[:, 2, None, None]), np.sin(poses[:, 2, None, None])
    x = poses[:, 0, None, None] + ahead * c - left * s
    y = poses[:, 1, None, None] + ahead * s + left * c
    above = np.asarray(_above(pile, *(axis.astype(pile.height.dtype) for axis in (x, y))))
    soil = above.mean(axis=(1, 2))
    enough: np.ndarray = soil >= _WORTH * np.median(soil)
    return enough


@jax.jit
def _above(pile: Pile, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Height of the surface over the ground at places [m]."""
    return sample(pile.height - pile.floor, pile, x, y)


@functools.partial(jax.jit, static_argnames="machine")
def way_lengths(
    places: Float[Array, "n 3"], poses: Float[Array, "n m 3"], machine: WheelLoader
) -> Float[Array, "n m"]:
    """Length of the ways from poses to receivers, were nothing in the way [m]."""

    def one(place: Array, at: Array) -> Array:
        return open_length(Pose(*at), Receiver(*place), machine)

    return jax.vmap(jax.vmap(one, in_axes=(None, 0)))(places, poses)


def truck_cells(
    places: Float[np.ndarray, "n 3"], machine: WheelLoader
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """X and y of points all over the truck that belongs to receivers [m]."""
    near, far, half = truck_outline(machine)
    ahead, left = (
        a.ravel()
        for a in np.meshgrid(np.linspace(near, far, 7), np.linspace(-half, half, 15), indexing="ij")
    )
    x, y, heading = (places[:, k, None] for k in range(3))
    return (
        x + ahead * np.cos(heading) - left * np.sin(heading),
        y + ahead * np.sin(heading) + left * np.cos(heading),
    )


def cost_of_truck(
    places: Float[np.ndarray, "n 3"], pile: Pile, machine: WheelLoader, closed: Closed = None
) -> Float[np.ndarray, " n"]:
    """What it costs that a truck stands on something or on unseen ground [m]."""
    on, unseen = truck_stands_on(places, pile, not_for_trucks(pile, closed), machine)
    cost: np.ndarray = _TRUCK_ON * on + _TRUCK_UNSEEN * unseen
    return cost


def not_for_trucks(
    pile: Pile, closed: Closed = None, soil: Bool[np.ndarray, "nx ny"] | None = None
) -> Bool[np.ndarray, "nx ny"]:
    """Cells that a truck must not stand on: soil, what stands there, closed ground.

    Args:
        pile: The pile.
        closed: Cells of its grid that nothing may drive on.
        soil: Cells with more soil than can be driven over; None: those of the pile.
    """
    floor = np.asarray(pile.floor)
    if soil is None:
        soil = np.asarray(pile.height) - floor > CLEARED
    blocked: np.ndarray = soil | standing(floor, pile.cell_size)
    return blocked if closed is None else blocked | np.asarray(closed)


def truck_stands_on(
    places: Float[np.ndarray, "n 3"],
    pile: Pile,
    blocked: Bool[np.ndarray, "nx ny"],
    machine: WheelLoader,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Which part of the truck of receivers stands on blocked cells, and which on unseen ground."""
    x, y = truck_cells(places, machine)
    origin, shape = np.asarray(pile.origin, float), pile.height.shape
    i, j = (np.rint((v - origin[k]) / pile.cell_size) for k, v in enumerate((x, y)))
    inside = (i >= 0) & (j >= 0) & (i < shape[0]) & (j < shape[1])
    i, j = (np.clip(v, 0, n - 1).astype(int) for v, n in zip((i, j), shape, strict=True))
    seen = inside if pile.valid is None else inside & np.asarray(pile.valid)[i, j]
    return (inside & blocked[i, j]).mean(axis=-1), 1.0 - seen.mean(axis=-1)
