"""Training data: simulated loading cycles, stored, split and normalised.

The protocol is the paper's (section 6.2). An episode takes one of the six seed piles, with noise of
its own, and digs it 30 times in a row; each loading starts at a random accessible point of the toe
of the pile as it then is, heads into it to within 10 degrees of the normal, and takes its action
from a Latin hypercube. A set is one episode of each seed pile; its 180 actions are one hypercube.
The protocol "corridor" digs on where it dug before, as plans do; "slow" takes actions like the last
one by which the filling was slow; "past-toe" begins aslant, before or behind the toe. All else is
the same.

Everything random about an episode follows from the seed and its number alone, so a collection that
was cut short continues where it stopped and ends with the same bytes. For the same reason shards,
collected apart and joined, are the data set of a single collector.
"""

from wlplan.dataset.collecting import collect
from wlplan.dataset.merging import merge
from wlplan.dataset.probes import probes_of, simulator_changes
from wlplan.dataset.protocols import PROTOCOLS
from wlplan.dataset.store import open_dataset
from wlplan.dataset.variables import LOADS, VARIABLES, Dataset, fingerprint, join, reflect, split

__all__ = [
    "LOADS",
    "PROTOCOLS",
    "VARIABLES",
    "Dataset",
    "collect",
    "fingerprint",
    "join",
    "merge",
    "open_dataset",
    "probes_of",
    "reflect",
    "simulator_changes",
    "split",
]
