"""`GET /plans/ID/NAME`: the files of a plan, as `wlplan plan --out` writes them."""

from __future__ import annotations

import mimetypes

from starlette.requests import Request
from starlette.responses import Response

from wlplan.serve.answers import Refused
from wlplan.serve.incoming import finished
from wlplan.serve.service import Service

METHOD, PATH = "GET", "/plans/{plan}/{name}"

# A page that runs no script but its own, as if from a server of its own: it reaches nothing here.
_ALONE = (
    "sandbox allow-scripts allow-modals; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; frame-ancestors 'none'"
)
_KINDS = {".geojson": "application/geo+json", ".dxf": "image/vnd.dxf", ".tif": "image/tiff"}
_SHOWN = (".html", ".png")


async def answer(service: Service, request: Request) -> Response:
    """One of them; what has to be drawn first takes seconds."""
    plan, name = service.find_plan(request.path_params["plan"]), request.path_params["name"]
    if name == "plan.json":
        content: bytes | None = plan.text.encode()
    else:
        job = service.desk.submit(lambda job: plan.content(name))
        job.telling.phase(f"drawing {name}")
        content = await finished(job, request)
    if content is None:
        raise Refused(404, f"a plan has no such file: it has {', '.join(plan.names)}.")
    ending = name[name.rfind(".") :]
    kind = _KINDS.get(ending) or mimetypes.guess_type(name)[0] or "application/octet-stream"
    headers = {"Content-Security-Policy": _ALONE}
    if ending not in _SHOWN:
        headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return Response(content, headers=headers, media_type=kind)
