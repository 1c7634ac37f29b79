"""`POST /jobs/ID/stop`: ends a search; the best plan so far is its result."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from wlplan.serve.endpoints.job import state_of
from wlplan.serve.service import Service

METHOD, PATH = "POST", "/jobs/{job}/stop"


async def answer(service: Service, request: Request) -> Response:
    """How far it is."""
    job = service.desk.find(request.path_params["job"])
    job.stop()
    return JSONResponse({"job": job.id, **state_of(service, job)})
