"""The page of a plan, `report.html`. What it says and how stands in `plan.html.j2`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wlplan.io import write_text_atomic
from wlplan.report.headline import FUEL_A_MEGAJOULE, foreseen, headline, trucks_said
from wlplan.report.ledger import LEDGER_TOLERANCE, ledger_error, volume_lost
from wlplan.report.stands import stands_of
from wlplan.report.template import Gallery, rendered
from wlplan.site.frame import frame_recorded
from wlplan.worlds.names import engine_of

REPORT_NAME = "report.html"


def write_report(
    folder: str | os.PathLike[str],
    document: Mapping[str, Any],
    *,
    galleries: Sequence[Gallery] = (),
    scene: Mapping[str, Any] | None = None,
    settings: Mapping[str, str] | None = None,
) -> Path:
    """Write `report.html` into a folder, in one piece or not at all.

    Args:
        folder: Existing folder.
        document: Content of a plan.json: `loads`, and where known `predicted`, `simulated` and
            `transport` of each, `total`, `ledger`, `receiver`, `pile` and the names of what made
            it. What is missing is a dash on the page.
        galleries: Pictures, see `wlplan.report.pictures`.
        scene: What is shown in three dimensions, see `wlplan.report.scene`; None: nothing.
        settings: Further lines for the table of settings, by name.

    Returns:
        Path of the report.

    Raises:
        InputError: If it cannot be written.
    """
    path = Path(folder) / REPORT_NAME
    write_text_atomic(
        path, render_report(document, galleries=galleries, scene=scene, settings=settings)
    )
    return path


def render_report(
    document: Mapping[str, Any],
    *,
    galleries: Sequence[Gallery] = (),
    scene: Mapping[str, Any] | None = None,
    settings: Mapping[str, str] | None = None,
) -> str:
    """The report as HTML; arguments as for `write_report`. Every text is escaped."""
    ledger = document.get("ledger") or {}
    error = ledger_error(ledger)
    return rendered(
        "plan.html.j2",
        scene=scene,
        document=document,
        played_in=engine_of(document).title,
        offset=frame_recorded(document).offset,
        stands=stands_of(document),
        job=headline(document),
        foreseen=foreseen(document),
        trucks=trucks_said(document),
        fuel=FUEL_A_MEGAJOULE,
        ledger={
            "lost": volume_lost(ledger),
            "error": error,
            "closed": None if math.isnan(error) else error <= LEDGER_TOLERANCE,
        },
        galleries=galleries,
        settings=settings or {},
    )
