"""The planners: a file each, named after its planner; one line each here for type checkers."""

from .gradient import Gradient as Gradient
from .greedy import Greedy as Greedy
from .nominal import Nominal as Nominal

NAMES: tuple[str, ...]

def class_name(name: str) -> str: ...
