"""Differentiable planning of bucket loads for autonomous wheel loaders, in JAX.

A plan is N loadings: where to dig, at which heading, with which parameters of the automatic
bucket-filling controller. A world, learned or simulated, says what each loading yields and what it
leaves of the pile::

    pile = wlplan.read_pile("scan.npz")
    world = wlplan.load_world("low")
    result = wlplan.plan_loads(world, pile, loads=10)
    result.plan, result.rollout.performance, result.cost

Names are imported when first used, so that `import wlplan` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlplan.automaton import relax as relax
    from wlplan.dem.world import DiscreteElements as DiscreteElements
    from wlplan.diggability import DiggabilityMap as DiggabilityMap
    from wlplan.diggability import diggability_map as diggability_map
    from wlplan.errors import InputError as InputError
    from wlplan.horizon import rollout as rollout
    from wlplan.io import read_pile as read_pile
    from wlplan.io import read_plan as read_plan
    from wlplan.io import write_pile as write_pile
    from wlplan.objective import OBJECTIVES as OBJECTIVES
    from wlplan.objective import Objective as Objective
    from wlplan.pile import seed_pile as seed_pile
    from wlplan.pile import toe_contour as toe_contour
    from wlplan.planner import PlanResult as PlanResult
    from wlplan.planner import plan_loads as plan_loads
    from wlplan.planner import play as play
    from wlplan.presets import machine_named as machine_named
    from wlplan.presets import soil_named as soil_named
    from wlplan.simulator import Simulator as Simulator
    from wlplan.transport import Receiver as Receiver
    from wlplan.types import Action as Action
    from wlplan.types import Characteristics as Characteristics
    from wlplan.types import LoadingPlan as LoadingPlan
    from wlplan.types import LocalHeightmap as LocalHeightmap
    from wlplan.types import Performance as Performance
    from wlplan.types import Pile as Pile
    from wlplan.types import Pose as Pose
    from wlplan.types import Rollout as Rollout
    from wlplan.types import World as World
    from wlplan.worlds import load_world as load_world

__version__ = "0.1.0"

_MODULES = {
    "automaton": ("relax",),
    "dem.world": ("DiscreteElements",),
    "diggability": ("DiggabilityMap", "diggability_map"),
    "errors": ("InputError",),
    "horizon": ("rollout",),
    "io": ("read_pile", "read_plan", "write_pile"),
    "objective": ("OBJECTIVES", "Objective"),
    "pile": ("seed_pile", "toe_contour"),
    "planner": ("PlanResult", "plan_loads", "play"),
    "presets": ("machine_named", "soil_named"),
    "simulator": ("Simulator",),
    "transport": ("Receiver",),
    "types": (
        "Action",
        "Characteristics",
        "LoadingPlan",
        "LocalHeightmap",
        "Performance",
        "Pile",
        "Pose",
        "Rollout",
        "World",
    ),
    "worlds": ("load_world",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'wlplan' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"wlplan.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *_MODULE_OF]
