"""The simulator: a loading cycle of a wheel loader on a heightfield. Paper, section 5."""

from wlplan.loading_cycle import STOP_REASONS
from wlplan.simulator.cycle import Cycle, Settings, dig
from wlplan.simulator.trajectory import Trajectory, trace
from wlplan.simulator.world import Simulator

__all__ = ["STOP_REASONS", "Cycle", "Settings", "Simulator", "Trajectory", "dig", "trace"]
