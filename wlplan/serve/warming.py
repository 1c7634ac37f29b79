"""What is loaded and compiled before anybody asks."""

from __future__ import annotations

from wlplan.report.making import Told
from wlplan.serve.desk import Telling
from wlplan.serve.endpoints.next_load import one_load
from wlplan.serve.service import Service
from wlplan.serve.uploads import BUNDLED

# A place beside the bundled pile [m].
_BESIDE = (-6.0, 4.0)


def warmed(service: Service, progress: Told) -> None:
    """Loads the models, and plans a next load from the bundled pile.

    Args:
        service: Keeps it.
        progress: Told what begins.

    Raises:
        InputError: If a model cannot be used.
    """
    progress.phase("loading the models")
    service.world_of({})
    _ = service.simulator
    progress.phase("compiling the search of a next load")
    # With a truck whose heading is to be found, and with one whose place is.
    for settings in ({"truck": _BESIDE}, {}):
        one_load(service, Telling(), service.uploads.find(BUNDLED), settings)
