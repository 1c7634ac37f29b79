"""Names of the package and where they are defined; read by `lazy_loader` and by type checkers."""

from .engines.dem.world import DiscreteElements as DiscreteElements
from .engines.simulator import Simulator as Simulator
from .errors import InputError as InputError
from .io.piles import read_pile as read_pile
from .io.piles import write_pile as write_pile
from .io.plans import read_plan as read_plan
from .io.plans import write_plan as write_plan
from .planning import planners as planners
from .planning.job import Job as Job
from .planning.job import PlanResult as PlanResult
from .planning.loading import Loading as Loading
from .planning.objective import Constraint as Constraint
from .planning.objective import Objective as Objective
from .planning.objectives import OBJECTIVES as OBJECTIVES
from .planning.plan import plan_loads as plan_loads
from .planning.plan import play as play
from .planning.proposals import Proposals as Proposals
from .planning.rollout import rollout as rollout
from .report.figures import diggability_figure as diggability_figure
from .report.figures import plan_figure as plan_figure
from .report.figures import save_figure as save_figure
from .report.figures import totals_figure as totals_figure
from .report.page import write_report as write_report
from .site.presets import machine_named as machine_named
from .site.presets import soil_named as soil_named
from .site.receiver import Receiver as Receiver
from .site.site import Site as Site
from .studies.diggability import DiggabilityMap as DiggabilityMap
from .studies.diggability import diggability_map as diggability_map
from .terrain.automaton import relax as relax
from .terrain.seed_piles import seed_pile as seed_pile
from .terrain.toe import toe_contour as toe_contour
from .types import Action as Action
from .types import Characteristics as Characteristics
from .types import LoadingPlan as LoadingPlan
from .types import LocalHeightmap as LocalHeightmap
from .types import Performance as Performance
from .types import Pile as Pile
from .types import Pose as Pose
from .types import Rollout as Rollout
from .types import World as World
from .worlds.capabilities import world as world
from .worlds.learned import LearnedWorld as LearnedWorld
from .worlds.shipped import load_world as load_world

__version__: str
