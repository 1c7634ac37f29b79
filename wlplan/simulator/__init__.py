"""The simulator: a loading cycle of a wheel loader on a heightfield. Paper, section 5."""

from wlplan.simulator.cycle import STOP_REASONS, Cycle, Settings, dig
from wlplan.simulator.trajectory import Trajectory, trace
from wlplan.simulator.world import Simulator

__all__ = ["STOP_REASONS", "Cycle", "Settings", "Simulator", "Trajectory", "dig", "trace"]
