"""The page of the service: a template, a style sheet on top of the report's, and a script."""

from __future__ import annotations

import functools
from importlib import resources

from jinja2 import Environment, PackageLoader

from wlplan.planning.objectives import OBJECTIVES
from wlplan.serve.service import Service
from wlplan.serve.uploads import ENDINGS
from wlplan.site.receiver import truck_outline

# Files by name: the package that they are in, and their kind.
_ASSETS = {
    "page.css": ("wlplan.report", "text/css"),
    "serve.css": (__name__, "text/css"),
    "serve.js": (__name__, "text/javascript"),
}


def rendered(service: Service) -> str:
    """The page, made for what a service has."""
    environment = Environment(
        autoescape=True,
        loader=PackageLoader(__name__, ""),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template("serve.html.j2").render(
        worlds=service.worlds.names,
        planners=service.planners,
        objectives=tuple(OBJECTIVES),
        endings=ENDINGS,
        site=service.site,
        facts={
            "endings": ENDINGS,
            "most_bytes": service.most_bytes,
            "truck": truck_outline(service.site.machine),
            "approach": service.site.machine.approach_distance,
        },
    )


@functools.cache
def asset(name: str) -> tuple[str, str] | None:
    """A file of the page and its kind; None if there is none of that name."""
    if name not in _ASSETS:
        return None
    package, kind = _ASSETS[name]
    return resources.files(package).joinpath(name).read_text(encoding="utf-8"), kind
