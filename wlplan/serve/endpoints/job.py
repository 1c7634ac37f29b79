"""`GET /jobs/ID`: how far a plan is, which was asked for in the background."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from wlplan.errors import InputError
from wlplan.report.headline import headline, trucks_said
from wlplan.serve.desk import Job
from wlplan.serve.service import KeptPlan, Service
from wlplan.serve.settings import finite

METHOD, PATH = "GET", "/jobs/{job}"


async def answer(service: Service, request: Request) -> Response:
    """`state` is waiting, running, done, stopped or failed; what is going on is in `said`."""
    job = service.desk.find(request.path_params["job"])
    return JSONResponse({"job": job.id, **state_of(service, job)})


def state_of(service: Service, job: Job) -> dict[str, Any]:
    """What is known of a job."""
    future = job.future
    if future.cancelled():
        return {"state": "stopped", "error": "stopped before it was begun."}
    if not future.done():
        ahead = service.desk.ahead(job)
        told = job.telling.now()
        if not future.running():
            told["said"] = f"waiting for {ahead} before it" if ahead else "begins"
        return {
            "state": "running" if future.running() else "waiting",
            "stopping": job.stopping.is_set(),
            **told,
        }
    if (error := future.exception()) is not None:
        known = isinstance(error, InputError)
        said = str(error) if known else f"this should not happen ({type(error).__name__}: {error})"
        return {"state": "failed", "error": " ".join(said.split())}
    plan: KeptPlan = future.result()
    document = plan.made.document
    return {
        "state": "done",
        "plan": plan.id,
        "stopped": document.get("stopped", ""),
        "headline": {name: finite(value) for name, value in headline(document).items()},
        "trucks": trucks_said(document),
        "files": list(plan.names),
    }
