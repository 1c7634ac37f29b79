"""`POST /next-load`: the next load alone, as a `plan.json` of one load that was not played."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from starlette.requests import Request
from starlette.responses import Response

from wlplan.io.plans import plan_to_dict
from wlplan.planning.replanning import next_load
from wlplan.report.document import receiver_fields
from wlplan.report.making import Told
from wlplan.serve.answers import document_text, json_answer
from wlplan.serve.incoming import finished, scan_and_settings
from wlplan.serve.service import Service
from wlplan.serve.settings import NEXT_LOAD, SCAN, choices
from wlplan.serve.uploads import Upload
from wlplan.types import LoadingPlan

METHOD, PATH = "POST", "/next-load"


async def answer(service: Service, request: Request) -> Response:
    """What is compiled serves scans of any extent, so a process that is warm takes no second."""
    names = choices(service.worlds.names, service.planners)
    del names["planner"]
    upload, settings = await scan_and_settings(service, request, {**SCAN, **names, **NEXT_LOAD})
    job = service.desk.submit(lambda job: one_load(service, job.telling, upload, settings))
    return json_answer(await finished(job, request))


def one_load(service: Service, told: Told, upload: Upload, settings: dict[str, Any]) -> str:
    """The load as JSON."""
    told.phase(f"reading {upload.name}")
    named = service.pile_of(upload, settings)
    world = service.world_of(settings)
    objective, seed = settings.get("objective", "efficiency"), settings.get("seed", 0)
    told.phase("planning")
    truck = settings.get("truck")
    site = service.site.with_receiver(named, truck)
    found = next_load(world.value, named.pile, site=site, objective=objective, seed=seed)
    pose, action, performance = jax.tree.map(
        lambda leaf: jnp.asarray(leaf)[None], (found.pose, found.action, found.performance)
    )
    transport = found.transport
    document = plan_to_dict(
        LoadingPlan(pose, action),
        predicted=performance,
        transport={
            "time": [float(transport.time)],
            "work": [float(transport.work)],
        },
        pile=named.fields,
        **service.site.fields(),
        world=world.name,
        objective=objective,
        seed=seed,
        frame=site.frame.fields(),
        receiver=receiver_fields(site.placed_receiver),
        total={"predicted": {"cost": float(found.cost)}},
    )
    return document_text(document)
