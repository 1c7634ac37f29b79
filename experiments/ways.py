"""The ways to the truck against a search of all ways of one cusp, in random yards."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from experiments._common import exhaustive
from experiments._common.exhaustive import Place
from experiments._common.results import main
from wlplan.io import write_bytes_atomic
from wlplan.planning.clearance import way_clearance
from wlplan.planning.driving import Room, Way, room_of
from wlplan.planning.way import points_of, way_to
from wlplan.planning.yard import yard_of
from wlplan.report.figures import png_bytes
from wlplan.report.figures.style import BLUE, FAINT, new_figure, tidy
from wlplan.site.machine import WA320
from wlplan.site.receiver import Receiver, truck_outline
from wlplan.terrain.standing import CLEARED, standing
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.types import Pile, Pose

COUNT = {"full": 500, "smoke": 3}
# Of the map [m], and its cells.
SIDE, CELL = 40.0, 0.1
# The search keeps this far from everything, as a plan should: it is what its table of cells of
# 0.2 m can be off by, and a little more [m].
MARGIN = 0.2
# Longer ways are not looked for [m].
LONGEST = 60.0
# A way so much longer than the shortest is long, as a part of it.
LONG = 0.1
# Metres in an obstacle from which on a way is said to touch it.
TOUCHES = 0.02


class Scene(NamedTuple):
    """A yard, and from where to where."""

    pile: Pile
    blocked: Bool[np.ndarray, "n n"]
    dig: Place
    start: Place
    goal: Place
    where: exhaustive.Table


def scene(random: np.random.Generator) -> Scene:
    """A pile, none to four walls and containers, a dig and a truck, at random.

    Both ends are such that the loader can stand there and the truck stands on nothing: with a truck
    in the pile there is nothing to be found.
    """
    while True:
        pile = _yard(random)
        digs = edge_poses(toe_contour(pile, machine=WA320), 24)
        row = int(random.integers(24))
        dig = float(digs.x[row]), float(digs.y[row]), float(digs.heading[row])
        back = WA320.approach_distance
        start = dig[0] - back * math.cos(dig[2]), dig[1] - back * math.sin(dig[2]), dig[2]
        away, bearing = random.uniform(2.0, 14.0), dig[2] + random.uniform(0.5, 1.5) * math.pi
        goal = (
            start[0] + away * math.cos(bearing),
            start[1] + away * math.sin(bearing),
            random.uniform(-math.pi, math.pi),
        )
        soil = np.asarray(pile.height - pile.floor > CLEARED)
        blocked = soil | standing(np.asarray(pile.floor), CELL)
        if _truck_stands_on(goal, blocked):
            continue
        cells = np.argwhere(blocked) * CELL - 0.5 * SIDE
        where = exhaustive.table(cells, goal, WA320, MARGIN, SIDE)
        if exhaustive.can_stand(start, where) and exhaustive.can_stand(goal, where):
            return Scene(pile, blocked, dig, start, goal, where)


def _yard(random: np.random.Generator) -> Pile:
    axis = CELL * np.arange(round(SIDE / CELL) + 1) - 0.5 * SIDE
    x, y = np.meshgrid(axis, axis, indexing="ij")
    turn, length = random.uniform(0.0, math.pi), random.uniform(0.0, 8.0)
    along, across = _turned(x, y, (0.0, 0.0, turn))
    far = np.hypot(np.maximum(np.abs(along) - 0.5 * length, 0.0), across)
    soil = np.maximum(random.uniform(2.0, 4.0) - math.tan(math.radians(33.0)) * far, 0.0)
    ground = np.zeros_like(soil)
    for _ in range(random.integers(5)):
        place = (*random.uniform(-14.0, 14.0, 2), random.uniform(0.0, math.pi))
        long, wide = (random.uniform(4.0, 12.0), 0.4) if random.random() < 0.5 else (6.1, 2.4)
        along, across = _turned(x, y, place)
        ground[(np.abs(along) < 0.5 * long) & (np.abs(across) < 0.5 * wide)] = 2.5
    height = np.maximum(soil, ground).astype(np.float32)
    corner = (-0.5 * SIDE, -0.5 * SIDE)
    return Pile(height, CELL, corner, ground=ground.astype(np.float32))


def _turned(x: np.ndarray, y: np.ndarray, place: Place) -> tuple[np.ndarray, np.ndarray]:
    c, s = math.cos(place[2]), math.sin(place[2])
    dx, dy = x - place[0], y - place[1]
    return c * dx + s * dy, c * dy - s * dx


def _truck_stands_on(goal: Place, blocked: Bool[np.ndarray, "n n"]) -> bool:
    axis = CELL * np.arange(len(blocked)) - 0.5 * SIDE
    x, y = np.meshgrid(axis, axis, indexing="ij")
    ahead, left = _turned(x, y, goal)
    near, far, half = truck_outline(WA320)
    on = (ahead > near) & (ahead < far) & (np.abs(left) < half)
    return bool((on & blocked).any())


@jax.jit
def _way(pose: Pose, receiver: Receiver, room: Room) -> tuple[jax.Array, jax.Array, Way]:
    return way_to(pose, receiver, room, WA320)


def run(preset: str) -> dict[str, Any]:
    """Lengths of the ways, ours and the shortest found, and how clear ours are."""
    random = np.random.default_rng(7)
    rows = [_compare(scene(random)) for _ in range(COUNT[preset])]
    return {
        "margin": MARGIN,
        "summary": summary(rows),
        **{name: [row[name] for row in rows] for name in rows[0]},
    }


def _compare(one: Scene) -> dict[str, Any]:
    pose = Pose(*(jnp.float32(v) for v in one.dig))
    receiver = Receiver(*(jnp.float32(v) for v in one.goal))
    length, touching, way = _way(pose, receiver, room_of(yard_of(one.pile, WA320), one.pile))
    points = points_of(way, WA320.turning_radius)
    free = way_clearance(points, one.blocked, one.pile, np.array(one.goal), WA320)
    ours = float(way.length)
    bound = min(1.05 * ours, LONGEST) if free >= MARGIN else LONGEST
    found = exhaustive.shortest(one.start, one.goal, one.where, WA320.turning_radius, bound)
    if free >= MARGIN:
        found = min(found, ours)
    return {
        "ours": round(ours, 3),
        "charged": round(float(length), 3),
        "touching": round(float(touching), 3),
        "clearance": round(free, 3),
        "shortest": round(found, 3) if math.isfinite(found) else None,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of the scenes."""
    there = [row for row in rows if row["shortest"] is not None]
    none = [row for row in rows if row["shortest"] is None]
    ours, shortest, clearance = (
        np.array([row[name] for row in there]) for name in ("ours", "shortest", "clearance")
    )
    clear, longer = clearance >= 0.0, ours / shortest - 1.0
    return {
        "scenes": len(rows),
        "with_a_way": len(there),
        "clear": float(clear.mean()),
        "clear_and_not_long": float((clear & (longer <= LONG)).mean()),
        "longer_by": {
            str(q): round(float(np.quantile(longer[clear], q / 100.0)), 4) for q in (50, 75, 90, 95)
        },
        "without_a_way": len(none),
        "of_these_said_to_touch": sum(row["touching"] > TOUCHES for row in none),
        "of_these_clear_by_less_than_the_margin": sum(row["clearance"] >= 0.0 for row in none),
    }


