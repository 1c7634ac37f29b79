"""The planners: a file each, named after its planner; one line each here for type checkers."""

from wlplan.planning.proposals import Planner

from .cma_es import CmaEs as CmaEs
from .cross_entropy import CrossEntropy as CrossEntropy
from .gradient import Gradient as Gradient
from .greedy import Greedy as Greedy
from .iterated_greedy import IteratedGreedy as IteratedGreedy
from .max_load import MaxLoad as MaxLoad
from .nominal import Nominal as Nominal
from .random_search import RandomSearch as RandomSearch
from .tree_search import TreeSearch as TreeSearch

NAMES: tuple[str, ...]

def class_name(name: str) -> str: ...
def checked(value: object) -> Planner: ...
