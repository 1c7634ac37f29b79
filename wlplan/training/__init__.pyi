"""Names of the package and where they are defined; read by `lazy_loader` and by type checkers."""

from .evaluation import Errors as Errors
from .evaluation import EvaluationReport as EvaluationReport
from .evaluation import evaluate_performance as evaluate_performance
from .evaluation import held_out as held_out
from .evaluation import shares_piles as shares_piles
from .pile_state import PileStateErrors as PileStateErrors
from .pile_state import evaluate_pile_state as evaluate_pile_state
from .settings import KINDS as KINDS
from .settings import LOSSES as LOSSES
from .settings import OPTIMISERS as OPTIMISERS
from .settings import SCALINGS as SCALINGS
from .settings import SPLITS as SPLITS
from .settings import PhiSettings as PhiSettings
from .settings import PhiVaeSettings as PhiVaeSettings
from .settings import PsiHighSettings as PsiHighSettings
from .settings import PsiLowSettings as PsiLowSettings
from .settings import Settings as Settings
from .settings import StallSettings as StallSettings
from .stall import StallReport as StallReport
from .stall import evaluate_stalls as evaluate_stalls
from .trainer import train as train
from .weights import train_all as train_all
