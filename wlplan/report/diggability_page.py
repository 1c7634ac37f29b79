"""The page of a diggability map. What it says and how stands in `diggability.html.j2`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from wlplan.constants import QUANTITIES
from wlplan.report import figures
from wlplan.report.figures import Shade
from wlplan.report.scene import ground_of, height_at
from wlplan.report.template import Gallery, Picture, rendered
from wlplan.site.frame import frame_recorded
from wlplan.types import Pile, Pose

REPORT_NAME = "report.html"

# Places in each half of the table; pixels an inch; how far marks stand above the ground [m].
_BEST, _DPI, _ABOVE = 5, 130, 0.12


def render_map(
    document: Mapping[str, Any], pile: Pile, *, settings: Mapping[str, str] | None = None
) -> str:
    """The page as HTML. Every text is escaped.

    Args:
        document: Content of a diggability.json.
        pile: The pile that it is of, in the frame of the document.
        settings: Further lines for the table of settings, by name.
    """
    shades = shades_of(document)
    by = "cost" if "cost" in shades else "rate"
    order = np.argsort(shades[by].values, kind="stable")
    if shades[by].much_is_good:
        order = order[::-1]
    few = min(_BEST, len(order) // 2)
    return rendered(
        "diggability.html.j2",
        scene=_scene(document, pile, shades),
        document=document,
        offset=frame_recorded(document).offset,
        shades=shades,
        by=by,
        best=order[: max(few, 1)].tolist(),
        worst=order[len(order) - few :][::-1].tolist(),
        galleries=[_gallery(document, pile, shades)],
        settings=settings or {},
        optimised=_optimised(document),
    )


def _optimised(document: Mapping[str, Any]) -> dict[str, float] | None:
    """What the best heading and action of each place are worth; None: they were not searched."""
    places = document["locations"]
    if not places or not all("fixed" in place and "gain" in place for place in places):
        return None
    best, fixed = (
        np.array([one[q] for one in rows for q in ("mass", "time", "rate")], float).reshape(-1, 3)
        for rows in (places, [place["fixed"] for place in places])
    )
    found = {
        f"{name}_{q}": float(values[:, k].mean())
        for name, values in (("best", best), ("fixed", fixed))
        for k, q in enumerate(("mass", "time", "rate"))
    }
    gain = np.array([place["gain"] for place in places], float)
    turned = np.abs([place["offset"] for place in places])
    return {**found, "gain": float(np.median(gain)), "turned": float(np.median(turned))}


def shades_of(document: Mapping[str, Any]) -> dict[str, Shade]:
    """What is known of all locations of a diggability.json, by name: what is loaded first."""
    places = document["locations"]

    def values(name: str) -> np.ndarray:
        return np.array([place[name] for place in places], float)

    shades = {
        name: Shade(title, unit, digits, values(name), name == "mass")
        for name, (title, unit, digits) in QUANTITIES.items()
    }

    def known(name: str) -> bool:
        return bool(places) and all(name in place for place in places)

    rate = 3600.0 * shades["mass"].values / np.maximum(shades["time"].values, 1e-9)
    title = "rate of the cycle" if known("transport") else "rate of digging"
    rate = values("rate") if known("rate") else rate
    shades["rate"] = Shade(title, "t/h", 0, rate, True)
    if known("fixed"):
        fixed = np.array([place["fixed"]["rate"] for place in places], float)
        shades["fixed"] = Shade("rate with one action everywhere", "t/h", 0, fixed, True)
    if known("gain"):
        shades["gain"] = Shade("gain", "%", 0, values("gain"), True)
    if known("cost"):
        shades["cost"] = Shade("cost", "1", 2, values("cost"), False)
    if known("deviation"):
        # Of what is divided: the errors of mass and time count as independent.
        parts = [
            np.array([place["deviation"][q] for place in places], float)
            / np.maximum(np.abs(shades[q].values), 1e-9)
            for q in ("mass", "time")
        ]
        shades["deviation"] = Shade(
            "deviation of mass and time", "%", 1, 100.0 * np.hypot(*parts), False
        )
    return shades


def map_figure(document: Mapping[str, Any], pile: Pile) -> Figure:
    """Maps of what a diggability.json holds: mass, time and work; if optimised, rate and gain too.

    Args:
        document: Its content.
        pile: The pile that it is of, in the frame of the document.
    """
    shades = shades_of(document)
    names = [*QUANTITIES, *(("rate", "gain") if "gain" in shades else ())]
    return figures.shades_figure(
        pile, _poses(document), [shades[name] for name in names], frame=frame_recorded(document)
    )


def _poses(document: Mapping[str, Any]) -> Pose:
    columns = ([place[name] for place in document["locations"]] for name in ("x", "y", "heading"))
    return Pose(*(np.array(column, float) for column in columns))


def _gallery(document: Mapping[str, Any], pile: Pile, shades: Mapping[str, Shade]) -> Gallery:
    pose, frame = _poses(document), frame_recorded(document)
    pictures = []
    for shade in shades.values():
        place = document["locations"][shade.best]
        pictures.append(
            Picture(
                figures.png_bytes(
                    figures.shades_figure(pile, pose, [shade], frame=frame), dpi=_DPI
                ),
                f"Map of the pile with {len(shade.values)} places around it, coloured by "
                f"{shade.title}: {shade.values.min():.{shade.digits}f} to "
                f"{shade.values.max():.{shade.digits}f} {shade.unit}, the best at "
                f"{frame.place(place['x'], place['y'])}; a histogram below.",
            )
        )
    return Gallery(
        "Each quantity around the pile",
        pictures,
        columns=2,
        caption="Arrows end at the places, along the headings. Yellow is good in every map.",
    )


def _scene(document: Mapping[str, Any], pile: Pile, shades: Mapping[str, Shade]) -> dict[str, Any]:
    places, offset = document["locations"], frame_recorded(document).offset
    points = np.array([[place["x"], place["y"]] for place in places], float)
    height = np.asarray(pile.height, np.float64)
    # It is looked at from the south.
    side = points.mean(axis=0) - (0.0, 10.0)
    ground, _ = ground_of(pile, height[None], points, side, document)
    z = height_at(points, pile, height) + _ABOVE
    return {
        **ground,
        "places": np.round(np.column_stack([points, z]), 2).tolist(),
        "said": [
            f"place {n} at {x + offset[0]:.1f}, {y + offset[1]:.1f}"
            for n, (x, y) in enumerate(points.tolist(), start=1)
        ],
        "shades": {
            name: {
                "title": f"{shade.title} [{shade.unit}]",
                "unit": shade.unit,
                "digits": shade.digits,
                "values": np.round(shade.values, 4).tolist(),
                "much": shade.much_is_good,
            }
            for name, shade in shades.items()
        },
    }
