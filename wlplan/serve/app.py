"""The application: the endpoints that there are, behind the guards."""

from __future__ import annotations

import importlib
import os
import pkgutil
import traceback
from collections.abc import Callable
from types import ModuleType

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from wlplan.errors import InputError
from wlplan.serve import endpoints, guards
from wlplan.serve.answers import Refused, refusal
from wlplan.serve.service import Service

# Status in the log of a request that nobody waits for any more.
_GONE = 499


def make_app(
    service: Service, *, names: tuple[str, ...] = ("localhost",), log: Callable[[str], None]
) -> ASGIApp:
    """The application.

    Args:
        service: What the endpoints work with.
        names: Names that this machine may be called by, see `guards.at_home`.
        log: Is given a line for each request.
    """
    found = (
        importlib.import_module(f"{endpoints.__name__}.{module.name}")
        for module in pkgutil.iter_modules(endpoints.__path__)
    )
    app: ASGIApp = Starlette(
        routes=[_route(service, module) for module in found],
        exception_handlers={HTTPException: _no_such},
    )
    app = guards.sized(app, service.most_bytes)
    app = guards.at_home(app, names)
    app = guards.with_headers(app)
    return guards.logged(app, log)


def _route(service: Service, module: ModuleType) -> Route:
    async def answer(request: Request) -> Response:
        try:
            response: Response = await module.answer(service, request)
        except InputError as error:
            return refusal(error)
        except ClientDisconnect:
            return Response(status_code=_GONE)
        except Exception as error:
            return _fault(error)
        return response

    return Route(module.PATH, answer, methods=[module.METHOD])


async def _no_such(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    said = {404: "there is no such page.", 405: "this is not done in this way here."}
    message = said.get(error.status_code, error.detail)
    answer = refusal(Refused(error.status_code, message))
    answer.headers.update(error.headers or {})
    return answer


def _fault(error: Exception) -> Response:
    if os.environ.get("WLPLAN_DEBUG"):
        traceback.print_exception(error)
    said = " ".join(f"this should not happen ({type(error).__name__}: {error})".split())
    return JSONResponse({"error": f"{said}: please report it."}, 500)
