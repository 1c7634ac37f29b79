"""One loading cycle, moment by moment, from the side: machine, soil, and what lies in the bucket.

Paper, figure 6: an image sequence of a simulated loading cycle. All of it is the state of the
simulator: poses of boom and bucket, the surface along the middle of the bucket as it is dug at that
time, and the soil in the bucket there. After the retreat the pile has slid to rest.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex

import wlplan
from experiments._common.places import say
from experiments._common.results import main
from experiments._common.side_view import Stance, draw_loader
from wlplan.engines.simulator import Section, Settings, Simulator, Trajectory, trace_section
from wlplan.io import write_bytes_atomic
from wlplan.report.figures import png_bytes
from wlplan.report.figures.relief import PILE
from wlplan.report.figures.style import FAINT, INK, new_figure, tidy
from wlplan.site.machine import WA320
from wlplan.terrain.heightmap import (
    STATE_CELLS,
    STATE_DISPLACEMENT,
    local_axes,
    sample,
    sample_local,
    to_world,
)
from wlplan.types import Action, Pile, Pose

SLOPE, HEIGHT, SEED = 30.0, 4.0, 3
ACTION = Action(0.2, 2.0, 0.3, 3.0)
# How far the shown ground goes, from behind the machine into the pile [m], and its points.
BEHIND, AHEAD, STEP = -13.5, 6.5, 0.1
# Part of the load that has been filled in a moment of its own, and part of the tilt.
_FILLED, _TILTED = 0.5, 0.5
_SOIL = to_hex(PILE(0.45))


def run(preset: str) -> dict[str, Any]:
    """Plays one cycle on a relaxed cone, and keeps what is seen at eight moments."""
    settings = Settings(step=0.02) if preset == "smoke" else Settings(step=0.005)
    pile = wlplan.relax(
        wlplan.seed_pile("conical", slope=math.radians(SLOPE), height=HEIGHT, seed=SEED)
    )
    pose = _head_on(pile)
    say(f"a cycle in steps of {settings.step} s")
    local = sample_local(pile, pose, cells=STATE_CELLS, displacement=STATE_DISPLACEMENT)
    path, section = jax.tree.map(
        np.asarray,
        jax.jit(lambda height: trace_section(height, 0.0 * height, ACTION, settings=settings))(
            local.height
        ),
    )
    after, performance = Simulator(settings=settings)(pile, pose, ACTION)
    ground = float(sample(pile.height, pile, *_on_line(pose, np.array([-STATE_DISPLACEMENT])))[0])
    line = np.arange(BEHIND, AHEAD, STEP)
    around, settled = (
        np.asarray(sample(one.height, one, *_on_line(pose, line)), np.float64) - ground
        for one in (pile, after)
    )
    return {
        "action": dataclasses.asdict(ACTION),
        "slope_degrees": SLOPE,
        "along_m": [BEHIND, STEP],
        "before_cm": _centimetres(around),
        "performance": {
            name: round(float(getattr(performance, name)), 3) for name in ("mass", "time", "work")
        },
        "moments": _moments(path, section, line, around, settled, float(performance.time)),
    }


def _head_on(pile: Pile) -> Pose:
    """On the toe of a pile around the origin, to the south, heading for its middle."""
    y = np.linspace(-12.0, 0.0, 1201)
    height = sample(pile.height, pile, jnp.zeros(len(y)), jnp.asarray(y, jnp.float32))
    toe = float(y[int(np.argmax(np.asarray(height) > 0.05))])
    return Pose(jnp.asarray(0.0), jnp.asarray(toe), jnp.asarray(0.5 * math.pi))


def _on_line(pose: Pose, along: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """World positions of points on the line of the heading [m]."""
    ahead = jnp.asarray(along, jnp.float32)
    return to_world(pose, ahead, 0.0 * ahead)


def _moments(
    path: Trajectory,
    section: Section,
    line: np.ndarray,
    around: np.ndarray,
    settled: np.ndarray,
    whole: float,
) -> list[dict[str, Any]]:
    """What is shown: names, where everything is, and where the soil lies.

    Args:
        path: Of the cycle.
        section: Likewise.
        line: Points of the shown ground along the heading [m].
        around: Surface there before the cycle [m].
        settled: Surface there once all has slid to rest [m].
        whole: Time of the cycle, the retreat included [s].
    """
    stop, end = (int(np.argmax(path.phase >= phase)) for phase in (1, 2))
    deepest = int(np.argmax(path.tip_x[: end + 1]))
    tilted = path.tilt >= _TILTED * WA320.tilt_end
    chosen = {
        "approach": 0,
        "entry": int(np.argmax(path.tip_x > 0.35)),
        "filling": int(np.argmax(path.mass > _FILLED * path.mass[-1])),
        "tilting": max(int(np.argmax(tilted)), 1),
        "stop": stop,
        "tilted back": max(end, deepest),
    }
    along, _ = local_axes(STATE_CELLS, STATE_DISPLACEMENT)
    found = []
    for name, n in sorted(chosen.items(), key=lambda pair: pair[1]):
        surface = around.copy()
        inside = (line >= along[0]) & (line <= along[-1])
        surface[inside] = np.interp(line[inside], along, section.surface[n])
        stance = _stance(path, section, n)
        found.append(_moment(name, float(path.time[n]), stance, surface, float(path.mass[n])))
    last = _stance(path, section, -1)
    # It goes back to where the cycle began.
    way = WA320.approach_distance + last.tip_x
    dug = np.array(found[-1]["surface_cm"]) * 0.01
    time_back = whole - float(path.time[-1])
    for name, part, surface in (("retreat", 0.4, dug), ("back, soil at rest", 1.0, settled)):
        stance = last.carried_back(WA320, part * way)
        seconds = float(path.time[-1]) + part * time_back
        found.append(_moment(name, seconds, stance, surface, float(path.mass[-1])))
    return found


def _stance(path: Trajectory, section: Section, n: int) -> Stance:
    """Of the n-th moment."""
    return Stance(
        tip_x=float(path.tip_x[n]),
        tip_z=float(path.tip_z[n]),
        tilt=float(path.tilt[n]),
        boom=float(path.boom[n]),
        content=float(section.content[n]),
    )


def _moment(
    name: str, seconds: float, stance: Stance, surface: np.ndarray, mass: float
) -> dict[str, Any]:
    return {
        "name": name,
        "time_s": round(seconds, 2),
        "mass_t": round(1e-3 * mass, 3),
        **{key: round(float(value), 4) for key, value in dataclasses.asdict(stance).items()},
        "surface_cm": _centimetres(surface),
    }


def _centimetres(heights: np.ndarray) -> list[float]:
    rounded: list[float] = np.round(100.0 * heights, 1).tolist()
    return rounded


def draw(folder: Path) -> None:
    """Eight moments, in the order of reading."""
    result = json.loads((folder / "cycle_sequence.json").read_text())
    moments = result["moments"]
    figure = new_figure(12.0, 2.2 * math.ceil(len(moments) / 2))
    panels = figure.subplots(math.ceil(len(moments) / 2), 2, sharex=True, sharey=True).ravel()
    first, step = result["along_m"]
    line = first + step * np.arange(len(result["before_cm"]))
    before = 0.01 * np.array(result["before_cm"])
    for panel, moment in zip(panels, moments, strict=False):
        _draw_moment(panel, moment, line, before)
    for panel in panels[-2:]:
        panel.set_xlabel("ahead of the dig location [m]", fontsize=8)
    for panel in panels[::2]:
        panel.set_ylabel("height [m]", fontsize=8)
    action = ", ".join(f"{value:g}" for value in result["action"].values())
    played = result["performance"]
    figure.suptitle(
        f"Action ({action}) on a cone of {result['slope_degrees']:.0f}°: {played['mass']:.2f} t in "
        f"{played['time']:.1f} s with {played['work']:.0f} kJ. Dashed: the surface before. Surface "
        "and load in the plane through the middle of the bucket",
        fontsize=8,
        color=FAINT,
    )
    write_bytes_atomic(folder / "cycle_sequence.png", png_bytes(figure, dpi=110))


def _draw_moment(panel: Axes, moment: dict[str, Any], line: np.ndarray, before: np.ndarray) -> None:
    surface = 0.01 * np.array(moment["surface_cm"])
    panel.fill_between(line, surface, -0.4, color=_SOIL, lw=0.0, zorder=1)
    panel.plot(line, surface, color=INK, lw=0.7, zorder=8)
    panel.plot(line, before, color=FAINT, lw=0.8, ls="--", zorder=8)
    stance = Stance(*(moment[field.name] for field in dataclasses.fields(Stance)))
    draw_loader(panel, stance, WA320, soil=_SOIL)
    panel.set_xlim(line[0], line[-1])
    panel.set_ylim(-0.4, 4.0)
    panel.set_aspect("equal")
    panel.set_title(
        f"{moment['name']}: {moment['time_s']:.1f} s, {moment['mass_t']:.2f} t in the bucket",
        fontsize=9,
        color=INK,
    )
    tidy(panel, grid=False)


if __name__ == "__main__":
    main("cycle_sequence", run, draw)