def draw(folder: Path) -> None:
    """How much longer the ways are, and how clear."""
    result = json.loads((folder / "ways.json").read_text())
    there = [k for k, length in enumerate(result["shortest"]) if length is not None]
    ours, shortest, clearance = (
        np.array(result[name], float)[there] for name in ("ours", "shortest", "clearance")
    )
    figure = new_figure(8.4, 3.0)
    left, right = figure.subplots(1, 2)
    longer = np.sort(100.0 * (ours / shortest - 1.0))
    left.plot(longer, np.arange(1, len(longer) + 1) / len(longer), color=BLUE, lw=1.4)
    left.axvline(100.0 * LONG, color=FAINT, lw=1.0)
    left.axhline(0.95, color=FAINT, lw=1.0)
    left.set_xlim(-2.0, 25.0)
    left.set_xlabel("longer than the shortest that was found [%]", fontsize=8)
    left.set_ylabel("share of the scenes", fontsize=8)
    right.hist(np.clip(clearance, -1.0, 2.0), np.arange(-1.0, 2.01, 0.1), color=BLUE)
    right.axvline(0.0, color=FAINT, lw=1.0)
    right.set_xlabel("least distance to an obstacle [m]", fontsize=8)
    right.set_ylabel("scenes", fontsize=8)
    for panel in (left, right):
        tidy(panel)
    write_bytes_atomic(folder / "ways.png", png_bytes(figure))


if __name__ == "__main__":
    main("ways", run, draw)
