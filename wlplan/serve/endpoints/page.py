"""`GET /`: the page."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from wlplan.serve.page import rendered
from wlplan.serve.service import Service

METHOD, PATH = "GET", "/"


async def answer(service: Service, request: Request) -> Response:
    """The page, made for what this service has."""
    return HTMLResponse(rendered(service))
