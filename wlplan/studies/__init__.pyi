"""Names of the room and where they are defined; read by `lazy_loader` and by type checkers."""

from .horizons import TOTALS as TOTALS
from .horizons import Horizon as Horizon
from .horizons import horizon as horizon
from .landscapes import DescentPath as DescentPath
from .landscapes import Landscape as Landscape
from .landscapes import descent_path as descent_path
from .landscapes import landscape as landscape
from .lines import Line as Line
from .lines import line as line
from .smoothing import ORDERS as ORDERS
from .smoothing import Roughness as Roughness
from .smoothing import SmoothedGradient as SmoothedGradient
from .smoothing import mixed_order as mixed_order
from .smoothing import roughness as roughness
from .smoothing import smoothed_gradient as smoothed_gradient
from .variables import COMPONENTS as COMPONENTS
from .variables import STEPS as STEPS
from .variables import Differenced as Differenced
from .variables import LoadingYield as LoadingYield
from .variables import PlanCost as PlanCost
from .variables import direction as direction
from .variables import moved as moved
