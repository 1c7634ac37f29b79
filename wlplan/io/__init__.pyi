"""Names of the room and where they are defined; read by `lazy_loader` and by type checkers."""

from .bundled import bundled_pile_path as bundled_pile_path
from .files import write_bytes_atomic as write_bytes_atomic
from .files import write_text_atomic as write_text_atomic
from .piles import ScannedPile as ScannedPile
from .piles import read_pile as read_pile
from .piles import read_scan as read_scan
from .piles import write_pile as write_pile
from .plans import PLAN_FORMAT as PLAN_FORMAT
from .plans import plan_to_dict as plan_to_dict
from .plans import read_plan as read_plan
from .plans import write_plan as write_plan
from .readers import register_reader as register_reader
from .scans import Heightmap as Heightmap
from .scans import PointCloud as PointCloud
from .survey import Survey as Survey
from .survey import read_survey as read_survey
