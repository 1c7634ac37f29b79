"""`POST /plan`: a plan, as `plan.json`."""

from __future__ import annotations

import json

from starlette.requests import Request
from starlette.responses import Response

from wlplan.serve.answers import json_answer
from wlplan.serve.incoming import finished, scan_and_settings
from wlplan.serve.service import KeptPlan, Service
from wlplan.serve.settings import PLANNING, SCAN, choices

METHOD, PATH = "POST", "/plan"


async def answer(service: Service, request: Request) -> Response:
    """The plan once it is made; with `background` at once the job that makes it."""
    names = choices(service.worlds.names, service.planners)
    upload, settings = await scan_and_settings(service, request, {**SCAN, **names, **PLANNING})
    job = service.desk.submit(lambda job: service.plan(job, upload, settings))
    if settings.get("background"):
        return json_answer(json.dumps({"job": job.id}), status=202, at=f"/jobs/{job.id}")
    plan: KeptPlan = await finished(job, request)
    return json_answer(plan.text, at=f"/plans/{plan.id}/plan.json")
