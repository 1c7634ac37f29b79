"""The report of a plan: one HTML file that needs nothing beside it and opens in any browser.

What it says and how it looks stands in `page.html.j2`; here are the values for it.
"""

from __future__ import annotations

import base64
import functools
import math
import os
from collections.abc import Mapping, Sequence
from importlib import resources
from numbers import Real
from pathlib import Path
from typing import Any

from jinja2 import ChainableUndefined, Environment, PackageLoader, Template
from markupsafe import Markup

from wlplan.constants import QUANTITIES
from wlplan.errors import shown
from wlplan.io import write_text_atomic
from wlplan.models.ensemble import PERCENT_90
from wlplan.report.headline import FUEL_A_MEGAJOULE, headline, trucks_said
from wlplan.report.ledger import LEDGER_TOLERANCE, ledger_error, volume_lost
from wlplan.report.stands import stands_of
from wlplan.site.frame import frame_recorded

REPORT_NAME = "report.html"

_DASH, _MINUS, _NO_BREAK = "–", "−", "\u00a0"


def write_report(
    folder: str | os.PathLike[str],
    document: Mapping[str, Any],
    *,
    figures: Sequence[tuple[bytes, str]] = (),
    scene: Mapping[str, Any] | None = None,
    settings: Mapping[str, str] | None = None,
) -> Path:
    """Write `report.html` into a folder, in one piece or not at all.

    Args:
        folder: Existing folder.
        document: Content of a plan.json: `loads`, and where known `predicted`, `simulated` and
            `transport` of each, `total`, `ledger`, `receiver`, `pile` and the names of what made
            it. What is missing is a dash on the page.
        figures: PNG files as bytes, each with its caption.
        scene: What is shown in three dimensions, see `wlplan.report.scene`; None: nothing.
        settings: Further lines for the table of settings, by name.

    Returns:
        Path of the report.

    Raises:
        InputError: If it cannot be written.
    """
    path = Path(folder) / REPORT_NAME
    write_text_atomic(
        path, render_report(document, figures=figures, scene=scene, settings=settings)
    )
    return path


def render_report(
    document: Mapping[str, Any],
    *,
    figures: Sequence[tuple[bytes, str]] = (),
    scene: Mapping[str, Any] | None = None,
    settings: Mapping[str, str] | None = None,
) -> str:
    """The report as HTML; arguments as for `write_report`. Every text is escaped."""
    ledger = document.get("ledger") or {}
    error = ledger_error(ledger)
    return _template().render(
        document=document,
        offset=frame_recorded(document).offset,
        quantities=QUANTITIES,
        stands=stands_of(document),
        job=headline(document),
        trucks=trucks_said(document),
        fuel=FUEL_A_MEGAJOULE,
        scene=scene,
        plotly=None if scene is None else _plotly(),
        ledger={
            "lost": volume_lost(ledger),
            "error": error,
            "closed": None if math.isnan(error) else error <= LEDGER_TOLERANCE,
        },
        pictures=[
            (f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}", caption)
            for png, caption in figures
        ],
        settings=settings or {},
    )


@functools.cache
def _plotly() -> Markup:
    """The library that draws in three dimensions, as it is in its package: part of the page."""
    source = resources.files("plotly").joinpath("package_data", "plotly.min.js")
    return Markup(source.read_text(encoding="utf-8"))


@functools.cache
def _template() -> Template:
    environment = Environment(
        autoescape=True,
        # A name of a file may hold what is no character.
        finalize=lambda value: shown(value) if type(value) is str else value,
        loader=PackageLoader("wlplan", "report"),
        undefined=ChainableUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "capitalise": lambda text: str(text)[:1].upper() + str(text)[1:],
        "coordinate": _coordinate,
        "degrees": _degrees,
        "difference": _difference,
        "minutes": _minutes,
        "nine_in_ten": _nine_in_ten,
        "number": _number,
        "percent": _percent,
        "plain": _plain,
        "share": _share,
    }
    return environment.get_template("page.html.j2")


def _finite(value: object) -> float | None:
    """A value of plan.json as a number; None if it is missing or none."""
    return float(value) if isinstance(value, Real) and math.isfinite(value) else None


def _number(value: object, digits: int = 2) -> str:
    """A number for people; a dash where there is none."""
    number = _finite(value)
    return _DASH if number is None else f"{number:,.{digits}f}".replace("-", _MINUS)


def _coordinate(value: object, offset: float) -> str:
    """A local coordinate in that of the scan [m]; a dash if it is missing."""
    number = _finite(value)
    return _DASH if number is None else f"{number + offset:.2f}".replace("-", _MINUS)


def _degrees(angle: object) -> int | None:
    """Whole degrees of an angle [rad]."""
    number = _finite(angle)
    return None if number is None else round(math.degrees(number))


def _nine_in_ten(deviation: object) -> str:
    """Half of the interval that holds nine in ten, of a standard deviation."""
    number = _finite(deviation)
    return _DASH if number is None else f"{PERCENT_90 * number:.1g}"


def _minutes(seconds: object) -> str:
    """A time for people; a dash where there is none."""
    number = _finite(seconds)
    if number is None:
        return _DASH
    minutes, rest = divmod(round(number), 60)
    return f"{minutes}{_NO_BREAK}min {rest:02d}{_NO_BREAK}s" if minutes else f"{rest}{_NO_BREAK}s"


def _difference(predicted: object, simulated: object) -> str:
    """How far a prediction is off, relative; a dash where that is unknown."""
    p, s = _finite(predicted), _finite(simulated)
    if p is None or not s:
        return _DASH
    return f"{100.0 * (p / s - 1.0):+.1f}{_NO_BREAK}%".replace("-", _MINUS)


def _percent(part: object) -> str:
    number = _finite(part)
    return _DASH if number is None else f"{100.0 * number:.2g} %"


def _share(part: object) -> str:
    """A probability in whole percent; a dash where there is none."""
    number = _finite(part)
    return _DASH if number is None else f"{100.0 * number:.0f}{_NO_BREAK}%"


def _plain(value: object) -> str:
    """A value of plan.json, lists without brackets and numbers without noise."""
    if isinstance(value, list | tuple):
        return ", ".join(_plain(part) for part in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)
