"""`GET /assets/NAME`: the style sheets and the script of the page."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response

from wlplan.serve.answers import Refused
from wlplan.serve.page import asset
from wlplan.serve.service import Service

METHOD, PATH = "GET", "/assets/{name}"


async def answer(service: Service, request: Request) -> Response:
    """One of them."""
    found = asset(request.path_params["name"])
    if found is None:
        raise Refused(404, "there is no such file.")
    text, kind = found
    return Response(text, media_type=kind)
