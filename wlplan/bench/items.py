"""What `wlplan bench` measures, each item beside the figure to beat and the one to reach."""

from __future__ import annotations

from wlplan.bench.automata import AVALANCHES, BASELINES
from wlplan.bench.planning import PLANNING
from wlplan.bench.rollouts import ROLLOUTS
from wlplan.bench.setup import Item

ITEMS: dict[str, Item] = {
    item.name: item for item in (*AVALANCHES, *ROLLOUTS, *PLANNING, *BASELINES)
}
"""Items by name, in the order in which they are shown."""
