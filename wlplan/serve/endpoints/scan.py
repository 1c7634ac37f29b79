"""`POST /scan`: what a scan holds, and its heights for display."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from wlplan.io.summary import info
from wlplan.io.survey import read_survey
from wlplan.serve.answers import document_text, json_answer
from wlplan.serve.desk import Job
from wlplan.serve.incoming import finished, scan_and_settings
from wlplan.serve.raster import raster_of
from wlplan.serve.service import Service, reading_of
from wlplan.serve.settings import SCAN
from wlplan.serve.uploads import Upload

METHOD, PATH = "POST", "/scan"


async def answer(service: Service, request: Request) -> Response:
    """As `wlplan info --json`, with `scan`, under which it is kept, and `raster`."""
    upload, settings = await scan_and_settings(service, request, SCAN)
    job = service.desk.submit(lambda job: found_in(service, job, upload, settings))
    return json_answer(await finished(job, request))


def found_in(service: Service, job: Job, upload: Upload, settings: dict[str, Any]) -> str:
    """The answer as JSON."""
    job.telling.phase(f"reading {upload.name}")
    reading, areas = reading_of(settings)
    with upload.on_disk(areas) as (path, files):
        survey = read_survey(path, **{**reading, **files})
        found = info(survey, soil=service.site.soil)
        notes = [upload.shown(note, path.parent) for note in found["notes"]]
    return document_text(
        {
            **{"scan": upload.id, "name": upload.name},
            **found,
            **{"notes": notes, "raster": raster_of(survey)},
        }
    )
