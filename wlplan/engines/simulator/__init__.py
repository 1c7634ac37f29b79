"""The simulator: a loading cycle of a wheel loader on a heightfield. Paper, section 5."""

from wlplan.engines.limits import STOP_REASONS
from wlplan.engines.simulator.cycle import Cycle, Settings, dig
from wlplan.engines.simulator.trajectory import Section, Trajectory, trace, trace_section
from wlplan.engines.simulator.world import Simulator, with_lane_soil

__all__ = [
    "STOP_REASONS",
    "Cycle",
    "Section",
    "Settings",
    "Simulator",
    "Trajectory",
    "dig",
    "trace",
    "trace_section",
    "with_lane_soil",
]
