"""What a request brings: a scan and settings; and waiting for what is made of them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from typing import Any

from starlette.requests import Request

from wlplan.errors import InputError
from wlplan.serve.desk import Job
from wlplan.serve.service import Service
from wlplan.serve.settings import Kind, from_json, from_query, object_of
from wlplan.serve.uploads import Upload

# So often it is looked whether whoever asked is still there [s].
_LOOK = 0.5


async def scan_and_settings(
    service: Service, request: Request, kinds: Mapping[str, Kind]
) -> tuple[Upload, dict[str, Any]]:
    """The scan that a request is about, and its settings.

    The body is a JSON object of settings, or else the scan itself, with the settings in the query.

    Args:
        service: Keeps scans.
        request: The request.
        kinds: Settings that may be given.

    Raises:
        InputError: If a setting is none, or there is no scan.
    """
    body = await request.body()
    settings = from_query(dict(request.query_params), kinds)
    if request.headers.get("content-type", "").split(";")[0].strip() == "application/json":
        settings |= from_json(object_of(body), kinds)
        body = b""
    if body and "scan" in settings:
        raise InputError("a scan was sent, and another one named: leave one of them out.")
    if body:
        if "name" not in settings:
            raise InputError("the scan has no name: add ?name=FILE, whose ending says its kind.")
        return service.uploads.add(settings["name"], body), settings
    if "scan" not in settings:
        raise InputError(
            "there is no scan: send its bytes as the body, with ?name=FILE, or name one that was "
            "sent before as scan."
        )
    return service.uploads.find(settings["scan"]), settings


async def finished(job: Job, request: Request) -> Any:
    """The result of a job; it is stopped if whoever asked goes away."""
    future = asyncio.wrap_future(job.future)
    while not future.done():
        await asyncio.wait({future}, timeout=_LOOK)
        if not future.done() and await request.is_disconnected():
            job.stop()
            break
    with contextlib.suppress(asyncio.CancelledError):
        return await future
    raise InputError("stopped before it was begun.")
