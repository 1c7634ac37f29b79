"""`GET /health`: whether it is up, what it has, and how much is to do."""

from __future__ import annotations

from importlib.metadata import version

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from wlplan.serve.service import Service

METHOD, PATH = "GET", "/health"


async def answer(service: Service, request: Request) -> Response:
    """In a few milliseconds, whatever is computed."""
    return JSONResponse(
        {
            "state": "busy" if service.desk.pending() else "ready",
            "jobs": len(service.desk.pending()),
            "version": version("wlplan"),
            "worlds": list(service.worlds.names),
            "planners": list(service.planners),
            "most_bytes": service.most_bytes,
        }
    )
