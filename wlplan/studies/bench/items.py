"""What `wlplan bench` measures, each item beside the figure to beat and the one to reach."""

from __future__ import annotations

from wlplan.studies.bench.automata import AVALANCHES, BASELINES
from wlplan.studies.bench.maps import MAPS
from wlplan.studies.bench.planning import PLANNING
from wlplan.studies.bench.rollouts import ROLLOUTS
from wlplan.studies.bench.setup import Item

ITEMS: dict[str, Item] = {
    item.name: item for item in (*AVALANCHES, *ROLLOUTS, *PLANNING, *MAPS, *BASELINES)
}
"""Items by name, in the order in which they are shown."""
